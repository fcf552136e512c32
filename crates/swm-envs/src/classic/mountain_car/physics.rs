//! The dynamics: a car in a sinusoidal valley whose motor is weaker than gravity (Moore 1990), one step at a time.
//!
//! Constants, the order of operations and their precision are those of Gymnasium's MountainCar (double) and
//! Continuous_MountainCar (single, because its state is).

/// Where the valley ends on both sides. Walls stop the car.
pub const ENDS: [f64; 2] = [-1.2, 0.6];
/// How fast a car may be with any factors.
pub const FASTEST: f32 = 0.105;

/// The physical factors of an episode, in units of the track and of a step.
#[derive(Clone, Copy, Debug)]
pub struct Hill {
    /// What the motor adds to the speed at full power.
    pub push: f64,
    /// What gravity adds to it where the hill is steepest.
    pub gravity: f64,
    /// The most the car moves in a step.
    pub max_speed: f64,
}

/// The height of the hill.
pub fn height(x: f64) -> f64 {
    (3.0 * x).sin() * 0.45 + 0.55
}

impl Hill {
    /// One step with the motor at -1, 0 or 1.
    pub fn step(&self, [x, speed]: [f64; 2], power: f64) -> [f64; 2] {
        let speed = speed + (power * self.push + (3.0 * x).cos() * -self.gravity);
        let speed = speed.clamp(-self.max_speed, self.max_speed);
        let x = (x + speed).clamp(ENDS[0], ENDS[1]);
        [x, if x == ENDS[0] && speed < 0.0 { 0.0 } else { speed }]
    }

    /// One step in single precision with the motor anywhere from -1 to 1; more is cut.
    #[allow(clippy::cast_possible_truncation)]
    pub fn smooth_step(&self, [x, speed]: [f64; 2], power: f64) -> [f64; 2] {
        let [mut x, mut speed, power, limit] = [x, speed, power, self.max_speed].map(|v| v as f32);
        let slope = self.gravity * f64::from(3.0 * x).cos();
        // numpy rounds every operation with a number of the action, and once where the action was cut.
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
