//! [`PlannerConfig`]: the settings of a planner that selects actions during online training.

use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The settings of model-predictive path integral control (Williams et al. 2015) in latent space, guided by a policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannerConfig {
    /// Model steps of a plan.
    pub horizon: usize,
    /// Candidates per iteration.
    pub samples: usize,
    /// Iterations of a search.
    pub iterations: usize,
    /// Candidates of lowest cost, from which the next mean and standard deviation are computed.
    pub elites: usize,
    /// Candidates that are rollouts of the policy.
    pub proposals: usize,
    /// The smallest standard deviation of the samples, for actions from -1 to 1.
    pub min_std: f32,
    /// The largest standard deviation, with which a search starts.
    pub max_std: f32,
    /// The factor of the cost in the weights `exp(-temperature (cost - lowest cost))`.
    pub temperature: f32,
}

impl PlannerConfig {
    /// Checks the ranges of the settings.
    ///
    /// # Errors
    /// When a setting is out of range; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        check_sizes(&[
            ("online.planner.horizon", self.horizon, 1, limits::FRAMES),
            ("online.planner.samples", self.samples, 1, limits::BATCH),
            ("online.planner.iterations", self.iterations, 1, limits::BATCH),
            ("online.planner.elites", self.elites, 1, limits::BATCH),
        ])?;
        for (name, count) in [("elites", self.elites), ("proposals", self.proposals)] {
            if count > self.samples {
                let given = format!("{count} of {} candidates", self.samples);
                return Err(Error::config(
                    format!("online.planner.{name}"),
                    given,
                    "choose at most online.planner.samples",
                ));
            }
        }
        if !(self.min_std > 0.0 && self.min_std <= self.max_std && self.max_std.is_finite()) {
            let given = format!("from {} to {}", self.min_std, self.max_std);
            return Err(Error::config("online.planner.min_std", given, "choose 0 < min_std <= max_std"));
        }
        if !(self.temperature.is_finite() && self.temperature > 0.0) {
            let fix = "choose a positive value";
            return Err(Error::config("online.planner.temperature", self.temperature.to_string(), fix));
        }
        Ok(())
    }
}
