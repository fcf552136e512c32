//! The dynamics: a rod that turns around its end, with a weak motor there, one semi-implicit Euler step at a time.
//!
//! Equations, their order and precision are those of Gymnasium's Pendulum: doubles, but for what numpy computes from an
//! action, which is single.

use swm_core::Transition;

/// How fast the rod may be with any factors, in radians a second.
pub const FASTEST: f32 = 12.0;

/// The physical factors of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Physics {
    /// Seconds in a step.
    pub dt: f64,
    /// Gravity.
    pub gravity: f64,
    /// The rod's length.
    pub length: f64,
    /// Its mass.
    pub mass: f64,
    /// The most it turns.
    pub max_speed: f64,
    /// The most the motor does.
    pub max_torque: f64,
}

impl Physics {
    /// Of the factors in sampling order.
    pub fn new(factors: &[f32]) -> Self {
        let [dt, gravity, length, mass, max_speed, max_torque] = std::array::from_fn(|i| f64::from(factors[i]));
        Self { dt, gravity, length, mass, max_speed, max_torque }
    }

    /// What a torque adds to the angular speed in a second.
    pub fn per_torque(&self) -> f64 {
        3.0 / (self.mass * (self.length * self.length))
    }

    /// What gravity adds to it at most.
    pub fn fall(&self) -> f64 {
        3.0 * self.gravity / (2.0 * self.length)
    }

    /// Turns the motor on for one step. The state is the angle, the angular speed, and the torque of the last step.
    #[allow(clippy::cast_possible_truncation)]
    pub fn step(&self, state: &mut [f64; 3], torque: f64) -> Transition {
        let [angle, turn, _] = *state;
        let limit = self.max_torque as f32;
        let torque = (torque as f32).clamp(-limit, limit);
        let off = super::angle::between(0.0, angle);
        let cost = off * off + 0.1 * (turn * turn) + f64::from(0.001 * (torque * torque));
        let pushed = f64::from(self.per_torque() as f32 * torque);
        let turn = (turn + (self.fall() * angle.sin() + pushed) * self.dt).clamp(-self.max_speed, self.max_speed);
        *state = [angle + turn * self.dt, turn, f64::from(torque)];
        Transition { reward: -cost, terminated: false, truncated: false }
    }
}
