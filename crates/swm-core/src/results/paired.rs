//! [`Comparison`]: a paired comparison of two policies on the same starts.
//!
//! Starts differ in difficulty. A paired test removes this variance: it depends only on the starts that exactly one of
//! the policies solves.

use super::{Counting, EpisodeResult, Family, Run, Verdict, betting, score};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A paired comparison of two runs: [`Paired::of_runs`], or [`Paired::sequential`] where the outcomes decide how many episodes
/// there are.
pub type Comparing = fn(&Run, &Run, Counting) -> Option<Paired>;

/// A paired comparison of two policies under one condition.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The condition.
    pub condition: String,
    /// The first policy.
    pub a: String,
    /// The second policy.
    pub b: String,
    /// The outcomes of all starts that count.
    #[serde(flatten)]
    pub table: Paired,
}

/// Counts of paired outcomes, the test of equal success rates, and the interval of their difference.
///
/// The test is the score test, and the interval its inversion (Tango 1998), so that the interval excludes 0 exactly if
/// the test rejects. Both are corrected for the number of comparisons of the family ([`Family::correct`]). Where the outcomes
/// decide how many pairs there are, the test is an e-process, and the interval its inversion ([`Paired::sequential`]).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Paired {
    /// Starts that both policies solved.
    pub both: usize,
    /// Starts that only the first policy solved.
    pub only_a: usize,
    /// Starts that only the second policy solved.
    pub only_b: usize,
    /// Starts that neither policy solved.
    pub neither: usize,
    /// The two-sided p-value of the score test, or 1 / `e`, not corrected. The null hypothesis is that `only_a` and `only_b`
    /// are equally likely outcomes of the starts that exactly one policy solved.
    pub p: f64,
    /// The e-value of the null hypothesis, if the outcomes decided how many pairs there are; `None` for a fixed number.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub e: Option<f64>,
    /// Holm's adjusted p-value in the family. It may be below 5 % where `verdict`, which follows the interval, tells
    /// nothing apart.
    pub p_holm: f64,
    /// The number of comparisons of the family.
    pub comparisons: usize,
    /// The variance of the difference relative to that of independent starts: starts from one recorded episode form a
    /// cluster. At least 1, which it is without clusters.
    pub design_effect: f64,
    /// The success rate of the first policy minus the success rate of the second.
    pub difference: f64,
    /// The lower end of the interval of the difference. The intervals of a family hold simultaneously with a probability
    /// of 95 %.
    pub low: f64,
    /// The upper end of the interval of the difference.
    pub high: f64,
    /// What the interval says about the success rate of the first policy.
    pub verdict: Verdict,
}

impl Comparison {
    /// Compares two runs of one condition, as a family of one comparison; `None` if they did not play the same starts.
    pub fn of(a: &Run, b: &Run, counting: Counting) -> Option<Self> {
        Self::by(Paired::of_runs, a, b, counting)
    }

    /// Compares two runs as [`Comparison::of`] does, with another comparison.
    pub fn by(compare: Comparing, a: &Run, b: &Run, counting: Counting) -> Option<Self> {
        let mut pairs = a.episodes.iter().zip(&b.episodes);
        let same = a.condition == b.condition && pairs.all(|(a, b)| a.solved_at_start == b.solved_at_start);
        let table = same.then(|| compare(a, b, counting)).flatten()?;
        Some(Self { condition: a.condition.clone(), a: a.policy.clone(), b: b.policy.clone(), table })
    }

    /// Compares every run with each earlier run of the same condition, so that a learned policy is compared with the
    /// random-policy floor as `learned` minus `random`. A condition with many runs is limited as [`pairs`] says. The
    /// comparisons of one condition form a family.
    pub fn all(runs: &[Run], counting: Counting) -> Vec<Self> {
        Self::all_by(Paired::of_runs, runs, counting)
    }

