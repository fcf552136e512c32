//! Ways against the drift: straight ones, and detours where the drift is stronger than the agent.

use super::physics::{Dynamics, GOAL_RADIUS, Point, distance};

/// Steps within which a straight way must lead to its end.
const MAX_STEPS: usize = 400;

/// Where steering straight towards `to` leads, and after how many steps it is reached, if it is.
pub fn walk(dynamics: &Dynamics, from: Point, to: Point) -> (Point, Option<usize>) {
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

/// Places along a side of the grid that detours lead over.
const SIDE: usize = 256;
/// Steps from a place that the target is out of reach of.
const NEVER: u16 = u16::MAX;
/// What is left to rounding, in pixels.
const SPARE: f64 = 1e-3;

/// Fewest steps to a target from the places of a grid.
///
/// A step can end anywhere in a rectangle as wide as twice the speed, moved by the drift and cut by the border. So the
/// agent goes from place to place exactly, and a search backwards from the target, one step at a time, finds every way
/// over the grid.
pub struct Detour {
    dynamics: Dynamics,
    to: Point,
    steps: Vec<u16>,
}

impl Detour {
    /// The ways to a target.
    pub fn new(dynamics: &Dynamics, to: Point) -> Self {
        let mut detour = Self { dynamics: *dynamics, to, steps: vec![NEVER; SIDE * SIDE] };
        for i in 0..SIDE * SIDE {
            if distance(detour.place(i), to) < GOAL_RADIUS - SPARE as f32 {
                detour.steps[i] = 0;
            }
        }
        // How many places above and left of each one reach the target, to count those of a rectangle at once.
        let mut counts = vec![0_u32; (SIDE + 1) * (SIDE + 1)];
        for step in 1..NEVER {
            for (y, row) in detour.steps.chunks_exact(SIDE).enumerate() {
                let mut sum = 0;
                for (x, &steps) in row.iter().enumerate() {
                    sum += u32::from(steps < NEVER);
                    counts[(y + 1) * (SIDE + 1) + x + 1] = counts[y * (SIDE + 1) + x + 1] + sum;
                }
            }
            let mut found = false;
            for i in 0..SIDE * SIDE {
                if detour.steps[i] < NEVER {
                    continue;
                }
                let [[left, right], [top, bottom]] = detour.window(detour.place(i));
                let count = |x: usize, y: usize| counts[y * (SIDE + 1) + x];
                if left < right
                    && top < bottom
                    && count(right, bottom) + count(left, top) > count(left, bottom) + count(right, top)
                {
                    detour.steps[i] = step;
                    found = true;
                }
            }
            if !found {
                break;
            }
        }
        detour
    }

    fn spacing(&self) -> f64 {
        let [low, high] = self.dynamics.reach();
        (high - low) / (SIDE - 1) as f64
    }

    #[allow(clippy::cast_possible_truncation)]
    fn place(&self, i: usize) -> Point {
        [i % SIDE, i / SIDE].map(|cell| (self.dynamics.reach()[0] + cell as f64 * self.spacing()) as f32)
    }

    /// The columns and rows of the grid that one step can end at, from the first to the one behind the last.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn window(&self, from: Point) -> [[usize; 2]; 2] {
        let ([low, high], drift) = (self.dynamics.reach(), self.dynamics.drift_at(from));
        [0, 1].map(|i| {
            let cells = |end: f64| ((f64::from(from[i]) + drift[i] + end).clamp(low, high) - low) / self.spacing();
            let reach = self.dynamics.speed - SPARE;
            [cells(-reach).ceil() as usize, (cells(reach) + 1e-9).floor() as usize + 1]
        })
    }

    /// Where to step to; `None` where no way is known.
    pub fn next(&self, from: Point) -> Option<Point> {
        let [[left, right], [top, bottom]] = self.window(from);
        let places = (top..bottom.min(SIDE)).flat_map(|y| (left..right.min(SIDE)).map(move |x| y * SIDE + x));
        let known = places.filter(|&i| self.steps[i] < NEVER);
        let far = |i: usize| distance(self.place(i), self.to);
        let best = known.min_by(|&i, &j| self.steps[i].cmp(&self.steps[j]).then(far(i).total_cmp(&far(j))));
        best.map(|i| self.place(i))
    }
}
