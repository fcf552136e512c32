//! [`Results`]: the results of an evaluation, as written to `results.json` and read by reports.
//!
//! The manifest determines everything except [`Run::timing`]: two equal evaluations write equal results, times aside.

mod counting;
mod paired;
mod prediction;
mod searches;
mod statistics;

pub use counting::Counting;
pub use paired::{Comparison, Paired};
pub use prediction::{Group, Prediction, Trajectory};
pub use searches::{Band, Searches};
pub use statistics::{Proportion, Summary};

use crate::Manifest;
use serde::{Deserialize, Serialize};

/// The content of a `results.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// The provenance.
    pub manifest: Manifest,
    /// The environment's id.
    pub env: String,
    /// The protocol: `episodic` or `dataset`.
    pub protocol: String,
    /// Which episodes count, and what counts as a success.
    #[serde(default)]
    pub counting: Counting,
    /// One entry per policy and condition.
    pub runs: Vec<Run>,
    /// Paired comparisons of policies that played the same starts under the same condition.
    #[serde(default)]
    pub comparisons: Vec<Comparison>,
}

/// The results of one policy under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The condition: `in distribution`, or the shifted factors.
    pub condition: String,
    /// The policy: `random` (the random-policy floor), `expert`, or a checkpoint's name.
    pub policy: String,
    /// Every episode, in order.
    pub episodes: Vec<EpisodeResult>,
    /// The number of episodes that were solved at start.
    pub solved_at_start: usize,
    /// The success rate of the episodes that count.
    pub success: Proportion,
    /// The success rate of the same episodes by strict counting, where they were counted otherwise and one run gives both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strict: Option<Proportion>,
    /// The time to goal of successful episodes, in environment steps.
    pub time_to_goal: Option<Summary>,
    /// Search traces of the planner, if recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub searches: Option<Searches>,
    /// Prediction errors of the model on the trajectories that the starts come from, if requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<Prediction>,
    /// Durations, the only part that differs between equal runs.
    pub timing: Timing,
    /// Paths of videos, relative to the results file.
    #[serde(default)]
    pub videos: Vec<String>,
}

/// The result of one episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// The reset seed.
    pub seed: u64,
    /// Whether it succeeded.
    pub success: bool,
    /// Whether the episode was solved at start.
    pub solved_at_start: bool,
    /// The number of steps played.
    pub steps: usize,
    /// The first step that satisfied the goal, if the goal then had to be held for more steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reached: Option<usize>,
    /// The sum of rewards.
    pub total_reward: f64,
    /// The dataset row of its start, if it started from one: `[episode, step]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<[usize; 2]>,
}

/// Durations of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// The duration of a plan over all plans, in seconds; none for policies that do not plan.
    pub plan_seconds: Option<Summary>,
    /// The duration of the run, in seconds.
    pub wall_seconds: f64,
}

impl Run {
    /// A run of these episodes, with their success rate and time to goal.
    pub fn new(
        condition: &str,
        policy: &str,
        counting: Counting,
        episodes: Vec<EpisodeResult>,
        timing: Timing,
    ) -> Self {
        let counted = || episodes.iter().filter(|episode| counting.counts(episode));
        let steps: Vec<f64> = counted().filter_map(EpisodeResult::time_to_goal).map(|steps| steps as f64).collect();
        Self {
            condition: condition.to_owned(),
            policy: policy.to_owned(),
            solved_at_start: episodes.iter().filter(|episode| episode.solved_at_start).count(),
            success: counting.rate(&episodes),
            strict: None,
            searches: None,
            prediction: None,
            time_to_goal: Summary::of(&steps),
            timing,
            videos: vec![],
            episodes,
        }
    }
}

impl EpisodeResult {
    /// The result of an episode before its first step.
    pub fn new(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// The time to goal in environment steps, if the episode succeeded.
    pub fn time_to_goal(&self) -> Option<usize> {
        self.success.then(|| self.reached.unwrap_or(self.steps))
    }
}
