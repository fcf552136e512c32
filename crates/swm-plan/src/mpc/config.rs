//! [`MpcConfig`]: the planning horizon and the number of steps to execute before replanning.

use crate::search::Settings;
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};
use swm_core::{Error, Result, limits};

/// The planning horizon and the number of steps to execute before replanning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MpcConfig {
    /// Model steps to plan, H.
    pub horizon: usize,
    /// Model steps to execute before planning again; with the value of `horizon`, execution is open loop.
    pub receding_horizon: usize,
    /// Environment steps in one model step (the frameskip the model was trained with). The actions of these steps are
    /// concatenated in a model step's action.
    pub action_block: usize,
    /// Whether the initial guess of a plan is the part of the last plan that was not executed, moved to the first step
    /// and filled up with zeros (the mean action in model units; no preference among choices).
    pub warm_start: bool,
    /// Model steps the model conditions on, the present one included.
    pub history: usize,
    /// Seconds after which solvers stop searching and return the best plan so far. One budget covers the encoding of
    /// the present observation and the search for all environments that are planned together. The first iteration is
    /// always finished. With a budget, results depend on the machine's speed and load.
    pub latency_budget: Option<f64>,
    /// Plans for environments together where the model is faster so: on GPUs. The last bits of a plan may then depend on the other
    /// environments.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub fast: bool,
}

impl Default for MpcConfig {
    /// The setting of the paper's planning experiments: 5 model steps of 5 environment steps, open loop.
    fn default() -> Self {
        Self {
            horizon: 5,
            receding_horizon: 5,
            action_block: 5,
            warm_start: true,
            history: 1,
            latency_budget: None,
            fast: false,
        }
    }
}

/// The largest number of steps of a setting. Plans of more steps would not fit into memory.
const MAX_STEPS: usize = limits::MODEL_STEPS.max;

impl MpcConfig {
    /// Checks the settings.
    ///
    /// # Errors
    /// When a count is 0 or above 10 000, the receding horizon exceeds the horizon, or the latency budget is not a
    /// positive time.
    pub fn check(&self) -> Result<()> {
        let settings = Settings("MPC");
        for (name, steps) in [
            ("horizon", self.horizon),
            ("receding horizon", self.receding_horizon),
            ("action block", self.action_block),
            ("history", self.history),
        ] {
            settings.check((1..=MAX_STEPS).contains(&steps), name, steps, &format!("choose 1 to {MAX_STEPS}"))?;
        }
        settings.check(
            self.receding_horizon <= self.horizon,
            "receding horizon",
            format!("{} model steps to execute, {} planned", self.receding_horizon, self.horizon),
            "choose a receding horizon of at most the horizon",
        )?;
        if let Some(seconds) = self.latency_budget.filter(|seconds| !(seconds.is_finite() && *seconds > 0.0)) {
            return Err(Error::config(
                "MPC latency budget",
                format!("{seconds} seconds"),
                "choose more than 0 seconds, or none for no limit",
            ));
        }
        Ok(())
    }

    /// The time at which a search that starts at `now` has to stop; `None` without a budget, or if the budget exceeds
    /// the range of the clock.
    pub(super) fn deadline(&self, now: Instant) -> Option<Instant> {
        let budget = Duration::try_from_secs_f64(self.latency_budget?).ok()?;
        now.checked_add(budget)
    }
}
