//! The state vector of Push-T: reading it from the simulation, writing it back, and comparing it with a goal.

use super::physics::{AGENT, BLOCK, Simulation, Vec2};
use super::shapes::BodyShape;
use std::f64::consts::{PI, TAU};
use swm_core::{Error, FactorValues, Result};

/// Agent x y, block x y (pixels), block angle (radians), agent velocity x y (pixels per second).
pub type State = [f64; 7];

/// The largest distance at which the goal is reached: the norm over the positions of agent and block, in pixels.
pub const REACH: f64 = 20.0;
/// The largest rotation of the block at which the goal is reached, in radians.
pub const REACH_ANGLE: f64 = PI / 9.0;
/// Weight of the agent's distance in [`goal_distance`], relative to the block's. It is small, because the agent has to
/// leave its goal to push the block: a plan that minimised both equally would leave the agent at its goal and not push
/// the block.
const AGENT_WEIGHT: f64 = 0.05;

/// Moves the bodies to a state.
pub fn set_state(simulation: &mut Simulation, state: &State) {
    let [x, y, block_x, block_y, angle, vx, vy] = *state;
    simulation.bodies[AGENT].velocity = Vec2::new(vx, vy);
    simulation.bodies[AGENT].set_position(Vec2::new(x, y));
    simulation.bodies[BLOCK].set_angle(angle);
    simulation.bodies[BLOCK].set_position(Vec2::new(block_x, block_y));
}

/// Sets a state and runs one physics step, as the reference does when it sets states.
pub fn settled(mut simulation: Simulation, state: &State) -> Simulation {
    set_state(&mut simulation, state);
    simulation.step();
    simulation
}

/// Reads the state of a simulation; the block's angle is wrapped to 0 .. 2π.
pub fn state_of(simulation: &Simulation) -> State {
    let [agent, block, _] = &simulation.bodies;
    let (a, b) = (agent.position(), block.position());
    [a.x, a.y, b.x, b.y, block.angle.rem_euclid(TAU), agent.velocity.x, agent.velocity.y]
}

/// Returns the start state that the factors describe.
pub fn start_state(factors: &FactorValues) -> State {
    let (agent, block) = (factors.get("agent.start_position"), factors.get("block.start_position"));
    let velocity = factors.get("agent.velocity");
    [agent[0], agent[1], block[0], block[1], factors.scalar("block.angle"), velocity[0], velocity[1]]
}

/// Checks a state that a caller gave.
///
/// # Errors
/// When the state does not have 7 values, or one of the values is not finite.
pub fn checked(state: &[f64], what: &str) -> Result<State> {
    if let Some(bad) = state.iter().find(|v| !v.is_finite()) {
        let fix = "give finite positions, angle and velocities".to_owned();
        return Err(Error::NotFinite { what: what.to_owned(), given: bad.to_string(), fix });
    }
    state.try_into().map_err(|_| {
        let expected = "7 values: agent x y, block x y, block angle, agent velocity x y";
        Error::mismatch(format!("reading a {what}"), format!("{} values", state.len()), expected)
    })
}

/// Returns the Euclidean distance of two states over all 7 values, the negative of the reward.
pub fn state_distance(a: &State, b: &State) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Returns whether a goal is reached: both positions are near those of the goal, and the angle of the block is near
/// that of the goal up to the symmetry of the block.
pub fn is_reached(factors: &FactorValues, goal: &State, state: &State) -> bool {
    position_distance(goal, state) < REACH
        && angle_between(factors.integer("block.shape"), goal[4], state[4]) < REACH_ANGLE
}

