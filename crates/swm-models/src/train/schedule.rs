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

    /// Checks that the warm-up ends before the run does. Presets for datasets keep their warm-up in short trials, so only
    /// online configurations are checked.
    ///
    /// # Errors
    /// When the warm-up has more steps than the run.
    pub fn check_warmup(&self) -> Result<()> {
        if self.warmup <= self.steps {
            return Ok(());
        }
        let problem = format!("{} steps of warm-up, and schedule.steps is {}", self.warmup, self.steps);
        Err(Error::config("schedule.warmup", problem, "lower schedule.warmup, or raise schedule.steps"))
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

    #[test]
    fn a_warm_up_beyond_the_run_is_refused_online() {
        let load = |settings: &[&str]| {
            let settings: Vec<String> = settings.iter().map(|text| (*text).to_owned()).collect();
            (crate::FAMILIES.get("sac").expect("sac").config)("tiny", &settings).map(drop)
        };
        load(&["schedule.steps=10", "schedule.warmup=10"]).expect("a warm-up as long as the run");
        let error = load(&["schedule.steps=10", "schedule.warmup=11"]).expect_err("a longer warm-up").to_string();
        assert!(error.contains("11 steps of warm-up") && error.contains("schedule.steps is 10"), "{error}");
        (crate::FAMILIES.get("lewm").expect("lewm").config)("tiny", &["schedule.steps=2".to_owned()])
            .map(drop)
            .expect("a short trial on a dataset");
    }
}
