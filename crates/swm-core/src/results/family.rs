//! Families of comparisons: correction for their number, verdicts, and the smallest difference that they can show.
//!
//! Comparisons that answer one question form a family. Its intervals hold simultaneously, and its verdicts are all right,
//! with a probability of 95 %: each interval and each test is at the level 5 % / m for m comparisons (Bonferroni). The
//! verdict of a comparison follows its interval. Holm's adjusted p-values are stated beside: Holm's test rejects whatever
//! Bonferroni's rejects and sometimes more, but no simultaneous intervals belong to it.
//!
//! Comparisons whose outcomes decide how many pairs there are follow the same procedure with confidence sequences and
//! e-values: a verdict needs an e-value of m / 5 %.

use super::Paired;
use super::{betting, score};
use serde::{Deserialize, Serialize};
use std::fmt;

/// The probability that a family has a wrong verdict or a wrong interval.
const LEVEL: f64 = 0.05;
/// The probability that [`Family::detectable`] is told apart.
const POWER: f64 = 0.8;

/// What a comparison says about the first rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// The interval lies below 0.
    #[serde(rename = "lower")]
    Lower,
    /// The interval lies above 0.
    #[serde(rename = "higher")]
    Higher,
    /// The interval contains 0.
    #[serde(rename = "not told apart")]
    NotToldApart,
    /// The interval contains 0, and would contain it if all outcomes that differ differed in one direction.
    #[serde(rename = "too few")]
    TooFew,
}

impl Verdict {
    /// The verdict with the rates exchanged.
    #[must_use]
    pub fn reversed(self) -> Self {
        match self {
            Self::Lower => Self::Higher,
            Self::Higher => Self::Lower,
            same => same,
        }
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Lower => "lower",
            Self::Higher => "higher",
            Self::NotToldApart => "not told apart",
            Self::TooFew => "too few",
        })
    }
}

/// The size of a family of comparisons, and the smallest difference that it can show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Family {
    /// What the comparisons have in common.
    pub name: String,
    /// The number of comparisons.
    pub comparisons: usize,
    /// The smallest number of pairs of a comparison.
    pub pairs: usize,
    /// The share of pairs whose outcomes differ, over all comparisons.
    pub discordant: f64,
    /// The smallest difference of rates that a comparison tells apart with a probability of 80 %, as `detectable`
    /// computes it; `None` if it shows no difference so reliably.
    pub detectable: Option<f64>,
    /// Whether the outcomes decided how many pairs there are, so that the intervals are confidence sequences.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sequential: bool,
}

impl Family {
    /// Corrects all tables of a family for the number of its comparisons: their intervals, verdicts and adjusted
    /// p-values. `comparisons` counts those without a table too, which come later.
    ///
    /// Returns `None` without tables.
    pub fn correct(name: &str, tables: &mut [&mut Paired], comparisons: usize) -> Option<Self> {
        let comparisons = comparisons.max(tables.len());
        let adjusted = holm(&tables.iter().map(|table| table.p).collect::<Vec<_>>(), comparisons);
        let z = score::upper_quantile(LEVEL / (2 * comparisons.max(1)) as f64);
        let level = LEVEL / comparisons.max(1) as f64;
        for (table, p_holm) in tables.iter_mut().zip(adjusted) {
            let ([low, high], decidable) = match table.e {
                None => {
                    let interval = score::interval(table.only_a, table.only_b, table.n(), table.design_effect, z);
                    (interval, (table.discordant() as f64 / table.design_effect).sqrt() > z)
                }
                Some(_) => {
                    let interval = betting::mean(&table.outcomes(), 0.5, level).map(|mean| 2.0 * mean - 1.0);
                    (interval, betting::log_capital(&[(1.0, table.discordant())], 0.5) >= -level.ln())
                }
            };
            let verdict = match (low > 0.0, high < 0.0) {
                (true, _) => Verdict::Higher,
                (_, true) => Verdict::Lower,
                _ if decidable => Verdict::NotToldApart,
                _ => Verdict::TooFew,
            };
            **table = Paired { low, high, verdict, comparisons, p_holm, ..**table };
        }
        let pairs = tables.iter().map(|table| table.n()).min()?;
        let independent =
            tables.iter().map(|table| table.n() as f64 / table.design_effect).fold(f64::INFINITY, f64::min);
        let count = |of: fn(&Paired) -> usize| tables.iter().map(|table| of(table) as f64).sum::<f64>();
        let discordant = count(Paired::discordant) / count(Paired::n).max(1.0);
        let sequential = tables.iter().any(|table| table.e.is_some());
        // How many pairs there will be is not known, so no difference can be stated.
        let detectable = if sequential { None } else { detectable(independent, discordant, comparisons) };
        Some(Self { name: name.to_owned(), comparisons, pairs, discordant, detectable, sequential })
    }
}

