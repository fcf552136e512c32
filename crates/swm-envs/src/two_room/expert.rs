//! The experts: `expert` takes the shortest path to the target, `explore` walks randomly.
//!
//! Both read only the columns `state`, `goal_state` and `layout`.

use super::paths;
use super::physics::Layout;
use crate::point_agent::room::{BORDER, SIZE};
use crate::point_agent::{Explorer, Leg, Position64, RandomWalk, distance64, read_position};
use rand::Rng as _;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::policy::Expert;
use swm_core::{ExpertEntry, Key, Result, Rng, RowRef};

/// The experts of the registry row.
pub const EXPERTS: &[ExpertEntry] = &[
    ExpertEntry {
        id: "expert",
        summary: "the shortest way to the target, through the best door",
        tasks: &[],
        make: || Box::new(ShortestPath),
    },
    ExpertEntry {
        id: "explore",
        summary: "a smooth random walk through both rooms, the doors and against the walls",
        tasks: &[],
        make: || Box::new(Explorer::<RoomWalk>::new()),
    },
];

/// Walks straight to the target, or through the door of the shortest path.
struct ShortestPath;

impl Expert for ShortestPath {
    fn begin(&mut self, _key: Key) {}

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let layout = Layout::from_row(&row.to_f64("layout")?);
        let (at, goal) = (read_position(row, STATE)?, read_position(row, GOAL_STATE)?);
        let next = paths::waypoint(&layout, at, goal);
        let [dx, dy] = [next[0] - at[0], next[1] - at[1]];
        // The agent walks at full speed, but not beyond the waypoint.
        let divisor = dx.hypot(dy).max(layout.speed);
        action.copy_from_slice(&[dx / divisor, dy / divisor]);
        Ok(())
    }
}

/// Share of legs that lead through the doors instead of straight into the walls.
const DOOR_SHARE: f64 = 0.7;
/// The maximal number of steps of a leg through the doors.
const DOOR_LEG_STEPS: u32 = 60;

/// The random walk of `explore`: through the doors, or straight and into the walls.
#[derive(Default)]
struct RoomWalk;

impl RandomWalk for RoomWalk {
    const ACTION_SCALE: f64 = 1.0;

    /// The layout and the agent's position.
    type Observed = (Layout, Position64);

    fn read(row: RowRef<'_>) -> Result<Self::Observed> {
        Ok((Layout::from_row(&row.to_f64("layout")?), read_position(row, STATE)?))
    }

    fn draw_leg(rng: &mut Rng) -> Leg {
        let to = [(); 2].map(|()| rng.random_range(BORDER..SIZE - BORDER));
        let avoids_walls = rng.random_bool(DOOR_SHARE);
        let pace = rng.random_range(0.4..1.4);
        let steps = if avoids_walls { DOOR_LEG_STEPS } else { rng.random_range(5..25) };
        Leg { to, pace, steps, avoids_walls }
    }

    fn has_arrived((layout, at): &Self::Observed, leg: &Leg) -> bool {
        leg.avoids_walls && distance64(*at, leg.to) < 2.0 * layout.speed
    }

    fn action(&mut self, (layout, at): &Self::Observed, leg: &Leg) -> [f64; 2] {
        let next = if leg.avoids_walls { paths::waypoint(layout, *at, leg.to) } else { leg.to };
        let [dx, dy] = [next[0] - at[0], next[1] - at[1]];
        let divisor = dx.hypot(dy).max(1e-9);
        [dx, dy].map(|step| leg.pace * step / divisor)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::point_agent::trial::{play, reached_of_200};
    use crate::two_room::ENTRY;
    use swm_core::ResetOptions;

    #[test]
    fn expert_reaches_the_target() {
        let reached = reached_of_200(&ENTRY, 100, 400);
        // The remaining eight targets lie deep in the wall, or behind doors too near the border for the agent.
        assert_eq!(reached, 192, "all factors varied, targets of the reset");
    }

    #[test]
    fn explorer_visits_both_rooms() {
        // The target is in a corner, so that the walk does not end the episode early by reaching the target.
        let far_goal = ResetOptions { goal_state: Some(vec![0.0, 0.0]), ..ResetOptions::default() };
        let mut visited = std::collections::BTreeSet::new();
        let (mut crossings, mut touches) = (0, 0);
        for seed in 0..50 {
            let (positions, _) = play(&ENTRY, &EXPERTS[1], seed, &far_goal, false, 100);
            visited.extend(positions.iter().map(|p| p.map(|v| (v / 16.0) as i64)));
            crossings += positions.windows(2).filter(|p| (p[0][0] < 112.0) != (p[1][0] < 112.0)).count();
            touches += positions.iter().filter(|p| p[0] == 99.5 || p[0] == 124.5).count();
        }
        // 12 x 12 cells of 16 pixels, less the cells inside the wall.
        assert!(visited.len() >= 130, "{} cells visited", visited.len());
        assert!(crossings >= 50 && touches >= 100, "{crossings} crossings, {touches} touches of the wall");
    }
}