    /// Compares runs as [`Comparison::all`] does, with another comparison.
    pub fn all_by(compare: Comparing, runs: &[Run], counting: Counting) -> Vec<Self> {
        let mut conditions: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (i, run) in runs.iter().enumerate() {
            conditions.entry(&run.condition).or_default().push(i);
        }
        let mut found: Vec<(usize, usize)> = vec![];
        for indices in conditions.values() {
            let members: Vec<&Run> = indices.iter().map(|&i| &runs[i]).collect();
            found.extend(pairs(&members).map(|(later, earlier)| (indices[later], indices[earlier])));
        }
        found.sort_unstable();
        let compared = found.into_iter().filter_map(|(a, b)| Self::by(compare, &runs[a], &runs[b], counting));
        let mut compared: Vec<Self> = compared.collect();
        Self::families(&mut compared);
        compared
    }

    /// Corrects comparisons for their number: those of one condition form a family. Returns the families by condition.
    pub fn families(comparisons: &mut [Self]) -> Vec<Family> {
        let mut conditions: BTreeMap<&str, Vec<&mut Paired>> = BTreeMap::new();
        for Self { condition, table, .. } in comparisons {
            conditions.entry(condition).or_default().push(table);
        }
        let corrected = |(condition, mut tables): (&str, Vec<&mut Paired>)| Family::correct(condition, &mut tables, 0);
        conditions.into_iter().filter_map(corrected).collect()
    }
}

/// The largest number of runs of one condition whose pairs are all compared.
pub const MAX_ALL_PAIRS: usize = 20;

/// Returns the indices of the runs of one condition to compare, the later run first: every pair of at most
/// [`MAX_ALL_PAIRS`] runs. The pairs of more runs are too many to read or to store, so each of these runs is compared
/// with the random-policy floor and with the run of the highest success rate only.
pub fn pairs(runs: &[&Run]) -> impl Iterator<Item = (usize, usize)> {
    let floor = runs.iter().position(|run| run.policy == "random");
    let rate = |i: &usize| runs[*i].success.rate;
    // `max_by` returns the last maximum; the order is reversed so that the first of equal runs is the best.
    let best = (0..runs.len()).rev().filter(|i| Some(*i) != floor).max_by(|a, b| rate(a).total_cmp(&rate(b)));
    let every = runs.len() <= MAX_ALL_PAIRS;
    let is_reference = move |i: usize| every || Some(i) == floor || Some(i) == best;
    let all = (0..runs.len()).flat_map(|later| (0..later).map(move |earlier| (later, earlier)));
    all.filter(move |&(later, earlier)| is_reference(later) || is_reference(earlier))
}

impl Paired {
    /// Compares the outcomes of two runs on the same starts, whose conditions or policies differ. A start counts if it
    /// counts in both runs. `None` if the runs did not play the same starts, or no start counts.
    pub fn of_runs(a: &Run, b: &Run, counting: Counting) -> Option<Self> {
        Self::of_episodes(&a.episodes, &b.episodes, counting)
    }

    fn of_episodes(a: &[EpisodeResult], b: &[EpisodeResult], counting: Counting) -> Option<Self> {
        let pairs = || a.iter().zip(b);
        let same = a.len() == b.len() && pairs().all(|(a, b)| (a.seed, a.start) == (b.seed, b.start));
        let mut counts = [0; 4];
        // The excess of the first policy in each recorded episode; a start without one is a cluster of its own.
        let mut clusters: BTreeMap<(Option<usize>, usize), i64> = BTreeMap::new();
        for (i, (a, b)) in pairs().enumerate().filter(|(_, (a, b))| counting.counts(a) && counting.counts(b)) {
            counts[2 * usize::from(!a.success) + usize::from(!b.success)] += 1;
            let cluster = a.start.map_or((None, i), |[episode, _]| (Some(episode), 0));
            *clusters.entry(cluster).or_default() += i64::from(a.success) - i64::from(b.success);
        }
        let [_, only_a, only_b, _] = counts;
        let design_effect = score::design_effect(clusters.into_values(), only_a + only_b);
        (same && counts != [0; 4]).then(|| Self::with_design_effect(counts, design_effect))
    }

