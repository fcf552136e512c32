//! The experts: `expert` takes the shortest path to the goal, `explore` walks randomly.
//!
//! Both read only the columns `state`, `goal_state` and `layout`.

use super::paths::{ShortestPaths, VisibilityGraph};
use super::physics::{Layout, MAX_ACTION, SIZE};
use crate::point_agent::{Explorer, Leg, Position64, RandomWalk, distance64, read_position};
use rand::Rng as _;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the registry row.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "the shortest way to the goal, around the walls",
        tasks: &[],
        make: || Box::new(ShortestPathExpert { planner: None }),
    },
    ExpertEntry {
        id: "explore",
        summary: "a smooth random walk around the walls and into them",
        tasks: &[],
        make: || Box::new(Explorer::<MazeWalk>::new()),
    },
];

/// The shortest paths to one position in one maze.
struct Planner {
    graph: VisibilityGraph,
    to: Position64,
    paths: ShortestPaths,
}

impl Planner {
    /// Makes a planner for a position. It reuses the paths of a previous planner for the same maze.
    fn new(previous: Option<Self>, layout: &Layout, to: Position64) -> Self {
        match previous {
            Some(planner) if planner.graph.layout() == layout && planner.to == to => planner,
            previous => {
                let graph = previous.map(|planner| planner.graph).filter(|graph| graph.layout() == layout);
                let graph = graph.unwrap_or_else(|| VisibilityGraph::new(layout));
                let paths = graph.shortest_paths(graph.nearest_free(to));
                Self { graph, to, paths }
            }
        }
    }

    /// Returns the step along the path from a position, with components of at most 1. Without a path, the step leads
    /// straight to the goal.
    fn step(&self, from: Position64) -> Position64 {
        let next = self.graph.next(from, &self.paths).map_or(self.to, |(next, _)| next);
        step_towards(self.graph.layout(), from, next)
    }
}

/// Returns the longest step straight towards `next` that does not pass `next`, with components of at most 1.
fn step_towards(layout: &Layout, from: Position64, next: Position64) -> Position64 {
    let away = [0, 1].map(|i| next[i] - from[i]);
    let longest = f64::from(layout.speed * MAX_ACTION);
    let divisor = away[0].abs().max(away[1].abs()).max(longest);
    away.map(|v| v / divisor)
}

/// Walks along the shortest path.
struct ShortestPathExpert {
    planner: Option<Planner>,
}

impl Expert for ShortestPathExpert {
    fn begin(&mut self, _key: Key) {
        self.planner = None;
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let planner = Planner::new(self.planner.take(), &layout, read_position(row, GOAL_STATE)?);
        let step = planner.step(read_position(row, STATE)?);
        action.copy_from_slice(&step.map(|v| v * f64::from(MAX_ACTION)));
        self.planner = Some(planner);
        Ok(())
    }
}

/// Share of legs that lead around the walls instead of straight into them.
const AROUND_SHARE: f64 = 0.7;
/// The maximal number of steps of a leg around the walls.
const AROUND_LEG_STEPS: u32 = 40;

/// The random walk of `explore`: around the walls, or straight and into them.
#[derive(Default)]
struct MazeWalk {
    planner: Option<Planner>,
}

impl RandomWalk for MazeWalk {
    const ACTION_SCALE: f64 = MAX_ACTION as f64;

    /// The layout and the agent's position.
    type Observed = (Layout, Position64);

    fn read(row: RowRef<'_>) -> Result<Self::Observed> {
        Ok((Layout::from_row(&row.to_f64("layout")?), read_position(row, STATE)?))
    }

    fn draw_leg(rng: &mut Rng) -> Leg {
        let to = [(); 2].map(|()| rng.random_range(0.0..f64::from(SIZE)));
        let avoids_walls = rng.random_bool(AROUND_SHARE);
        let pace = rng.random_range(0.4..1.4);
        let steps = if avoids_walls { AROUND_LEG_STEPS } else { rng.random_range(5..20) };
        Leg { to, pace, steps, avoids_walls }
    }

    fn has_arrived((layout, at): &Self::Observed, leg: &Leg) -> bool {
        distance64(leg.to, *at) < f64::from(2.0 * layout.speed * MAX_ACTION)
    }

    fn action(&mut self, (layout, at): &Self::Observed, leg: &Leg) -> [f64; 2] {
        let step = if leg.avoids_walls {
            let planner = Planner::new(self.planner.take(), layout, leg.to);
            self.planner.insert(planner).step(*at)
        } else {
            step_towards(layout, *at, leg.to)
        };
        step.map(|step| leg.pace * step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point_agent::trial::{play, reached_of_200};
    use crate::point_maze::ENTRY;
    use swm_core::ResetOptions;

    #[test]
    fn expert_reaches_the_goal() {
        let reached = reached_of_200(&ENTRY, 100, 1000);
        // Walls separate the remaining 9 goals from every position that the agent can reach.
        assert_eq!(reached, 191, "all factors varied, goals of the reset");
    }

    #[test]
    fn explorer_visits_the_whole_maze() {
        let mut visited = std::collections::BTreeSet::new();
        let mut stopped = 0;
        // The goal is in a corner, so that the walk does not end the episode early by reaching the goal.
        let far_goal = ResetOptions { goal_state: Some(vec![0.0, 0.0]), ..ResetOptions::default() };
        for seed in 0..50 {
            let (positions, _) = play(&ENTRY, &EXPERTS[1], seed, &far_goal, false, 100);
            visited.extend(positions.iter().map(|p| p.map(|v| (v * 2.0).min(9.0) as i64)));
            stopped += positions.windows(2).filter(|p| p[0] == p[1]).count();
        }
        // 10 x 10 cells of half a unit, less the cells inside walls.
        assert!(visited.len() >= 80 && stopped >= 100, "{} cells visited, stopped {stopped} times", visited.len());
    }
}