/// Returns the Euclidean distance of the positions of agent and block together, in pixels.
fn position_distance(goal: &State, state: &State) -> f64 {
    goal[..4].iter().zip(state).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Returns the smallest rotation between two angles of a block, up to its symmetry, in radians.
pub fn angle_between(shape: i64, from: f64, to: f64) -> f64 {
    let symmetry = BodyShape::symmetry(shape);
    let angle = (from - to).rem_euclid(symmetry);
    angle.min(symmetry - angle)
}

/// Returns the distance to the goal in units of the tolerances: the Euclidean norm of the block's distance, its
/// rotation and the weighted distance of the agent.
pub fn goal_distance(factors: &FactorValues, goal: &State, state: &State) -> f64 {
    let distance = |x: usize| (state[x] - goal[x]).hypot(state[x + 1] - goal[x + 1]) / REACH;
    let angle = angle_between(factors.integer("block.shape"), goal[4], state[4]) / REACH_ANGLE;
    (AGENT_WEIGHT * distance(0)).hypot(distance(2)).hypot(angle)
}

/// Returns the distance to a success in units of the tolerances: the Euclidean norm of the distance of both positions and
/// of the block's rotation.
pub fn success_distance(factors: &FactorValues, goal: &State, state: &State) -> f64 {
    let angle = angle_between(factors.integer("block.shape"), goal[4], state[4]);
    (position_distance(goal, state) / REACH).hypot(angle / REACH_ANGLE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::push_t::factors::variation_space;
    use swm_core::{Key, VariationRequest};

    #[test]
    fn goals_are_reached_up_to_the_symmetry_of_the_block() {
        let pinned = |shape: f64| VariationRequest {
            variation: Some(vec![]),
            variation_values: [("block.shape".to_owned(), vec![shape])].into(),
        };
        let goal = [100.0, 100.0, 200.0, 200.0, -3.0, 0.0, 0.0];
        // Square and + look the same after a quarter turn, Z and I after half a turn, L and both T after a full one.
        for (shape, quarter, half) in
            [(1, false, false), (2, false, false), (3, false, true), (4, true, true), (5, false, true), (7, true, true)]
        {
            let factors =
                variation_space().resolve(&pinned(f64::from(shape)), Key::new(0)).expect("resolving the shape");
            for (angle, expected) in [(0.0, true), (TAU, true), (0.4, false), (PI / 2.0, quarter), (PI, half)] {
                let state = [110.0, 100.0, 200.0, 210.0, goal[4] + angle, 50.0, 0.0];
                assert_eq!(is_reached(&factors, &goal, &state), expected, "shape {shape}, rotated by {angle}");
            }
            let far = [115.0, 100.0, 200.0, 215.0, goal[4], 0.0, 0.0];
            assert!(!is_reached(&factors, &goal, &far), "agent and block are 21 pixels off together");
        }
    }

    #[test]
    fn success_distance_counts_the_agent_like_the_block_and_below_1_is_a_success() {
        let factors =
            variation_space().resolve(&VariationRequest::default(), Key::new(0)).expect("resolving the factors");
        let goal = [100.0, 100.0, 200.0, 200.0, 1.0, 0.0, 0.0];
        let moved = |agent: f64, block: f64, degrees: f64| {
            [100.0 + agent, 100.0, 200.0, 200.0 + block, 1.0 + degrees.to_radians(), 9.0, 0.0]
        };
        for (state, expected) in [
            (moved(0.0, 0.0, 0.0), 0.0),
            (moved(40.0, 0.0, 0.0), 2.0),
            (moved(0.0, 40.0, 0.0), 2.0),
            (moved(0.0, 0.0, 40.0), 2.0),
            (moved(12.0, 0.0, 16.0), 1.0),
        ] {
            let distance = success_distance(&factors, &goal, &state);
            assert!((distance - expected).abs() < 1e-9, "{state:?}: {distance}");
            assert!(distance >= 1.0 - 1e-9 || is_reached(&factors, &goal, &state), "{state:?}");
        }
        // Both tolerances count together, so a success may have a distance above 1.
        let success = moved(19.0, 0.0, 19.0);
        assert!(is_reached(&factors, &goal, &success) && success_distance(&factors, &goal, &success) > 1.0);
    }
}
