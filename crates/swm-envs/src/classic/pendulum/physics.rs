//! The dynamics: a rod that a motor rotates about one of its ends, integrated by the semi-implicit Euler method.
//!
//! Equations, and the order and precision of operations, are those of Gymnasium's Pendulum: double precision, except
//! for products with the float32 action, which numpy computes in single precision.

use crate::classic::angle::between;
use swm_core::Transition;

/// The largest value of the factor `physics.max_speed`, in rad/s.
pub const MAX_SPEED: f32 = 12.0;

/// The physical factors of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// Duration of a step, in seconds.
    pub dt: f64,
    /// Gravitational acceleration, in m/s².
    pub gravity: f64,
    /// Length of the rod, in m.
    pub length: f64,
    /// Mass of the rod, in kg.
    pub mass: f64,
    /// The maximal angular speed, in rad/s.
    pub max_speed: f64,
    /// The maximal torque of the motor, in N m.
    pub max_torque: f64,
}

impl Physics {
    /// Reads the factors, in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [dt, gravity, length, mass, max_speed, max_torque] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { dt, gravity, length, mass, max_speed, max_torque }
    }

    /// Returns the angular acceleration per torque, in rad/s² per N m.
    pub fn acceleration_per_torque(&self) -> f64 {
        3.0 / (self.mass * (self.length * self.length))
    }

    /// Returns the maximal angular acceleration by gravity, in rad/s².
    pub fn gravity_acceleration(&self) -> f64 {
        3.0 * self.gravity / (2.0 * self.length)
    }

    /// Advances the state by one step with a torque in N m. The state is the angle (rad), the angular velocity (rad/s)
    /// and the torque of the last step (N m). The reward is the negative cost of angle, angular velocity and torque.
    pub fn step(&self, state: &mut [f64; 3], torque: f64) -> Transition {
        let [angle, velocity, _] = *state;
        let limit = self.max_torque as f32;
        let torque = (torque as f32).clamp(-limit, limit);
        let error = between(0.0, angle);
        let cost = error * error + 0.1 * (velocity * velocity) + f64::from(0.001 * (torque * torque));
        let motor = f64::from(self.acceleration_per_torque() as f32 * torque);
        let velocity = velocity + (self.gravity_acceleration() * angle.sin() + motor) * self.dt;
        let velocity = velocity.clamp(-self.max_speed, self.max_speed);
        *state = [angle + velocity * self.dt, velocity, f64::from(torque)];
        Transition { reward: -cost, terminated: false, truncated: false }
    }
}
