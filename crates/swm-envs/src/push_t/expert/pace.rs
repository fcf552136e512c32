//! [`Pace`]: how fast the planning expert moves the agent.

use rand::Rng as _;
use swm_core::Rng;

/// The bounds of the expert's actions. Times are counted in steps at full speed, so that the expert plans the same
/// pushes at every pace.
#[derive(Clone, Copy)]
pub struct Pace {
    /// The largest absolute value of an action component.
    pub largest: f64,
    /// The largest growth of an action per step. An action shrinks without a bound.
    growth: f64,
    /// The share of the distance to a position that the agent covers in a step.
    pub approach: f64,
    /// The largest deviation of [`Pace::largest`] in a plan, as a share of it.
    spread: f64,
}

impl Pace {
    /// The whole action space.
    pub const FULL: Self = Self { largest: 1.0, growth: f64::INFINITY, approach: 1.0, spread: 0.0 };
    /// The speed of the demonstrations on which LeWM and DINO-WM are trained: actions have a standard deviation of 0.2.
    pub const PAPER: Self = Self { largest: 0.32, growth: 0.12, approach: 0.5, spread: 0.5 };

    /// Draws the pace of a plan.
    pub fn drawn(&self, rng: &mut Rng) -> Self {
        if self.spread == 0.0 {
            return *self;
        }
        Self { largest: self.largest * rng.random_range(1.0 - self.spread..1.0 + self.spread), ..*self }
    }

    /// Scales an action to the bounds, after the action `last`.
    pub fn limited(&self, action: [f64; 2], last: [f64; 2]) -> [f64; 2] {
        let excess = |i: usize| {
            let before = (last[i] * action[i].signum()).max(0.0);
            action[i].abs() / self.largest.min(before + self.growth)
        };
        let strength = excess(0).max(excess(1)).max(1.0);
        action.map(|v| v / strength)
    }

    /// Returns the number of steps in which the agent covers the distance of `time` steps at full speed.
    pub fn steps(&self, time: f64) -> usize {
        (time / self.largest).ceil() as usize
    }
}
