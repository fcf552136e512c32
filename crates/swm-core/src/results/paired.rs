//! [`Comparison`]: a paired comparison of two policies on the same starts.
//!
//! Starts differ in difficulty. A paired test removes this variance: it depends only on the starts that exactly one of
//! the policies solves.

use super::{Counting, Proportion, Run};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

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

/// Counts of paired outcomes, and the test and the interval of the difference in success rate.
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
    /// The two-sided p-value of McNemar's exact test. The null hypothesis is that `only_a` and `only_b` are equally
    /// likely outcomes of the starts that exactly one policy solved.
    pub p: f64,
    /// The success rate of the first policy minus the success rate of the second.
    pub difference: f64,
    /// The lower end of the 95 % interval of the difference.
    pub low: f64,
    /// The upper end of the 95 % interval of the difference.
    pub high: f64,
}

impl Comparison {
    /// Compares two runs of one condition; `None` if they did not play the same starts.
    pub fn of(a: &Run, b: &Run, counting: Counting) -> Option<Self> {
        let mut pairs = a.episodes.iter().zip(&b.episodes);
        let same = a.condition == b.condition && pairs.all(|(a, b)| a.solved_at_start == b.solved_at_start);
        let table = same.then(|| Paired::of_runs(a, b, counting)).flatten()?;
        Some(Self { condition: a.condition.clone(), a: a.policy.clone(), b: b.policy.clone(), table })
    }

    /// Compares every run with each earlier run of the same condition, so that a learned policy is compared with the
    /// random-policy floor as `learned` minus `random`. A condition with many runs is limited as [`pairs`] says.
    pub fn all(runs: &[Run], counting: Counting) -> Vec<Self> {
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
        found.into_iter().filter_map(|(later, earlier)| Self::of(&runs[later], &runs[earlier], counting)).collect()
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
        let pairs = || a.episodes.iter().zip(&b.episodes);
        let same = a.episodes.len() == b.episodes.len() && pairs().all(|(a, b)| (a.seed, a.start) == (b.seed, b.start));
        let mut counts = [0; 4];
        for (a, b) in pairs().filter(|(a, b)| counting.counts(a) && counting.counts(b)) {
            counts[2 * usize::from(!a.success) + usize::from(!b.success)] += 1;
        }
        let [both, only_a, only_b, neither] = counts;
        (same && counts != [0; 4]).then(|| Self::of(both, only_a, only_b, neither))
    }

    /// The statistics of a table of paired outcomes.
    ///
    /// The test is McNemar's exact conditional test (McNemar, "Note on the sampling error of the difference between
    /// correlated proportions or percentages", 1947): a two-sided binomial test with p = 1/2. The interval of the
    /// difference is Newcombe's square-and-add ("Improved confidence intervals for the difference between
    /// binomial proportions based on paired data", 1998, method 10): Wilson intervals of both rates, combined by
    /// their correlation.
    pub fn of(both: usize, only_a: usize, only_b: usize, neither: usize) -> Self {
        let n = both + only_a + only_b + neither;
        let (a, b) = (Proportion::wilson(both + only_a, n), Proportion::wilson(both + only_b, n));
        let [w, x, y, z] = [both, only_a, only_b, neither].map(|count| count as f64);
        let margins = (w + x) * (y + z) * (w + y) * (x + z);
        let excess = w * z - x * y;
        // Newcombe's continuity correction, which applies to positive correlations only.
        let corrected = if excess > 0.0 { (excess - n as f64 / 2.0).max(0.0) } else { excess };
        let phi = if margins > 0.0 { corrected / margins.sqrt() } else { 0.0 };
        let combined = |a: f64, b: f64| (a * a - 2.0 * phi * a * b + b * b).max(0.0).sqrt();
        let difference = a.rate - b.rate;
        Self {
            both,
            only_a,
            only_b,
            neither,
            p: mcnemar(only_a, only_b),
            difference,
            low: (difference - combined(a.rate - a.low, b.high - b.rate)).max(-1.0),
            high: (difference + combined(a.high - a.rate, b.rate - b.low)).min(1.0),
        }
    }

