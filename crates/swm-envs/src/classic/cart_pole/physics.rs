//! The dynamics: a cart on a track without friction, a pole hinged on it (Barto, Sutton and Anderson 1983), one Euler
//! step at a time.
//!
//! Equations, their order and constants are those of Gymnasium's CartPole. Double precision throughout.

use swm_core::Transition;

/// The cart leaves the track beyond this, in metres.
const TRACK: f64 = 2.4;
/// The pole has fallen beyond this: 12 degrees.
const FALLEN: f64 = 12.0 * 2.0 * std::f64::consts::PI / 360.0;

/// The physical factors of an episode, in SI units.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// How strong a push is.
    pub force: f64,
    /// Gravity.
    pub gravity: f64,
    /// Half the pole's length.
    pub length: f64,
    /// The pole's mass.
    pub pole: f64,
    /// Cart and pole together.
    pub total: f64,
    /// Seconds in a step.
    pub tau: f64,
}

impl Physics {
    /// Of the factors in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [force, gravity, length, cart, pole, tau] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { force, gravity, length, pole, total: pole + cart, tau }
    }

    /// Pushes the cart for one step. The reward is 1, for the step on which the pole falls, too, and 0 for as long as it
    /// stays down.
    pub fn step(&self, state: &mut [f64; 5], right: bool) -> Transition {
        let [x, v, angle, turn, fell] = *state;
        let Self { gravity, length, pole, total, tau, .. } = *self;
        let force = if right { self.force } else { -self.force };
        let (sin, cos) = (angle.sin(), angle.cos());
        let push = (force + pole * length * (turn * turn) * sin) / total;
        let turning = (gravity * sin - cos * push) / (length * (4.0 / 3.0 - pole * (cos * cos) / total));
        let driving = push - pole * length * turning * cos / total;
        let (x, angle) = (x + tau * v, angle + tau * turn);
        let terminated = x.abs() > TRACK || angle.abs() > FALLEN;
        let reward = if terminated && fell == 1.0 { 0.0 } else { 1.0 };
        *state = [x, v + tau * driving, angle, turn + tau * turning, if terminated { 1.0 } else { fell }];
        Transition { reward, terminated, truncated: false }
    }
}
