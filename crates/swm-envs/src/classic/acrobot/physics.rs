//! The dynamics: two links hang from a bar, and a motor acts on the joint between them (Sutton 1996; Sutton and Barto
//! 2018, example 11.3). They are integrated by the Runge-Kutta method of fourth order, in double precision.
//!
//! Equations and constants are those of Gymnasium's Acrobot in its "book" variant.

use std::f64::consts::PI;
use swm_core::Transition;

/// Duration of a step, in seconds.
const STEP: f64 = 0.2;
/// Gravitational acceleration, in m/s².
const GRAVITY: f64 = 9.8;
/// The maximal angular speeds of the first link and of the joint, in rad/s.
pub const MAX_SPEED: [f64; 2] = [4.0 * PI, 9.0 * PI];

/// The angle of the first link from hanging down, the angle of the joint (radians), and both angular velocities
/// (rad/s).
pub type State = [f64; 4];

/// The physical factors of an episode, in SI units, for both links.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// Distance of the centre of mass of each link from its upper joint, in m.
    pub centre: [f64; 2],
    /// Length of each link, in m.
    pub length: [f64; 2],
    /// Mass of each link, in kg.
    pub mass: [f64; 2],
    /// Moment of inertia of each link, in kg m².
    pub inertia: f64,
}

/// Returns the height of the end of the second link, in link lengths: from -2, hanging, to 2.
pub fn height(state: &State) -> f64 {
    -state[0].cos() - (state[1] + state[0]).cos()
}

/// Height of the line above which the end of the second link must be, in link lengths.
pub const LINE: f64 = 1.0;

impl Physics {
    /// Reads the factors, in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [c1, c2, l1, l2, m1, m2, inertia] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { centre: [c1, c2], length: [l1, l2], mass: [m1, m2], inertia }
    }

    /// Returns d1 and d2 of the equations of motion, the first row of the inertia matrix, in kg m².
    fn inertias(&self, joint: f64) -> [f64; 2] {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let coupled = l1 * c2 * joint.cos();
        let first = m1 * (c1 * c1) + m2 * (l1 * l1 + c2 * c2 + 2.0 * coupled) + inertia + inertia;
        [first, m2 * (c2 * c2 + coupled) + inertia]
    }

    /// Returns the time derivative of the state under a torque in N m.
    fn derivative(&self, &[angle, joint, velocity, joint_velocity]: &State, torque: f64) -> State {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let [d1, d2] = self.inertias(joint);
        let coriolis = m2 * l1 * c2 * joint.sin();
        let phi2 = m2 * c2 * GRAVITY * (angle + joint - PI / 2.0).cos();
        let phi1 = -coriolis * (joint_velocity * joint_velocity) - 2.0 * coriolis * joint_velocity * velocity
            + (m1 * c1 + m2 * l1) * GRAVITY * (angle - PI / 2.0).cos()
            + phi2;
        let joint_acceleration = (torque + d2 / d1 * phi1 - coriolis * (velocity * velocity) - phi2)
            / (m2 * (c2 * c2) + inertia - d2 * d2 / d1);
        [velocity, joint_velocity, -(d2 * joint_acceleration + phi1) / d1, joint_acceleration]
    }

    /// Advances the state by one step with a torque in N m. The reward is 0 for a step that ends above the line, and -1
    /// otherwise.
    pub fn step(&self, state: &mut State, torque: f64) -> Transition {
        let ahead = |time: f64, derivative: &State| std::array::from_fn(|i| state[i] + time * derivative[i]);
        let k1 = self.derivative(state, torque);
        let k2 = self.derivative(&ahead(STEP / 2.0, &k1), torque);
        let k3 = self.derivative(&ahead(STEP / 2.0, &k2), torque);
        let k4 = self.derivative(&ahead(STEP, &k3), torque);
        for i in 0..4 {
            state[i] += STEP / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
        }
        for i in 0..2 {
            state[i] = wrapped(state[i]);
            state[2 + i] = state[2 + i].clamp(-MAX_SPEED[i], MAX_SPEED[i]);
        }
        let terminated = height(state) > LINE;
        Transition { reward: if terminated { 0.0 } else { -1.0 }, terminated, truncated: false }
    }

    /// Returns the mechanical energy in joules; 0 at rest with both links horizontal.
    pub fn energy(&self, &[angle, joint, velocity, joint_velocity]: &State) -> f64 {
        let Self { centre: [c1, c2], length: [l1, _], mass: [m1, m2], inertia } = *self;
        let [d1, d2] = self.inertias(joint);
        let kinetic = d1 * velocity * velocity / 2.0
            + d2 * velocity * joint_velocity
            + (m2 * c2 * c2 + inertia) * joint_velocity * joint_velocity / 2.0;
        kinetic - GRAVITY * ((m1 * c1 + m2 * l1) * angle.cos() + m2 * c2 * (angle + joint).cos())
    }
}

/// Wraps an angle to -π ..= π.
fn wrapped(mut angle: f64) -> f64 {
    while angle > PI {
        angle -= 2.0 * PI;
    }
    while angle < -PI {
        angle += 2.0 * PI;
    }
    angle
}
