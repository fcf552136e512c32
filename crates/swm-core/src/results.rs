//! [`Results`]: the results of an evaluation, as written to `results.json` and read by reports.
//!
//! The manifest determines everything except [`Run::timing`], so two evaluations with equal manifests write results
//! that differ in their timing only.

mod autopsy;
mod betting;
mod breaking;
mod consistency;
mod counting;
mod discrimination;
mod displacement;
mod family;
mod gap;
mod latent_support;
mod paired;
mod played;
mod prediction;
mod probe_scores;
mod ranking;
mod score;
mod searches;
mod seeds;
mod shapley;
mod statistics;
mod stopping;
mod study;
mod table;
mod until;

pub use autopsy::{Arm, ArmRuns, Autopsy, Contribution, Estimate, Finding, Ingredient, Repair, game, letters, members};
pub use breaking::{BreakingPoint, Crossing, Evaluated, Level, Ray, Side};
pub use counting::Counting;
pub use discrimination::{Density, Discrimination, ErrorAndSuccess, Predicts};
pub use displacement::ByDisplacement;
pub use family::{Family, Verdict};
pub use gap::Gap;
pub use latent_support::LatentSupport;
pub use paired::{Comparing, Comparison, MAX_ALL_PAIRS, Paired, pairs};
pub use played::{ClusteredMean, Played, PlayedErrors, PlayedTrajectory};
pub use prediction::{Group, Prediction, Trajectory};
pub use probe_scores::{ProbeScore, ProbeScores};
pub use ranking::{Rank, Ranking};
pub use searches::{Band, Searches};
pub use seeds::{Interquartile, OverSeeds, TRAINING_SEED};
pub use shapley::{Coalition, Game};
pub use statistics::{Proportion, Summary};
pub use stopping::Stopping;
pub use study::{ImageRank, Published, Registration, StudyResults, StudyRow};
pub use table::{StudyTable, TableColumn, TableRow};
pub use until::Until;

use crate::Manifest;
use serde::{Deserialize, Deserializer, Serialize};

/// The content of a `results.json`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// The provenance of the evaluation.
    pub manifest: Manifest,
    /// The id of the environment.
    pub env: String,
    /// The protocol: `episodic` or `dataset`.
    pub protocol: String,
    /// The rule that decides which episodes count and which of them succeed.
    #[serde(default)]
    pub counting: Counting,
    /// One entry per policy and condition.
    pub runs: Vec<Run>,
    /// Paired comparisons of policies that played the same starts under the same condition. Those of versions with
    /// another test are left out.
    #[serde(default, deserialize_with = "of_this_test")]
    pub comparisons: Vec<Comparison>,
    /// Whether the results of a study decided the number of episodes: the intervals and comparisons, which are those of a
    /// fixed number, are not to be shown.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sequential: bool,
    /// How the evaluation ended, if its results decided the number of episodes: its intervals are confidence sequences.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stopping: Option<Stopping>,
}

/// The results of one policy under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Run {
    /// The condition: `in distribution`, or the shifted factors.
    pub condition: String,
    /// The policy: `random` (the random-policy floor), `expert`, or a checkpoint's name.
    pub policy: String,
    /// One result per episode.
    pub episodes: Vec<EpisodeResult>,
    /// The number of episodes that were solved at start.
    pub solved_at_start: usize,
    /// The success rate of the episodes that count.
    pub success: Proportion,
    /// The success rate of `episodes` under [`Counting::Strict`]; present if [`Results::counting`] is not strict
    /// and the episodes determine both rates.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strict: Option<Proportion>,
    /// The time to goal of successful episodes, in environment steps.
    pub time_to_goal: Option<Summary>,
    /// Summaries of the search traces of the planner, if recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub searches: Option<Searches>,
    /// Prediction errors of the model on the trajectories that the starts come from, if requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<Prediction>,
    /// Prediction errors of the model on the trajectories that its policy played, if requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub played: Option<Played>,
    /// Durations. All other fields are equal for equal manifests.
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
    /// Whether the episode succeeded.
    pub success: bool,
    /// Whether the episode was solved at start.
    pub solved_at_start: bool,
    /// The number of steps played.
    pub steps: usize,
    /// The first step that satisfied the goal; present only if the goal had to hold for several steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reached: Option<usize>,
    /// The sum of rewards. JSON has no NaN and no infinite values: they are written as `null`, which is read as NaN.
    #[serde(deserialize_with = "null_is_nan")]
    pub total_reward: f64,
    /// The dataset row of the initial state, `[episode, step]`, if the episode started from a dataset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<[usize; 2]>,
}

