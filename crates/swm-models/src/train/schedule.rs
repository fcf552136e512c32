//! The learning rate over time: linear warm-up, then cosine decay (Loshchilov and Hutter 2017, SGDR, without restarts).

use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// Linear warm-up to the peak learning rate, then half a cosine down to a floor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleConfig {
    /// The number of training steps.
    pub steps: usize,
    /// The number of warm-up steps, included in `steps`.
    pub warmup: usize,
    /// The last learning rate, as a fraction of the peak.
    pub floor: f64,
}

impl ScheduleConfig {
    /// Checks that no learning rate is negative.
    ///
    /// # Errors
    /// When the floor is not from 0 to 1.
    pub fn check(&self) -> Result<()> {
        if (0.0..=1.0).contains(&self.floor) {
            return Ok(());
        }
        Err(Error::config(
            "schedule.floor",
            self.floor.to_string(),
            "give a share of the peak learning rate, from 0 to 1",
        ))
    }

    /// Returns the learning rate of a step (the first step is 0) as a fraction of the peak.
    ///
    /// The fraction of step `t` is `(t + 1) / warmup` during the warm-up, then `floor + (1 - floor) (1 + cos πp) / 2`
    /// with `p = (t - warmup) / (steps - warmup)`.
    pub fn lr_factor(&self, step: usize) -> f64 {
        if step < self.warmup {
            return (step + 1) as f64 / self.warmup as f64;
        }
        let decay_steps = self.steps.saturating_sub(self.warmup).max(1) as f64;
        let progress = ((step - self.warmup) as f64 / decay_steps).min(1.0);
        self.floor + (1.0 - self.floor) * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn learning_rate_rises_linearly_then_decays_to_the_floor() {
        let schedule = ScheduleConfig { steps: 110, warmup: 10, floor: 0.1 };
        assert!((schedule.lr_factor(0) - 0.1).abs() < 1e-12);
        assert!((schedule.lr_factor(9) - 1.0).abs() < 1e-12);
        assert!((schedule.lr_factor(60) - 0.55).abs() < 1e-12);
        assert!((schedule.lr_factor(110) - 0.1).abs() < 1e-12);
    }
}