    /// The statistics of a table of independent paired outcomes, as a family of one comparison.
    pub fn of(both: usize, only_a: usize, only_b: usize, neither: usize) -> Self {
        Self::with_design_effect([both, only_a, only_b, neither], 1.0)
    }

    /// Compares two runs whose numbers of episodes the results decided, on the starts that both have: the first ones. As
    /// [`Paired::of_runs`], but with statistics that hold at every number of pairs: the e-value of a bet on the pairs that
    /// differ (`betting`), and the confidence sequence of the difference.
    ///
    /// Starts count as independent: no two of them come from one recorded episode, which [`Results::check`](super::Results::check)
    /// makes sure of.
    pub fn sequential(a: &Run, b: &Run, counting: Counting) -> Option<Self> {
        let n = a.episodes.len().min(b.episodes.len());
        let mut table = Self::of_episodes(&a.episodes[..n], &b.episodes[..n], counting)?;
        let log = betting::log_capital(&table.outcomes(), 0.5);
        // JSON has no infinite numbers.
        table.e = Some(log.exp().min(f64::MAX));
        table.p = (-log).exp().min(1.0);
        table.design_effect = 1.0;
        Family::correct("", &mut [&mut table], 1);
        Some(table)
    }

    /// The outcomes of all pairs: 1 where only the first policy succeeded, 0 where only the second did, 1/2 otherwise.
    pub(super) fn outcomes(&self) -> [(f64, usize); 3] {
        [(1.0, self.only_a), (0.0, self.only_b), (0.5, self.both + self.neither)]
    }

    fn with_design_effect([both, only_a, only_b, neither]: [usize; 4], design_effect: f64) -> Self {
        let n = both + only_a + only_b + neither;
        let mut table = Self {
            both,
            only_a,
            only_b,
            neither,
            p: score::test(only_a, only_b, design_effect),
            e: None,
            p_holm: 1.0,
            comparisons: 1,
            design_effect,
            difference: (only_a as f64 - only_b as f64) / n.max(1) as f64,
            low: -1.0,
            high: 1.0,
            verdict: Verdict::TooFew,
        };
        Family::correct("", &mut [&mut table], 1);
        table
    }

    /// The number of pairs.
    pub fn n(&self) -> usize {
        self.both + self.only_a + self.only_b + self.neither
    }

    /// The number of starts that exactly one policy solved.
    pub fn discordant(&self) -> usize {
        self.only_a + self.only_b
    }

