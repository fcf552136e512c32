//! [`StudyResults`]: the success rates of all cells of a study, as read by tables and reports.

use super::{
    BreakingPoint, ByDisplacement, Counting, ErrorAndSuccess, Family, OverSeeds, Paired, PlayedErrors, Proportion,
    Until,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// The outcomes of a study: one row for each policy in each cell that is done.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct StudyResults {
    /// The title of the study.
    pub title: String,
    /// The question that the study asks.
    pub question: String,
    /// The BLAKE3 hash of the study: of all its requests and their inputs.
    pub hash: String,
    /// The number of cells.
    pub cells: usize,
    /// The number of cells with results.
    pub done: usize,
    /// The rows, in the order of the cells.
    pub rows: Vec<StudyRow>,
    /// The families of the gaps, by name.
    #[serde(default)]
    pub families: Vec<Family>,
    /// Rows that differ in the training seed only, taken together.
    #[serde(default)]
    pub over_seeds: Vec<OverSeeds>,
    /// The rule that ends the study, if its results decide the numbers of episodes. All intervals are confidence sequences
    /// then, and verdicts follow e-values; statistics that hold for a fixed number only are left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub until: Option<Until>,
    /// Where success breaks, for each policy of a study along a ray.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub breaking: Vec<BreakingPoint>,
    /// The registration of the study before its results; `None` if it was not registered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub registration: Option<Registration>,
}

/// A shifted condition among all, by how much it changes the first frames.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageRank<'a> {
    /// The condition.
    pub condition: &'a str,
    /// The mean absolute difference of the first frames' values, from 0 to 255.
    pub distance: f64,
    /// The gap of each policy, from -1 to 1.
    pub gaps: BTreeMap<&'a str, f64>,
}

/// What was registered before the first result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Registration {
    /// The BLAKE3 hash of the question, all cells with their inputs, and the families.
    pub hash: String,
    /// Whether the study is still the registered one.
    pub is_same: bool,
    /// The date that the clock of the registering machine showed, in UTC. It proves nothing: a published hash does. `None` for
    /// registrations of older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub date: Option<String>,
}

impl fmt::Display for Registration {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { hash, is_same, date } = self;
        f.write_str(if *is_same {
            "was registered before its first result as "
        } else {
            "differs from its registration "
        })?;
        f.write_str(hash)?;
        date.as_ref().map_or(Ok(()), |date| {
            write!(f, " (date unproven: the clock of that machine showed {date}; a published hash proves a date)")
        })
    }
}

impl StudyResults {
    /// Ranks the shifted conditions by how much they change the first frames, the largest change first. Conditions of several
    /// sources of starts, seeds or rules for counting have the mean of their rows.
    pub fn by_image_distance(&self) -> Vec<ImageRank<'_>> {
        let mut conditions: BTreeMap<&str, Vec<&StudyRow>> = BTreeMap::new();
        for row in self.rows.iter().filter(|row| row.image_distance.is_some()) {
            conditions.entry(&row.condition).or_default().push(row);
        }
        let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        let mut ranks: Vec<ImageRank<'_>> = vec![];
        for (condition, rows) in conditions {
            let mut gaps: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
            for row in &rows {
                gaps.entry(&row.policy).or_default().extend(row.gap.map(|gap| gap.difference));
            }
            let gaps = gaps.into_iter().filter_map(|(policy, gaps)| Some((policy, mean(&gaps)?))).collect();
            let distances: Vec<f64> = rows.iter().filter_map(|row| row.image_distance).collect();
            ranks.extend(mean(&distances).map(|distance| ImageRank { condition, distance, gaps }));
        }
        ranks.sort_by(|a, b| b.distance.total_cmp(&a.distance));
        ranks
    }

    /// What the rule that ends the study means for its statistics, and how many rows of a study that is done did not meet it.
    /// Nothing without a rule.
    pub fn notes_on_rule(&self) -> Vec<String> {
        let Some(until) = self.until else { return vec![] };
        let mut notes = vec![format!(
            "The study ran until {until}: intervals are confidence sequences and p-values are 1 / e, so they hold although \
             the results decided the numbers of episodes."
        )];
        let unmet = self.rows.iter().filter(|row| !until.is_met(row)).count();
        if unmet > 0 && self.done == self.cells {
            let rows = self.rows.len();
            notes.push(format!("{unmet} of {rows} rows have the largest number of episodes and do not meet {until}."));
        }
        notes
    }
}