impl fmt::Display for Family {
    /// A sentence without its full stop: `13 comparisons of 50 pairs tell a difference of 26 points apart with a
    /// probability of 80 %`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { comparisons, pairs, .. } = self;
        let one = *comparisons == 1;
        let s = if one { "" } else { "s" };
        if self.sequential {
            return write!(
                f,
                "{comparisons} comparison{s} of {pairs} pairs or more, whose verdicts hold at any number"
            );
        }
        write!(f, "{comparisons} comparison{s} of {pairs} pairs ")?;
        match self.detectable.map(|difference| 100.0 * difference) {
            Some(points) => write!(f, "tell{} a difference of {points:.0} points apart", if one { "s" } else { "" })?,
            None => write!(f, "{} too few to tell any difference apart", if one { "is" } else { "are" })?,
        }
        write!(f, " with a probability of 80 %")
    }
}

/// Returns Holm's adjusted p-values of `p`, some of `comparisons` comparisons (Holm, "A simple sequentially rejective
/// multiple test procedure", 1979). Those without a p-value count as 1.
fn holm(p: &[f64], comparisons: usize) -> Vec<f64> {
    let mut order: Vec<usize> = (0..p.len()).collect();
    order.sort_by(|&i, &j| p[i].total_cmp(&p[j]));
    let (mut adjusted, mut largest) = (vec![1.0; p.len()], 0.0f64);
    for (rank, i) in order.into_iter().enumerate() {
        largest = largest.max(p[i] * (comparisons - rank) as f64).min(1.0);
        adjusted[i] = largest;
    }
    adjusted
}