    /// The p-value multiplied by the number of comparisons (Bonferroni): below 5 % exactly if the interval excludes 0.
    pub fn p_corrected(&self) -> f64 {
        (self.p * self.comparisons as f64).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::Timing;

    fn run(policy: &str, outcomes: &[(u64, bool, bool)]) -> Run {
        let episodes = outcomes.iter().map(|&(seed, success, solved_at_start)| EpisodeResult {
            success,
            solved_at_start,
            ..EpisodeResult::new(seed)
        });
        Run::new("in distribution", policy, Counting::default(), episodes.collect(), Timing::default())
    }

    #[test]
    fn runs_with_equal_starts_and_conditions_are_compared() {
        let floor = run("random", &[(1, false, false), (2, true, false), (3, false, true), (4, false, false)]);
        let model = run("model", &[(1, true, false), (2, true, false), (3, false, true), (4, false, false)]);
        let found = Comparison::all(&[floor.clone(), model.clone()], Counting::default());
        assert_eq!(found.len(), 1);
        let Comparison { a, b, table, .. } = &found[0];
        assert_eq!((a.as_str(), b.as_str()), ("model", "random"));
        assert_eq!([table.both, table.only_a, table.only_b, table.neither], [1, 1, 0, 1]);
        assert!((table.difference - 1.0 / 3.0).abs() < 1e-12);
        let mut other = model.clone();
        other.episodes[3].seed = 5;
        assert!(
            Comparison::of(&other, &floor, Counting::default()).is_none(),
            "runs with other starts are not compared"
        );
        other = Run { condition: "shifted colours".to_owned(), ..model };
        assert!(
            Comparison::of(&other, &floor, Counting::default()).is_none(),
            "runs with other conditions are not compared"
        );
    }

    #[test]
    fn runs_of_different_lengths_are_compared_on_their_common_starts() {
        let outcomes = |n: u64, solved: u64| (0..n).map(|seed| (seed, seed < solved, false)).collect::<Vec<_>>();
        let (model, floor) = (run("model", &outcomes(30, 14)), run("random", &outcomes(20, 2)));
        let counting = Counting::default();
        let table = Paired::sequential(&model, &floor, counting).expect("20 common starts");
        assert_eq!([table.both, table.only_a, table.only_b, table.neither], [2, 12, 0, 6]);
        let e = table.e.expect("an e-value");
        assert!((table.p - 1.0 / e).abs() < 1e-12 && table.verdict == Verdict::Higher && table.low > 0.0, "{table:?}");
        // A fixed number of pairs decides earlier.
        let fixed = Paired::of(2, 12, 0, 6);
        assert!(fixed.p < table.p && fixed.low > table.low && fixed.high < table.high && fixed.e.is_none());
        let five = (run("model", &outcomes(10, 7)), run("random", &outcomes(10, 2)));
        assert_eq!(Paired::of(2, 5, 0, 3).verdict, Verdict::Higher);
        let sequential = Paired::sequential(&five.0, &five.1, counting).expect("10 starts");
        assert_eq!(sequential.verdict, Verdict::TooFew);
        let mut other = floor;
        other.episodes[3].seed = 77;
        assert!(Paired::sequential(&model, &other, counting).is_none(), "other starts");
    }

    #[test]
    fn starts_from_one_recorded_episode_form_a_cluster() {
        let outcomes = |solved: fn(u64) -> bool| (0..24).map(|seed| (seed, solved(seed), false)).collect::<Vec<_>>();
        let mut floor = run("random", &outcomes(|_| false));
        let mut model = run("model", &outcomes(|seed| seed < 12));
        let independent = Paired::of_runs(&model, &floor, Counting::default()).expect("24 starts");
        assert_eq!((independent.design_effect, independent.verdict), (1.0, Verdict::Higher));
        for run in [&mut floor, &mut model] {
            for (i, episode) in run.episodes.iter_mut().enumerate() {
                episode.start = Some([i / 6, i]);
            }
        }
        let clustered = Paired::of_runs(&model, &floor, Counting::default()).expect("24 starts");
        assert_eq!((clustered.design_effect, clustered.only_a), (6.0, 12));
        // Two recorded episodes cannot decide.
        assert!(clustered.verdict == Verdict::TooFew && clustered.low < 0.0 && clustered.high > independent.high);
    }

    #[test]
    fn many_runs_are_compared_only_with_the_random_floor_and_the_best_run() {
        let outcomes = |solved: u64| (0..8).map(|seed| (seed, seed < solved, false)).collect::<Vec<_>>();
        let mut runs = vec![run("random", &outcomes(1))];
        runs.extend((0..30).map(|i| run(&format!("model-{i}"), &outcomes(if i == 7 { 6 } else { 2 + i % 3 }))));
        let found = Comparison::all(&runs, Counting::default());
        // 30 with the floor, and 29 others with model-7.
        assert_eq!(found.len(), 59);
        assert!(found.iter().all(|comparison| comparison.table.comparisons == 59));
        assert!(found.iter().all(|c| [c.a.as_str(), c.b.as_str()].iter().any(|p| ["random", "model-7"].contains(p))));
        assert_eq!(
            Comparison::all(&runs[..MAX_ALL_PAIRS], Counting::default()).len(),
            190,
            "at most MAX_ALL_PAIRS runs are compared in all pairs"
        );
    }
}
