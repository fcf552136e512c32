//! The dynamics: a car in a sinusoidal valley whose motor is weaker than gravity (Moore 1990).
//!
//! Constants, and the order and precision of operations, are those of Gymnasium's MountainCar (double precision) and
//! Continuous_MountainCar (single precision, like its state). Lengths are in track units, times in steps.

/// Positions of the walls at both ends of the track, in track units.
pub const ENDS: [f64; 2] = [-1.2, 0.6];
/// The largest value of the factor `physics.max_speed`, in track units per step.
pub const MAX_SPEED: f32 = 0.105;

/// The physical factors of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Hill {
    /// Acceleration by the motor at full power, in track units per step².
    pub push: f64,
    /// Acceleration by gravity where the hill is steepest, in track units per step².
    pub gravity: f64,
    /// The maximal speed, in track units per step.
    pub max_speed: f64,
}

/// Returns the height of the hill at a position, in track units.
pub fn height(x: f64) -> f64 {
    (3.0 * x).sin() * 0.45 + 0.55
}

impl Hill {
    /// Returns position and velocity after a step with a motor power of -1, 0 or 1.
    pub fn step(&self, [x, speed]: [f64; 2], power: f64) -> [f64; 2] {
        let speed = speed + (power * self.push + (3.0 * x).cos() * -self.gravity);
        let speed = speed.clamp(-self.max_speed, self.max_speed);
        let x = (x + speed).clamp(ENDS[0], ENDS[1]);
        [x, if x == ENDS[0] && speed < 0.0 { 0.0 } else { speed }]
    }

    /// Returns position and velocity after a step in single precision, with a motor power that is clipped to -1 ..= 1.
    pub fn continuous_step(&self, [x, speed]: [f64; 2], power: f64) -> [f64; 2] {
        let [mut x, mut speed, power, limit] = [x, speed, power, self.max_speed].map(|v| v as f32);
        let slope = self.gravity * f64::from(3.0 * x).cos();
        // As in numpy: an action that is not clipped is a float32, so every operation is rounded to single precision. A
        // clipped action is a Python float, so only the result is rounded.
        speed += if (-1.0..=1.0).contains(&power) {
            power * self.push as f32 - slope as f32
        } else {
            (f64::from(power.signum()) * self.push - slope) as f32
        };
        speed = speed.clamp(-limit, limit);
        let [low, high] = ENDS.map(|end| end as f32);
        x = (x + speed).clamp(low, high);
        [f64::from(x), if x == low && speed < 0.0 { 0.0 } else { f64::from(speed) }]
    }
}
