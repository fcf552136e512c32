//! [`OnlineConfig`]: how playing and learning take turns.

use super::planner_config::PlannerConfig;
use crate::train::config::at_least;
use serde::{Deserialize, Serialize};
use swm_core::Result;

/// How playing and learning take turns: the table `online` of a configuration. The run ends after `schedule.steps` gradient
/// steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnlineConfig {
    /// Worlds that are played side by side. A round is one step of each.
    pub envs: usize,
    /// Gradient steps after a round.
    pub updates: usize,
    /// Environment steps of random play before anything is learnt.
    pub warmup: usize,
    /// Rows of the replay buffer; the oldest episodes leave.
    pub capacity: usize,
    /// Steps after which a part of a running episode goes to the buffer; what is learnt from is that old. Windows that a clip
    /// of several steps would have across two parts are lost.
    pub part: usize,
    /// Gradient steps between two evaluations; 0 never evaluates.
    pub evaluate_every: usize,
    /// Episodes of an evaluation, always the same ones.
    pub evaluate_episodes: usize,
    /// Settings of the search for actions, for a model that plans; without them the model's policy acts directly.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planner: Option<PlannerConfig>,
}

impl OnlineConfig {
    /// Checks that the settings make sense.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        at_least(&[
            ("online.envs", self.envs, 1),
            ("online.updates", self.updates, 1),
            ("online.part", self.part, 1),
            ("online.capacity", self.capacity, self.part + 1),
            ("online.evaluate_episodes", self.evaluate_episodes, 1),
        ])?;
        self.planner.as_ref().map_or(Ok(()), PlannerConfig::check)
    }
}