    /// The number of pairs.
    pub fn n(&self) -> usize {
        self.both + self.only_a + self.only_b + self.neither
    }
}

/// Returns the two-sided p-value of the exact binomial test of `b` successes in `b + c` trials with p = 1/2.
fn mcnemar(b: usize, c: usize) -> f64 {
    let (n, fewer) = (b + c, b.min(c));
    // Logarithms of the binomial probabilities, which do not underflow for thousands of trials.
    let mut term = n as f64 * 0.5f64.ln();
    let mut tail = 0.0;
    for k in 0..=fewer {
        tail += term.exp();
        term += ((n - k) as f64 / (k + 1) as f64).ln();
    }
    (2.0 * tail).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{EpisodeResult, Timing};

    #[test]
    fn mcnemar_is_the_exact_binomial_test() {
        // scipy.stats.binomtest(b, b + c, 0.5).pvalue of scipy 1.17.1.
        let scipy = [
            (0, 0, 1.0),
            (1, 0, 1.0),
            (5, 5, 1.0),
            (0, 6, 0.03125),
            (1, 7, 0.0703125),
            (12, 2, 0.012_939_453_125),
            (37, 16, 0.005_486_344_876_760_141),
            (3, 41, 1.618_332_134_967_204_2e-9),
            (130, 90, 0.008_405_451_752_681_935),
            (900, 700, 6.319_484_959_450_105e-7),
        ];
        for (b, c, p) in scipy {
            let given = mcnemar(b, c);
            assert!((given - p).abs() <= 1e-9 * p, "{b} to {c}: {given}, not {p}");
            assert_eq!(given, mcnemar(c, b));
        }
    }

    #[test]
    fn paired_intervals_match_published_values() {
        // Newcombe 1998, table of examples: (36, 12, 2, 0) gives 0.0569 to 0.3404. Altman et al., "Statistics with
        // confidence", table 6.2: (14, 5, 0, 22) gives 0.011 to 0.226. Fagerland, Lydersen and Laake 2014:
        // (1, 1, 7, 12) gives -0.507 to -0.026, and p = 0.0703.
        for ([both, only_a, only_b, neither], low, high) in
            [([36, 12, 2, 0], 0.0569, 0.3404), ([14, 5, 0, 22], 0.0115, 0.2265), ([1, 1, 7, 12], -0.5069, -0.0256)]
        {
            let paired = Paired::of(both, only_a, only_b, neither);
            assert!((paired.low - low).abs() < 6e-5 && (paired.high - high).abs() < 6e-5, "{paired:?}");
            let swapped = Paired::of(both, only_b, only_a, neither);
            assert!((swapped.low + paired.high).abs() < 1e-12 && (swapped.high + paired.low).abs() < 1e-12);
        }
        assert!((Paired::of(1, 1, 7, 12).p - 0.0703).abs() < 5e-5);
        let same = Paired::of(30, 0, 0, 0);
        assert!((same.p, same.difference) == (1.0, 0.0) && same.low < -0.1 && same.high > 0.1, "{same:?}");
    }

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
    fn many_runs_are_compared_only_with_the_random_floor_and_the_best_run() {
        let outcomes = |solved: u64| (0..8).map(|seed| (seed, seed < solved, false)).collect::<Vec<_>>();
        let mut runs = vec![run("random", &outcomes(1))];
        runs.extend((0..30).map(|i| run(&format!("model-{i}"), &outcomes(if i == 7 { 6 } else { 2 + i % 3 }))));
        let found = Comparison::all(&runs, Counting::default());
        // 30 with the floor, and 29 others with model-7.
        assert_eq!(found.len(), 59);
        assert!(found.iter().all(|c| [c.a.as_str(), c.b.as_str()].iter().any(|p| ["random", "model-7"].contains(p))));
        assert_eq!(
            Comparison::all(&runs[..MAX_ALL_PAIRS], Counting::default()).len(),
            190,
            "at most MAX_ALL_PAIRS runs are compared in all pairs"
        );
    }
}
