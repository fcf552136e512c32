//! [`OnlineConfig`]: the settings of online training.

use super::planner_config::PlannerConfig;
use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::Result;

/// The settings of online training: the table `online` of a configuration. The run ends after `schedule.steps`
/// optimizer steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OnlineConfig {
    /// Environments that run at the same time. A round is one step of every environment.
    pub envs: usize,
    /// Optimizer steps after each round.
    pub updates: usize,
    /// Environment steps with random actions before the first optimizer step.
    pub warmup: usize,
    /// Rows of the replay buffer; the oldest episodes are dropped first.
    pub capacity: usize,
    /// Steps of a segment, after which the rows of a running episode go to the replay buffer. No clip of
    /// several steps spans two segments.
    #[serde(rename = "part")]
    pub segment: usize,
    /// Optimizer steps between two evaluations; 0 for none.
    pub evaluate_every: usize,
    /// The number of episodes of an evaluation; all evaluations run the same episodes.
    pub evaluate_episodes: usize,
    /// The planner that selects actions; `None` executes the actions of the policy network.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub planner: Option<PlannerConfig>,
}

impl OnlineConfig {
    /// Checks the ranges of the settings.
    ///
    /// # Errors
    /// When a setting is out of range; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        check_sizes(&[
            ("online.envs", self.envs, 1, limits::ENVS),
            ("online.updates", self.updates, 1, limits::BATCH),
            ("online.part", self.segment, 1, limits::STEPS),
            ("online.capacity", self.capacity, self.segment.saturating_add(1), limits::STEPS),
            ("online.evaluate_episodes", self.evaluate_episodes, 1, limits::BATCH),
        ])?;
        self.planner.as_ref().map_or(Ok(()), PlannerConfig::check)
    }
}
