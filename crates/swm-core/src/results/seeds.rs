//! [`OverSeeds`]: the success of one way of training over several training seeds.

use super::{Counting, StudyRow};
use crate::Key;
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, StudentsT};
use std::collections::{BTreeMap, BTreeSet};

/// The variable of a study that holds the training seed of a policy.
pub const TRAINING_SEED: &str = "training-seed";

/// The smallest number of scores that have an interquartile mean.
const MIN_SCORES: usize = 8;
/// The number of resamples of the bootstrap.
const RESAMPLES: usize = 10_000;

/// The success rates of one policy that was trained with several seeds, under one condition or under all shifted ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OverSeeds {
    /// The name of the source of starts.
    pub starts: String,
    /// The condition; `None` for all shifted conditions together.
    pub condition: Option<String>,
    /// The name of the policy with `*` for the training seed.
    pub policy: String,
    /// The rule for counting episodes.
    pub counting: Counting,
    /// The seed of the evaluation.
    pub seed: u64,
    /// The success rate of each training seed, by seed; over all shifted conditions, their mean.
    pub scores: Vec<(String, f64)>,
    /// The mean of the scores.
    pub mean: f64,
    /// The interval that holds the score of one further training seed with a probability of 95 % if scores are normally
    /// distributed: the mean ± t s √(1 + 1/n) with n - 1 degrees of freedom, within [0, 1].
    pub new_seed: [f64; 2],
    /// The interquartile mean; `None` for fewer than eight scores.
    pub interquartile: Option<Interquartile>,
}

/// An interquartile mean with its 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interquartile {
    /// The mean of the scores of all training seeds and conditions without the lowest and the highest quarter.
    pub mean: f64,
    /// The lower end: a percentile of the bootstrap, which resamples the seeds of each condition (Agarwal et al., "Deep
    /// reinforcement learning at the edge of the statistical precipice", 2021).
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

/// What rows have in common that differ in the condition and in the training seed only.
type Group<'a> = (&'a str, &'a str, String, u64);