/// Durations of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Statistics of the planning time of each plan, in seconds; `None` for policies that do not plan.
    pub plan_seconds: Option<Summary>,
    /// The duration of the run, in seconds.
    pub wall_seconds: f64,
}

impl Run {
    /// Creates a run from its episodes, and computes their success rate and time to goal.
    pub fn new(
        condition: &str,
        policy: &str,
        counting: Counting,
        episodes: Vec<EpisodeResult>,
        timing: Timing,
    ) -> Self {
        let (solved_at_start, success, time_to_goal) = Self::statistics(counting, &episodes);
        Self {
            condition: condition.to_owned(),
            policy: policy.to_owned(),
            solved_at_start,
            success,
            strict: None,
            searches: None,
            prediction: None,
            played: None,
            time_to_goal,
            timing,
            videos: vec![],
            episodes,
        }
    }

    /// Returns the statistics that episodes determine: the number solved at start, the success rate, the time to goal.
    fn statistics(counting: Counting, episodes: &[EpisodeResult]) -> (usize, Proportion, Option<Summary>) {
        let counted = episodes.iter().filter(|episode| counting.counts(episode));
        let steps: Vec<f64> = counted.filter_map(EpisodeResult::time_to_goal).map(|steps| steps as f64).collect();
        let solved_at_start = episodes.iter().filter(|episode| episode.solved_at_start).count();
        (solved_at_start, counting.rate(episodes), Summary::of(&steps))
    }
}

fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Option::deserialize(deserializer).map(|value| value.unwrap_or(f64::NAN))
}

fn of_this_test<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Comparison>, D::Error> {
    #[derive(Deserialize)]
    #[serde(untagged)]
    enum Stated {
        Current(Comparison),
        Older {
            #[serde(default, rename = "verdict")]
            _verdict: Option<()>,
        },
    }
    let current = |stated| match stated {
        Stated::Current(comparison) => Some(comparison),
        Stated::Older { .. } => None,
    };
    Ok(Vec::deserialize(deserializer)?.into_iter().filter_map(current).collect())
}

impl EpisodeResult {
    /// Creates the result of an episode that has not been stepped yet.
    pub fn new(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// The time to goal in environment steps, if the episode succeeded.
    pub fn time_to_goal(&self) -> Option<usize> {
        self.success.then(|| self.reached.unwrap_or(self.steps))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comparisons_of_another_test_are_left_out() {
        let table = Paired::of(1, 2, 3, 4);
        let comparison = Comparison { condition: "red".to_owned(), a: "x".to_owned(), b: "y".to_owned(), table };
        let results = Results { comparisons: vec![comparison.clone(), comparison], ..Results::default() };
        let mut value = serde_json::to_value(&results).expect("a document");
        assert_eq!(serde_json::from_value::<Results>(value.clone()).expect("results"), results);
        value["comparisons"][0].as_object_mut().and_then(|stated| stated.remove("verdict")).expect("a verdict");
        let older: Results = serde_json::from_value(value.clone()).expect("results");
        assert_eq!(older.comparisons, results.comparisons[1..]);
        value["comparisons"][1]["verdict"] = "perhaps".into();
        assert!(serde_json::from_value::<Results>(value).is_err());
    }

    #[test]
    fn rewards_that_are_not_finite_can_be_read_back() {
        for reward in [f64::NAN, f64::INFINITY, -2.5] {
            let text = serde_json::to_string(&EpisodeResult { total_reward: reward, ..EpisodeResult::new(1) });
            let text = text.expect("a document");
            let read: EpisodeResult = serde_json::from_str(&text).expect("an episode");
            assert_eq!(read.total_reward.is_finite(), reward.is_finite(), "{text}");
            assert_eq!(serde_json::to_string(&read).expect("a document"), text);
        }
        let missing = serde_json::json!({"seed": 1, "success": true, "solved_at_start": false, "steps": 3});
        assert!(serde_json::from_value::<EpisodeResult>(missing).is_err());
    }
}
