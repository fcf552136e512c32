//! [`Results`]: what an evaluation found, as written to `results.json` and read by reports.
//!
//! Everything but [`Run::timing`] is decided by the manifest: two equal evaluations write equal results,
//! latencies aside.

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
    /// Where the numbers came from.
    pub manifest: Manifest,
    /// The environment.
    pub env: String,
    /// The protocol: `episodic` or `dataset`.
    pub protocol: String,
    /// Which episodes count, and as what.
    #[serde(default)]
    pub counting: Counting,
    /// One entry a policy and condition.
    pub runs: Vec<Run>,
    /// Every pair of policies that played the same starts under the same condition.
    #[serde(default)]
    pub comparisons: Vec<Comparison>,
}

/// One policy under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The condition: `in distribution`, or what was shifted.
    pub condition: String,
    /// Who acted: `random` (the floor), `expert`, or a checkpoint's name.
    pub policy: String,
    /// Every episode, in order.
    pub episodes: Vec<EpisodeResult>,
    /// Starts that already satisfied the goal.
    pub solved_at_start: usize,
    /// The success rate of the episodes that count.
    pub success: Proportion,
    /// What the strict counting says of the same episodes, where they were counted otherwise and one run tells both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strict: Option<Proportion>,
    /// Steps to the goal among successes.
    pub time_to_goal: Option<Summary>,
    /// How the searches behind its plans went, where that was traced.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub searches: Option<Searches>,
    /// How well its model predicts the trajectories the starts were taken from, where that was asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<Prediction>,
    /// How long it took: the only part that differs between equal runs.
    pub timing: Timing,
    /// Videos, as paths relative to the results file.
    #[serde(default)]
    pub videos: Vec<String>,
}

/// One episode.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Its seed.
    pub seed: u64,
    /// Whether it succeeded.
    pub success: bool,
    /// Whether the start already satisfied the goal.
    pub solved_at_start: bool,
    /// Steps played.
    pub steps: usize,
    /// The step that reached the goal, where it then had to be held and the episode went on.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reached: Option<usize>,
    /// The sum of rewards.
    pub total_reward: f64,
    /// Where it started in a dataset, if it did: `[episode, step]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<[usize; 2]>,
}

/// How long it took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Seconds one plan took, over all plans; none for policies that do not plan.
    pub plan_seconds: Option<Summary>,
    /// Seconds the whole run took.
    pub wall_seconds: f64,
}

impl Run {
    /// A run of these episodes, counted.
    #[allow(clippy::cast_precision_loss)]
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
    /// An episode that is still to be played.
    pub fn new(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// Steps to the goal, if it succeeded.
    pub fn time_to_goal(&self) -> Option<usize> {
        self.success.then(|| self.reached.unwrap_or(self.steps))
    }
}
