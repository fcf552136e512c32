//! The dynamics: a cart on a frictionless track and a pole hinged on it (Barto, Sutton and Anderson 1983), integrated
//! by the Euler method in double precision.
//!
//! Equations, constants and the order of operations are those of Gymnasium's CartPole.

use swm_core::Transition;

/// Half the length of the track, in metres.
const TRACK: f64 = 2.4;
/// Angle beyond which the pole counts as fallen: 12 degrees, in radians.
const FALLEN: f64 = 12.0 * 2.0 * std::f64::consts::PI / 360.0;

/// The physical factors of an episode, in SI units.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// Force of a push, in N.
    pub force: f64,
    /// Gravitational acceleration, in m/s².
    pub gravity: f64,
    /// Half the pole's length, in m.
    pub length: f64,
    /// Mass of the pole, in kg.
    pub pole: f64,
    /// Mass of cart and pole together, in kg.
    pub total: f64,
    /// Duration of a step, in seconds.
    pub tau: f64,
}

impl Physics {
    /// Reads the factors, in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [force, gravity, length, cart, pole, tau] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { force, gravity, length, pole, total: pole + cart, tau }
    }

    /// Advances the state by one step with a push to the right or to the left. The state is position (m), velocity
    /// (m/s), angle (rad), angular velocity (rad/s), and 1 after the episode terminated. The reward is 1 up to and
    /// including the step that terminates the episode, and 0 on later steps outside the bounds.
    pub fn step(&self, state: &mut [f64; 5], right: bool) -> Transition {
        let [x, v, angle, angular_velocity, fell] = *state;
        let Self { gravity, length, pole, total, tau, .. } = *self;
        let force = if right { self.force } else { -self.force };
        let (sin, cos) = (angle.sin(), angle.cos());
        let push = (force + pole * length * (angular_velocity * angular_velocity) * sin) / total;
        let angular_acceleration = (gravity * sin - cos * push) / (length * (4.0 / 3.0 - pole * (cos * cos) / total));
        let acceleration = push - pole * length * angular_acceleration * cos / total;
        let (x, angle) = (x + tau * v, angle + tau * angular_velocity);
        let terminated = x.abs() > TRACK || angle.abs() > FALLEN;
        let reward = if terminated && fell == 1.0 { 0.0 } else { 1.0 };
        let fell = if terminated { 1.0 } else { fell };
        *state = [x, v + tau * acceleration, angle, angular_velocity + tau * angular_acceleration, fell];
        Transition { reward, terminated, truncated: false }
    }
}