impl OverSeeds {
    /// Takes rows together that differ in the training seed only: each condition with at least two training seeds, and,
    /// where all conditions have the same training seeds, all conditions but the `unshifted` one.
    pub fn all(rows: &[StudyRow], unshifted: &str) -> Vec<Self> {
        let mut groups: Vec<(Group<'_>, Vec<&StudyRow>)> = vec![];
        for row in rows {
            let Some(policy) = &row.any_seed else { continue };
            let group = (row.starts.as_str(), policy.as_str(), row.counting.to_string(), row.seed);
            match groups.iter_mut().find(|(known, _)| *known == group) {
                Some((_, members)) => members.push(row),
                None => groups.push((group, vec![row])),
            }
        }
        groups.iter().flat_map(|(_, members)| of_group(members, unshifted)).collect()
    }

    /// The scores of some conditions; `None` unless all conditions have the same training seeds, at least two, and episodes that count.
    fn of(conditions: &[&Condition<'_>], condition: Option<&str>) -> Option<Self> {
        let (_, first) = conditions.first()?;
        let row = first.values().next()?;
        let seeds: Vec<&str> = first.keys().copied().collect();
        if seeds.len() < 2 || conditions.iter().any(|(_, rows)| !rows.keys().eq(first.keys())) {
            return None;
        }
        if conditions.iter().flat_map(|(_, rows)| rows.values()).any(|row| row.success.n == 0) {
            return None;
        }
        let tasks: Vec<Vec<f64>> =
            conditions.iter().map(|(_, rows)| rows.values().map(|row| row.success.rate).collect()).collect();
        let of_seed = |i: usize| mean(tasks.iter().map(|runs| runs[i]));
        let scores: Vec<f64> = (0..seeds.len()).map(of_seed).collect();
        let policy = row.any_seed.clone()?;
        let key = Key::new(row.seed).with("over seeds").with(&policy).with(&row.starts);
        let key = key.with(&row.counting.to_string()).with(condition.unwrap_or_default());
        Some(Self {
            starts: row.starts.clone(),
            condition: condition.map(str::to_owned),
            policy,
            counting: row.counting,
            seed: row.seed,
            mean: mean(scores.iter().copied()),
            new_seed: new_seed(&scores),
            scores: seeds.iter().map(|seed| (*seed).to_owned()).zip(scores).collect(),
            interquartile: Interquartile::of(&tasks, key),
        })
    }
}

/// The name of a condition, and its rows by training seed.
type Condition<'a> = (&'a str, BTreeMap<&'a str, &'a StudyRow>);

/// The rows of a group over training seeds: each condition, then all shifted conditions together.
fn of_group(rows: &[&StudyRow], unshifted: &str) -> Vec<OverSeeds> {
    let mut conditions: Vec<Condition<'_>> = vec![];
    let mut ambiguous: BTreeSet<&str> = BTreeSet::new();
    for row in rows {
        let Some(seed) = row.variables.get(TRAINING_SEED) else { continue };
        let at = conditions.iter().position(|(name, _)| *name == row.condition).unwrap_or_else(|| {
            conditions.push((&row.condition, BTreeMap::new()));
            conditions.len() - 1
        });
        // Rows that differ in a variable that their names do not show cannot be taken together.
        if conditions[at].1.insert(seed, row).is_some() {
            ambiguous.insert(&row.condition);
        }
    }
    conditions.retain(|(name, _)| !ambiguous.contains(name));
    let mut found: Vec<OverSeeds> =
        conditions.iter().filter_map(|condition| OverSeeds::of(&[condition], Some(condition.0))).collect();
    let shifted: Vec<&Condition<'_>> = conditions.iter().filter(|(name, _)| *name != unshifted).collect();
    if shifted.len() > 1 && ambiguous.is_empty() {
        found.extend(OverSeeds::of(&shifted, None));
    }
    found
}

impl Interquartile {
    /// The interquartile mean of the scores of each task; `None` for fewer than [`MIN_SCORES`] scores.
    fn of(tasks: &[Vec<f64>], key: Key) -> Option<Self> {
        let mut all: Vec<f64> = tasks.concat();
        if all.len() < MIN_SCORES {
            return None;
        }
        let mean = interquartile_mean(&mut all);
        let mut rng = key.rng();
        let mut resampled: Vec<f64> = (0..RESAMPLES)
            .map(|_| {
                all.clear();
                for runs in tasks {
                    all.extend((0..runs.len()).map(|_| runs[rng.random_range(0..runs.len())]));
                }
                interquartile_mean(&mut all)
            })
            .collect();
        resampled.sort_by(f64::total_cmp);
        Some(Self { mean, low: percentile(&resampled, 0.025), high: percentile(&resampled, 0.975) })
    }
}

/// Returns the mean without the lowest and the highest quarter, each rounded down to whole scores. Sorts the scores.
fn interquartile_mean(scores: &mut [f64]) -> f64 {
    scores.sort_by(f64::total_cmp);
    let cut = scores.len() / 4;
    mean(scores[cut..scores.len() - cut].iter().copied())
}

/// Returns the percentile of sorted values, interpolated linearly.
fn percentile(sorted: &[f64], share: f64) -> f64 {
    let at = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[at.floor() as usize], sorted[at.ceil() as usize]);
    below + (above - below) * at.fract()
}

fn mean(values: impl Iterator<Item = f64> + Clone) -> f64 {
    values.clone().sum::<f64>() / values.count().max(1) as f64
}