/// Returns the smallest difference δ that the score test of `pairs` pairs, one of `comparisons`, tells apart with a
/// probability of 80 %, if a share ψ = `discordant` of the pairs differs:
///
/// √n δ = z(α / 2m) √ψ + z(20 %) √(ψ - δ²), with ψ at least δ, which no difference can exceed.
///
/// This is the sample size of McNemar's test (Connor, "Sample size for testing differences in proportions for the
/// paired-sample design", 1987), solved for the difference. `None` if even δ = 1 is too small.
fn detectable(pairs: f64, discordant: f64, comparisons: usize) -> Option<f64> {
    let (of_level, of_power) =
        (score::upper_quantile(LEVEL / (2 * comparisons) as f64), score::upper_quantile(1.0 - POWER));
    let suffices = |difference: f64| {
        let share = discordant.max(difference);
        let rest = (share - difference * difference).max(0.0);
        pairs.sqrt() * difference >= of_level * share.sqrt() + of_power * rest.sqrt()
    };
    let (mut small, mut large) = (0.0, 1.0);
    for _ in 0..60 {
        let middle = 0.5 * (small + large);
        *if suffices(middle) { &mut large } else { &mut small } = middle;
    }
    suffices(1.0).then_some(large)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adjusted_p_values_equal_those_of_statsmodels() {
        // multipletests(p, method="holm")[1] of statsmodels 0.15.0.
        let expected: [(&[f64], &[f64]); 5] = [
            (&[0.01, 0.04, 0.03, 0.005], &[0.03, 0.06, 0.06, 0.02]),
            (&[0.5, 0.001, 0.02, 0.02, 0.9, 0.04, 0.3], &[1.0, 0.007, 0.12, 0.12, 1.0, 0.16, 0.8999999999999999]),
            (&[0.2], &[0.2]),
            (&[1.0, 1.0, 0.6], &[1.0, 1.0, 1.0]),
            (&[0.033, 0.0099, 0.00157, 0.317, 0.045500263896358], &[0.099, 0.0396, 0.00785, 0.317, 0.099]),
        ];
        for (p, adjusted) in expected {
            let found = holm(p, p.len());
            assert!(found.iter().zip(adjusted).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}, not {adjusted:?}");
        }
        // The same with two p-values of 1 that are not known yet.
        let found = holm(&[0.01, 0.04, 0.03, 0.005], 6);
        assert!(found.iter().zip([0.05, 0.12, 0.12, 0.03]).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
    }

    #[test]
    fn detectable_differences_solve_the_formula() {
        // scipy.optimize.brentq of scipy 1.17.1 on the formula.
        for (pairs, comparisons, discordant, expected) in [
            (50, 1, 0.0, Some(0.14971715001198374)),
            (50, 1, 0.2, Some(0.1730417001835013)),
            (50, 12, 0.2, Some(0.2578081843597034)),
            (256, 13, 0.1, Some(0.07330959817689237)),
            (50, 26, 0.5, Some(0.3810802556417242)),
            (3, 1, 0.3, None),
            (10, 1, 0.9, Some(0.7444823338315159)),
            (1000, 1, 0.35, Some(0.05235109308075969)),
        ] {
            match (detectable(f64::from(pairs), discordant, comparisons), expected) {
                (Some(found), Some(expected)) => assert!((found - expected).abs() < 1e-9, "{found}, not {expected}"),
                (found, expected) => assert_eq!(found, expected),
            }
        }
    }

    #[test]
    fn detectable_differences_are_told_apart_four_times_in_five() {
        let log_factorial = |n: usize| (1..=n).map(|i| (i as f64).ln()).sum::<f64>();
        for (pairs, discordant, comparisons) in [(50, 0.3, 1), (256, 0.2, 13), (256, 0.4, 1)] {
            let difference = detectable(pairs as f64, discordant, comparisons).expect("enough pairs");
            let [a, b] = [(discordant + difference) / 2.0, (discordant - difference) / 2.0];
            let level = LEVEL / comparisons as f64;
            let mut power = 0.0;
            for (i, j) in (0..=pairs).flat_map(|i| (0..=pairs - i).map(move |j| (i, j))) {
                if score::test(i, j, 1.0) < level {
                    let rest = pairs - i - j;
                    let ways = log_factorial(pairs) - log_factorial(i) - log_factorial(j) - log_factorial(rest);
                    let chance = i as f64 * a.ln() + j as f64 * b.ln() + rest as f64 * (1.0 - a - b).ln();
                    power += (ways + chance).exp();
                }
            }
            // The formula is that of the normal approximation.
            assert!((power - POWER).abs() < 0.04, "{pairs} pairs: {power}");
        }
    }

    #[test]
    fn verdicts_follow_the_simultaneous_intervals() {
        let [mut worse, mut unclear, mut few] =
            [Paired::of(20, 1, 14, 15), Paired::of(20, 8, 10, 12), Paired::of(40, 3, 0, 7)];
        assert_eq!(
            [worse, unclear, few].map(|table| table.verdict),
            [Verdict::Lower, Verdict::NotToldApart, Verdict::TooFew]
        );
        let family = Family::correct("all", &mut [&mut worse, &mut unclear, &mut few], 3).expect("a family");
        assert_eq!((family.comparisons, family.pairs, family.discordant), (3, 50, 0.24));
        assert_eq!([worse, unclear, few].map(|table| table.comparisons), [3; 3]);
        assert!(worse.verdict == Verdict::Lower && worse.high < 0.0 && worse.p_holm == 3.0 * worse.p);
        // Five outcomes in one direction decide alone, but not among a hundred comparisons.
        let mut five = Paired::of(40, 5, 0, 5);
        assert_eq!(five.verdict, Verdict::Higher);
        let narrow = five.low;
        Family::correct("all", &mut [&mut five], 100);
        assert!(five.verdict == Verdict::TooFew && five.low < 0.0 && five.low < narrow, "{five:?}");
        assert!(Family::correct("none", &mut [], 4).is_none());
    }

    #[test]
    fn verdicts_at_any_number_of_pairs_need_an_e_value_for_all_comparisons() {
        let sequential = |a: usize, b: usize| {
            let log = betting::log_capital(&[(1.0, a), (0.0, b)], 0.5);
            Paired { e: Some(log.exp()), p: (-log).exp().min(1.0), ..Paired::of(9, a, b, 11) }
        };
        for comparisons in [1, 13] {
            for (a, b) in (0..30).step_by(3).flat_map(|a| (0..30).step_by(4).map(move |b| (a, b))) {
                let mut table = sequential(a, b);
                let family = Family::correct("", &mut [&mut table], comparisons).expect("a family");
                let told = matches!(table.verdict, Verdict::Lower | Verdict::Higher);
                assert_eq!(told, table.low > 0.0 || table.high < 0.0, "{table:?}");
                assert_eq!(told, table.e.is_some_and(|e| e * LEVEL >= comparisons as f64), "{table:?}");
                assert!(family.sequential && family.detectable.is_none());
                let mut decisive = sequential(a + b, 0);
                Family::correct("", &mut [&mut decisive], comparisons);
                assert_eq!(table.verdict == Verdict::TooFew, decisive.verdict != Verdict::Higher, "{table:?}");
            }
        }
    }

    #[test]
    fn a_verdict_and_its_interval_never_disagree() {
        for comparisons in [1, 2, 13, 1000] {
            for (a, b) in (0..30).flat_map(|a| (0..30).map(move |b| (a, b))) {
                let mut table = Paired::of(9, a, b, 11);
                Family::correct("", &mut [&mut table], comparisons);
                let told = matches!(table.verdict, Verdict::Lower | Verdict::Higher);
                assert_eq!(told, table.low > 0.0 || table.high < 0.0, "{table:?}");
                assert_eq!(told, table.p_corrected() < LEVEL, "{table:?}");
                // Holm's test rejects whatever the verdict tells apart.
                assert!(!told || table.p_holm < LEVEL, "{table:?}");
                let mut decisive = Paired::of(9, a + b, 0, 11);
                Family::correct("", &mut [&mut decisive], comparisons);
                assert_eq!(table.verdict == Verdict::TooFew, decisive.verdict != Verdict::Higher, "{table:?}");
            }
        }
    }
}
