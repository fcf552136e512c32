//! The dynamics: two links hang from a bar, a motor turns the joint between them (Sutton 1996; Sutton and Barto 2018,
//! example 11.3), one Runge-Kutta step of fourth order at a time.
//!
//! Equations and constants are those of Gymnasium's Acrobot in its "book" variant. Double precision throughout.

use std::f64::consts::PI;
use swm_core::Transition;

/// Seconds in a step.
const STEP: f64 = 0.2;
const GRAVITY: f64 = 9.8;
/// The links' greatest angular speeds, in radians a second.
pub const FASTEST: [f64; 2] = [4.0 * PI, 9.0 * PI];

/// Both angles, the second relative to the first link, and both angular speeds.
pub type State = [f64; 4];

/// The physical factors of an episode, in SI units, for both links.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// Where along a link its centre of mass is.
    pub centre: [f64; 2],
    /// How long a link is.
    pub length: [f64; 2],
    /// A link's mass.
    pub mass: [f64; 2],
    /// The moment of inertia of each.
    pub inertia: f64,
}

/// How high the end of the second link is, in lengths of a link: from -2, hanging, to 2.
pub fn height(state: &State) -> f64 {
    -state[0].cos() - (state[1] + state[0]).cos()
}

/// The line the end of the second link must be above.
pub const LINE: f64 = 1.0;

impl Physics {
    /// Of the factors in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [c1, c2, l1, l2, m1, m2, inertia] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { centre: [c1, c2], length: [l1, l2], mass: [m1, m2], inertia }
    }

    /// Inertias, the second and the first of the matrix that couples the links' accelerations.
    fn inertias(&self, bend: f64) -> [f64; 2] {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let coupled = l1 * c2 * bend.cos();
        let first = m1 * (c1 * c1) + m2 * (l1 * l1 + c2 * c2 + 2.0 * coupled) + inertia + inertia;
        [first, m2 * (c2 * c2 + coupled) + inertia]
    }

    /// How the state changes in a second.
    fn change(&self, &[angle, bend, turn, fold]: &State, torque: f64) -> State {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let [d1, d2] = self.inertias(bend);
        let swing = m2 * l1 * c2 * bend.sin();
        let phi2 = m2 * c2 * GRAVITY * (angle + bend - PI / 2.0).cos();
        let phi1 = -swing * (fold * fold) - 2.0 * swing * fold * turn
            + (m1 * c1 + m2 * l1) * GRAVITY * (angle - PI / 2.0).cos()
            + phi2;
        let folding =
            (torque + d2 / d1 * phi1 - swing * (turn * turn) - phi2) / (m2 * (c2 * c2) + inertia - d2 * d2 / d1);
        [turn, fold, -(d2 * folding + phi1) / d1, folding]
    }

    /// Turns the motor on for one step. The reward is -1, and 0 for the step that lifts the end above the line.
    pub fn step(&self, state: &mut State, torque: f64) -> Transition {
        let ahead = |time: f64, change: &State| std::array::from_fn(|i| state[i] + time * change[i]);
        let k1 = self.change(state, torque);
        let k2 = self.change(&ahead(STEP / 2.0, &k1), torque);
        let k3 = self.change(&ahead(STEP / 2.0, &k2), torque);
        let k4 = self.change(&ahead(STEP, &k3), torque);
        for i in 0..4 {
            state[i] += STEP / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        for i in 0..2 {
            state[i] = wrapped(state[i]);
            state[2 + i] = state[2 + i].clamp(-FASTEST[i], FASTEST[i]);
        }
        let terminated = height(state) > LINE;
        Transition { reward: if terminated { 0.0 } else { -1.0 }, terminated, truncated: false }
    }

    /// The energy of motion and height, in joules; 0 at rest with both links level.
    pub fn energy(&self, &[angle, bend, turn, fold]: &State) -> f64 {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let [d1, d2] = self.inertias(bend);
        let motion = d1 * turn * turn / 2.0 + d2 * turn * fold + (m2 * c2 * c2 + inertia) * fold * fold / 2.0;
        motion - GRAVITY * ((m1 * c1 + m2 * l1) * angle.cos() + m2 * c2 * (angle + bend).cos())
    }
}

/// An angle brought to -π ..= π by whole turns.
fn wrapped(mut angle: f64) -> f64 {
    while angle > PI {
        angle -= 2.0 * PI;
    }
    while angle < -PI {
        angle += 2.0 * PI;
    }
    angle
}