/// The outcome of one policy under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StudyRow {
    /// The id of the cell.
    pub cell: String,
    /// The name of the source of starts.
    pub starts: String,
    /// The name of the condition.
    pub condition: String,
    /// The values of the variables in the condition and in the policy, such as `count` of `{count} occluders`.
    pub variables: BTreeMap<String, String>,
    /// The policy.
    pub policy: String,
    /// The name of the policy with `*` for its training seed, if it has the variable
    /// [`TRAINING_SEED`](super::TRAINING_SEED).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub any_seed: Option<String>,
    /// The rule for counting episodes.
    pub counting: Counting,
    /// The seed.
    pub seed: u64,
    /// The success rate.
    pub success: Proportion,
    /// The number of episodes that were solved at start.
    pub solved_at_start: usize,
    /// The success rate of the random-policy floor on the same starts.
    pub floor: Proportion,
    /// The shifted minus the unshifted success rate of this policy on the same starts: the first condition of the study
    /// is unshifted. Corrected for the comparisons of its family. `None` for that condition, and where the starts differ.
    pub gap: Option<Paired>,
    /// Whether the policy was trained on episodes that the starts come from; `None` where this is not known, or the starts were
    /// not recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trained_on_starts: Option<bool>,
    /// The mean absolute difference between the values of the first frames under this and under the first condition, from the
    /// same starts: from 0 to 255. `None` for that condition, without frames, and before it is measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image_distance: Option<f64>,
    /// The model's prediction errors on the recorded trajectories that the starts come from, by success, if requested.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prediction: Option<ErrorAndSuccess>,
    /// The same for the trajectories that the policy played, and the optimism of the model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub played: Option<PlayedErrors>,
    /// The same for near and for far goals, if they are known.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub by_displacement: Vec<ByDisplacement>,
}

/// A success rate that a publication states.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Published {
    /// The source of starts, as the study names it; `None` for the first one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub starts: Option<String>,
    /// The condition, as the study names it.
    pub condition: String,
    /// The policy, which may be one that the study does not evaluate.
    pub policy: String,
    /// The success rate, from 0 to 1.
    pub rate: f64,
    /// Where the rate is stated.
    pub source: String,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{EpisodeResult, Run, Timing};

    #[test]
    fn registrations_say_that_their_dates_are_unproven() {
        let date = Some("2026-11-26T17:00:00Z".to_owned());
        let dated = Registration { hash: "abc".to_owned(), is_same: true, date };
        assert!(
            dated.to_string().contains("as abc (date unproven: the clock of that machine showed 2026-11-26T17:00:00Z")
        );
        let older: Registration = serde_json::from_str("{\"hash\": \"abc\", \"is_same\": false}").expect("a document");
        assert_eq!(older.to_string(), "differs from its registration abc");
    }

    #[test]
    fn starts_count_that_count_under_both_conditions() {
        let run = |condition: &str, outcomes: [(bool, bool); 4]| {
            let episodes = outcomes.iter().zip(0..).map(|(&(success, solved_at_start), seed)| EpisodeResult {
                success,
                solved_at_start,
                ..EpisodeResult::new(seed)
            });
            Run::new(condition, "model", Counting::default(), episodes.collect(), Timing::default())
        };
        let plain = run("in distribution", [(true, false), (true, false), (true, true), (false, false)]);
        let shifted = run("red", [(true, false), (false, false), (false, false), (false, true)]);
        let gap = Paired::of_runs(&shifted, &plain, Counting::default()).expect("two starts count");
        assert_eq!([gap.both, gap.only_a, gap.only_b, gap.neither], [1, 0, 1, 0]);
        assert!((gap.difference + 0.5).abs() < 1e-12);
        let mut other = shifted.clone();
        other.episodes[0].seed = 9;
        assert!(Paired::of_runs(&other, &plain, Counting::default()).is_none(), "other starts");
    }
}
