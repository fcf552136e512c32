//! [`PlannerConfig`]: the settings of a model-predictive path integral search.

use crate::train::config::at_least;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The settings of a model-predictive path integral search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannerConfig {
    /// Steps of a plan.
    pub horizon: usize,
    /// Candidates of an iteration.
    pub samples: usize,
    /// Number of iterations.
    pub iterations: usize,
    /// Candidates with the lowest cost, which determine the next sampling distribution.
    pub elites: usize,
    /// Candidates that are rollouts of the policy.
    pub proposals: usize,
    /// The smallest standard deviation of the samples, for actions between -1 and 1.
    pub min_std: f32,
    /// The largest standard deviation, with which a search begins.
    pub max_std: f32,
    /// Inverse temperature of the elites' weights, `exp(-temperature (cost - lowest cost))`.
    pub temperature: f32,
}

impl PlannerConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// Names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        at_least(&[
            ("online.planner.horizon", self.horizon, 1),
            ("online.planner.samples", self.samples, 1),
            ("online.planner.iterations", self.iterations, 1),
            ("online.planner.elites", self.elites, 1),
        ])?;
        for (what, part) in [("elites", self.elites), ("proposals", self.proposals)] {
            if part > self.samples {
                let given = format!("{part} of {} candidates", self.samples);
                return Err(Error::config(format!("online.planner.{what}"), given, "choose at most all of them"));
            }
        }
        if !(self.min_std > 0.0 && self.min_std <= self.max_std && self.max_std.is_finite()) {
            let given = format!("from {} to {}", self.min_std, self.max_std);
            return Err(Error::config("online.planner.min_std", given, "choose 0 < min_std <= max_std"));
        }
        if !(self.temperature.is_finite() && self.temperature > 0.0) {
            let fix = "choose a number above 0";
            return Err(Error::config("online.planner.temperature", self.temperature.to_string(), fix));
        }
        Ok(())
    }
}
