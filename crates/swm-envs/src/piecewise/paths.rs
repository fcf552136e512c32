//! Paths against the drift: straight paths, and detours where the drift is stronger than the agent.

use super::physics::Dynamics;
use crate::point_agent::Position;
use crate::point_agent::room::{GOAL_RADIUS, distance};

/// The maximal number of steps of a straight path.
const MAX_STEPS: usize = 400;

/// Steers straight towards `to`. Returns the last position and the number of steps, or `None` if `to`
/// is not reached.
pub fn steer_to(dynamics: &Dynamics, from: Position, to: Position) -> (Position, Option<usize>) {
    let mut at = from;
    for steps in 0..MAX_STEPS {
        if distance(at, to) < GOAL_RADIUS {
            return (at, Some(steps));
        }
        let next = dynamics.advance(at, dynamics.steer(at, to));
        if next == at {
            break;
        }
        at = next;
    }
    (at, None)
}

/// Nodes along a side of the grid that detours lead over.
const SIDE: usize = 256;
/// The step count of a node from which the target is unreachable.
const UNREACHABLE: u16 = u16::MAX;
/// Margin against rounding errors, in pixels.
const SPARE: f64 = 1e-3;

/// The fewest steps to a target from every node of a grid.
///
/// A step can end anywhere in a square whose side is twice the speed, shifted by the drift and clipped at the border.
/// So the agent can go from node to node exactly, and a breadth-first search backwards from the target finds every path
/// over the grid.
pub struct Detours {
    dynamics: Dynamics,
    to: Position,
    /// Steps to the target, `[SIDE, SIDE]`.
    steps: Vec<u16>,
}

impl Detours {
    /// Finds the detours to a target.
    pub fn new(dynamics: &Dynamics, to: Position) -> Self {
        let mut detours = Self { dynamics: *dynamics, to, steps: vec![UNREACHABLE; SIDE * SIDE] };
        for i in 0..SIDE * SIDE {
            if distance(detours.node(i), to) < GOAL_RADIUS - SPARE as f32 {
                detours.steps[i] = 0;
            }
        }
        // A summed-area table of the nodes from which the target is reachable, to count such nodes in a rectangle in
        // constant time.
        let mut counts = vec![0_u32; (SIDE + 1) * (SIDE + 1)];
        for step in 1..UNREACHABLE {
            for (y, row) in detours.steps.chunks_exact(SIDE).enumerate() {
                let mut sum = 0;
                for (x, &steps) in row.iter().enumerate() {
                    sum += u32::from(steps < UNREACHABLE);
                    counts[(y + 1) * (SIDE + 1) + x + 1] = counts[y * (SIDE + 1) + x + 1] + sum;
                }
            }
            let mut found = false;
            for i in 0..SIDE * SIDE {
                if detours.steps[i] < UNREACHABLE {
                    continue;
                }
                let [[left, right], [top, bottom]] = detours.window(detours.node(i));
                let count = |x: usize, y: usize| counts[y * (SIDE + 1) + x];
                if left < right
                    && top < bottom
                    && count(right, bottom) + count(left, top) > count(left, bottom) + count(right, top)
                {
                    detours.steps[i] = step;
                    found = true;
                }
            }
            if !found {
                break;
            }
        }
        detours
    }

    /// Distance between neighbouring nodes, in pixels.
    fn spacing(&self) -> f64 {
        let [low, high] = self.dynamics.reach();
        (high - low) / (SIDE - 1) as f64
    }

    /// Returns the position of a node.
    fn node(&self, i: usize) -> Position {
        [i % SIDE, i / SIDE].map(|cell| (self.dynamics.reach()[0] + cell as f64 * self.spacing()) as f32)
    }

    /// Returns the columns and the rows of the nodes at which one step can end, as half-open ranges.
    fn window(&self, from: Position) -> [[usize; 2]; 2] {
        let ([low, high], drift) = (self.dynamics.reach(), self.dynamics.drift_at(from));
        [0, 1].map(|i| {
            let cells = |end: f64| ((f64::from(from[i]) + drift[i] + end).clamp(low, high) - low) / self.spacing();
            let reach = self.dynamics.speed - SPARE;
            [cells(-reach).ceil() as usize, (cells(reach) + 1e-9).floor() as usize + 1]
        })
    }

    /// Returns the node at which the next step should end, or `None` if no path is known.
    pub fn next(&self, from: Position) -> Option<Position> {
        let [[left, right], [top, bottom]] = self.window(from);
        let nodes = (top..bottom.min(SIDE)).flat_map(|y| (left..right.min(SIDE)).map(move |x| y * SIDE + x));
        let known = nodes.filter(|&i| self.steps[i] < UNREACHABLE);
        let far = |i: usize| distance(self.node(i), self.to);
        let best = known.min_by(|&i, &j| self.steps[i].cmp(&self.steps[j]).then(far(i).total_cmp(&far(j))));
        best.map(|i| self.node(i))
    }
}
