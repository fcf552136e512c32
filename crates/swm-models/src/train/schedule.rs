//! The learning rate over time.

use serde::{Deserialize, Serialize};

/// Linear warm-up, then half a cosine down.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleConfig {
    /// Training steps in all.
    pub steps: usize,
    /// Of which the learning rate grows from 0.
    pub warmup: usize,
    /// The last learning rate, as a share of the largest.
    pub floor: f64,
}

impl ScheduleConfig {
    /// The learning rate of a step as a share of the largest; the first step is 0.
    #[allow(clippy::cast_precision_loss)]
    pub fn share(&self, step: usize) -> f64 {
        if step < self.warmup {
            return (step + 1) as f64 / self.warmup as f64;
        }
        let rest = self.steps.saturating_sub(self.warmup).max(1) as f64;
        let done = ((step - self.warmup) as f64 / rest).min(1.0);
        self.floor + (1.0 - self.floor) * 0.5 * (1.0 + (std::f64::consts::PI * done).cos())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_rises_then_falls_to_the_floor() {
        let schedule = ScheduleConfig { steps: 110, warmup: 10, floor: 0.1 };
        assert!((schedule.share(0) - 0.1).abs() < 1e-12);
        assert!((schedule.share(9) - 1.0).abs() < 1e-12);
        assert!((schedule.share(60) - 0.55).abs() < 1e-12);
        assert!((schedule.share(110) - 0.1).abs() < 1e-12);
    }
}
