//! The scripted expert of the quadruped: it turns over where it lies on its back, and trots.
//!
//! Both motions are fixed; only when they begin depends on what the expert sees. Their numbers were found by the cross-entropy method, with
//! returns as the score: 900 trots, and 4,000 attempts to turn over.

use std::f64::consts::PI;
use swm_core::policy::Expert;
use swm_core::{Error, ExpertEntry, Key, Result, RowRef};

/// The experts of the quadruped.
pub const EXPERTS: &[ExpertEntry] = &[ExpertEntry {
    id: "expert",
    summary: "turns over if it lies on its back, and trots forward",
    tasks: &["walk"],
    make: || Box::<Controller>::default(),
}];

/// The index of the torso's uprightness (1 upright, -1 on the back) in the observation.
const UPRIGHT: usize = 47;
/// Below the first uprightness the quadruped has fallen, above the second it stands.
const FALLEN: f64 = 0.3;
const STANDING: f64 = 0.9;
/// The number of actions that it lies before it turns over, and that it rests after a try.
const LIE: usize = 4;
const REST: usize = 6;

/// The number of legs: front left, front right, back right, back left. Each has the actions yaw, lift and extend.
const LEGS: usize = 4;
/// The actions of a leg.
type Leg = [f64; 3];

/// A part of the motion that turns the quadruped over: how many actions it takes, and the actions of the legs on either side; back legs yaw
/// the other way.
struct Part {
    actions: usize,
    sides: [Leg; 2],
}

const TURN_OVER: [Part; 3] = [
    Part { actions: 5, sides: [[-0.9, -0.31, -0.83], [-0.59, 0.48, 0.86]] },
    Part { actions: 7, sides: [[-0.83, 0.65, 0.38], [0.87, 0.88, 0.42]] },
    Part { actions: 18, sides: [[-0.02, 0.22, 0.07], [0.91, -0.82, 0.45]] },
];

/// The trot: cycles in an action, and swing of the yaw.
const CYCLES: f64 = 0.1165;
const SWING: f64 = 0.71;
/// Lift and extension of a leg on the ground, and what a leg in the air adds to them.
const GROUND: [f64; 2] = [-0.62, 0.08];
const AIR: [f64; 2] = [0.81, 0.0];
/// The phase of the lift, relative to the yaw's, in radians.
const LIFT_PHASE: f64 = -1.63;

/// What the expert does in an episode.
#[derive(Default)]
struct Controller {
    /// The number of actions in the episode, and of those in which it has lain.
    age: usize,
    lain: usize,
    /// The number of actions since it began to turn over, if it does, and the number of tries.
    turning: Option<usize>,
    tries: usize,
}

impl Controller {
    /// The actions of the legs.
    fn legs(&mut self, upright: f64) -> [Leg; LEGS] {
        self.turning = self.turning.map(|actions| actions + 1);
        let most = TURN_OVER.iter().map(|part| part.actions).sum::<usize>() + REST;
        if self.turning.is_some_and(|actions| actions >= most || upright > STANDING) {
            (self.turning, self.lain) = (None, 0);
        }
        if self.turning.is_none() && upright < FALLEN {
            self.lain += 1;
            if self.lain <= LIE {
                return [[0.0; 3]; LEGS];
            }
            self.turning = Some(0);
            self.tries += 1;
        }
        match self.turning {
            Some(actions) => turn_over(actions, self.tries.is_multiple_of(2)),
            None => {
                self.lain = 0;
                trot(self.age as f64)
            }
        }
    }
}

/// The actions that turn the quadruped over to one side, or to the other.
fn turn_over(actions: usize, mirrored: bool) -> [Leg; LEGS] {
    let mut begin = 0;
    for Part { actions: length, sides } in &TURN_OVER {
        if actions < begin + length {
            return std::array::from_fn(|leg| {
                let is_left = leg == 0 || leg == 3;
                let [yaw, lift, extend] = sides[usize::from(is_left == mirrored)];
                let is_back = leg >= 2;
                [if is_back == mirrored { yaw } else { -yaw }, lift, extend]
            });
        }
        begin += length;
    }
    [[0.0; 3]; LEGS]
}

/// The actions of the trot: diagonal legs move together, and legs on the ground move backwards.
fn trot(actions: f64) -> [Leg; LEGS] {
    std::array::from_fn(|leg| {
        let phase = 2.0 * PI * CYCLES * actions + if leg % 2 == 0 { 0.0 } else { PI };
        let side = if leg == 0 || leg == 3 { 1.0 } else { -1.0 };
        let in_air = (phase + LIFT_PHASE).sin().max(0.0);
        [-side * SWING * phase.cos(), GROUND[0] + AIR[0] * in_air, GROUND[1] + AIR[1] * in_air]
    })
}

impl Expert for Controller {
    fn begin(&mut self, _key: Key) {
        *self = Self::default();
    }

    fn act(&mut self, row: RowRef<'_>, action: &mut [f64]) -> Result<()> {
        let observation = row.to_f64("observation")?;
        let Some(&upright) = observation.get(UPRIGHT).filter(|_| action.len() == 3 * LEGS) else {
            let given = format!("{} observed values and {} actions", observation.len(), action.len());
            return Err(Error::mismatch("controlling a quadruped", given, "more than 47, and 12 actions"));
        };
        self.age += 1;
        action.copy_from_slice(self.legs(upright).as_flattened());
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::ENTRY;
    use crate::dmc::expert_test::last_rewards;

    /// 11 of 64 episodes begin upright or on the side; the others begin on the back.
    #[test]
    fn it_stands_and_walks_at_the_end_of_most_episodes() {
        // Of two control steps; 1 for standing still.
        let walking = last_rewards(&ENTRY, 4, 300).into_iter().filter(|reward| *reward > 1.9).count();
        assert!(walking >= 3, "{walking} of 4");
    }
}