/// Returns the interval for the score of one further seed.
fn new_seed(scores: &[f64]) -> [f64; 2] {
    let (n, centre) = (scores.len() as f64, mean(scores.iter().copied()));
    let variance = scores.iter().map(|score| (score - centre).powi(2)).sum::<f64>() / (n - 1.0);
    let half = t_quantile(n - 1.0) * (variance * (1.0 + 1.0 / n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

/// Returns the 97.5th percentile of Student's t distribution.
fn t_quantile(freedom: f64) -> f64 {
    StudentsT::new(0.0, 1.0, freedom).map_or(f64::INFINITY, |t| t.inverse_cdf(0.975))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::Proportion;

    #[test]
    fn interquartile_means_equal_those_of_rliable() {
        // aggregate_iqm of rliable 1.2.0 (scipy 1.17.1), and its percentile interval of 50,000 resamples, which differs
        // from run to run by its simulation error.
        let two = vec![vec![0.42, 0.38, 0.55, 0.44, 0.9], vec![0.50, 0.61, 0.47, 0.58, 0.1]];
        let one = vec![vec![0.42, 0.38, 0.55, 0.44, 0.47, 0.61, 0.05, 0.52, 0.40, 0.99]];
        for (tasks, mean, low, high) in
            [(two, 0.49333333333333335, 0.38666667, 0.59833333), (one, 0.4666666666666666, 0.36, 0.6)]
        {
            let found = Interquartile::of(&tasks, Key::new(1)).expect("ten scores");
            assert!((found.mean - mean).abs() < 1e-9, "{found:?}");
            assert!((found.low - low).abs() < 0.01 && (found.high - high).abs() < 0.01, "{found:?}");
            assert_eq!(Interquartile::of(&tasks, Key::new(1)), Some(found));
        }
        assert_eq!(Interquartile::of(&[vec![0.5; 7]], Key::new(1)), None);
        assert_eq!(percentile(&[1.0, 2.0, 4.0], 0.75), 3.0);
    }

    #[test]
    fn quantiles_of_student_and_prediction_intervals_equal_those_of_scipy() {
        // scipy.stats.t.ppf(0.975, n) of scipy 1.17.1.
        for (freedom, quantile) in [
            (1.0, 12.706204736174694),
            (2.0, 4.302652729749462),
            (3.0, 3.1824463052837078),
            (4.0, 2.7764451051977934),
            (7.0, 2.364624251592784),
            (9.0, 2.262157162798205),
            (29.0, 2.045229642132703),
            (100.0, 1.9839715185235518),
        ] {
            assert!((t_quantile(freedom) - quantile).abs() < 1e-9, "{freedom}: {}", t_quantile(freedom));
        }
        let [low, high] = new_seed(&[0.42, 0.38, 0.55, 0.44]);
        assert!((low - (0.4475 - 0.25882864039703884)).abs() < 1e-9 && (high + low - 2.0 * 0.4475).abs() < 1e-9);
        assert_eq!(new_seed(&[0.0, 1.0]), [0.0, 1.0]);
    }

    fn row(condition: &str, seed: usize, successes: usize) -> StudyRow {
        StudyRow {
            cell: format!("{condition} {seed}"),
            starts: "test".to_owned(),
            condition: condition.to_owned(),
            variables: BTreeMap::from([(TRAINING_SEED.to_owned(), seed.to_string())]),
            policy: format!("LeWM {seed}"),
            any_seed: Some("LeWM *".to_owned()),
            counting: Counting::default(),
            seed: 0,
            success: Proportion::wilson(successes, 10),
            solved_at_start: 0,
            floor: Proportion::wilson(0, 10),
            gap: None,
            trained_on_starts: None,
            image_distance: None,
            prediction: None,
            played: None,
            by_displacement: vec![],
        }
    }

    #[test]
    fn rows_that_differ_in_the_training_seed_are_taken_together() {
        let mut rows: Vec<StudyRow> = vec![];
        for (condition, shift) in [("plain", 4), ("red", 2), ("blue", 0)] {
            rows.extend((0..4).map(|seed| row(condition, seed, shift + seed)));
        }
        rows.push(StudyRow { any_seed: None, policy: "simulator".to_owned(), ..row("plain", 0, 9) });
        let found = OverSeeds::all(&rows, "plain");
        let names: Vec<_> = found.iter().map(|over| (over.condition.as_deref(), over.scores.len())).collect();
        assert_eq!(names, [(Some("plain"), 4), (Some("red"), 4), (Some("blue"), 4), (None, 4)]);
        assert!((found[0].mean - 0.55).abs() < 1e-12 && found[0].interquartile.is_none());
        let shifted = &found[3];
        assert!(shifted.scores[1].0 == "1" && (shifted.scores[1].1 - 0.2).abs() < 1e-12);
        assert!((shifted.mean - 0.25).abs() < 1e-12);
        // 0, 1, 2, 2, 3, 3, 4, 5 tenths without the two lowest and the two highest.
        assert!((shifted.interquartile.expect("eight scores").mean - 0.25).abs() < 1e-12);
        // A cell that is not done yet leaves its condition with fewer seeds.
        rows.remove(5);
        let fewer = OverSeeds::all(&rows, "plain");
        assert_eq!(fewer.iter().map(|over| over.scores.len()).collect::<Vec<_>>(), [4, 3, 4]);
        // Of no episodes there is no score.
        let unplayed = |row: &StudyRow| StudyRow { success: Proportion::wilson(0, 0), ..row.clone() };
        assert!(OverSeeds::all(&rows.iter().map(unplayed).collect::<Vec<_>>(), "plain").is_empty());
        // Two rows of one seed cannot be told from each other.
        rows.push(row("plain", 0, 1));
        assert_eq!(OverSeeds::all(&rows, "plain").len(), 2);
    }
}
