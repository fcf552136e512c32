//! Statistics of results: proportions with confidence intervals, and summaries of many values.

use super::betting;
use serde::{Deserialize, Serialize};

/// The 97.5th percentile of the standard normal distribution, for two-sided 95 % intervals.
const Z: f64 = 1.959_963_984_540_054;

/// A success rate with its 95 % interval: Wilson's, or a confidence sequence.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Proportion {
    /// The number of successes.
    pub successes: usize,
    /// The number of trials.
    pub n: usize,
    /// `successes / n`; 0 without trials.
    pub rate: f64,
    /// The lower end of the interval.
    pub low: f64,
    /// The upper end of the interval.
    pub high: f64,
    /// The variance of the rate relative to that of independent trials: starts from one recorded episode form a cluster. At
    /// least 1, which it is without clusters. Confidence sequences do not have it.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub design_effect: f64,
}

fn one() -> f64 {
    1.0
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "the signature that serde calls")]
fn is_one(value: &f64) -> bool {
    *value == 1.0
}

impl Proportion {
    /// The proportion of `successes` in `n` trials (Wilson, "Probable inference, the law of succession, and
    /// statistical inference", 1927, with z = 1.96).
    pub fn wilson(successes: usize, n: usize) -> Self {
        Self::with_design_effect(successes, n, 1.0)
    }

    /// The proportion of the successes of all clusters, each with its successes and its trials. The interval is Wilson's for the
    /// number of trials divided by the design effect (Rao and Scott, "A simple method for the analysis of clustered binary
    /// data", 1992), and equals [`Proportion::wilson`] where every cluster has one trial.
    ///
    /// The design effect is the variance of the rate over clusters relative to that of independent trials. If all trials end
    /// equally, clusters may agree by themselves: it is then that of clusters whose trials always agree.
    pub fn clustered(clusters: impl Iterator<Item = [usize; 2]> + Clone) -> Self {
        let sum = |of: usize| clusters.clone().map(|cluster| cluster[of]).sum();
        let (successes, n): (usize, usize) = (sum(0), sum(1));
        let count = clusters.clone().filter(|[_, trials]| *trials > 0).count();
        if count == n {
            return Self::wilson(successes, n);
        }
        let p = successes as f64 / n as f64;
        let independent = n as f64 * p * (1.0 - p);
        let design_effect = if independent == 0.0 || count < 2 {
            clusters.map(|[_, trials]| (trials * trials) as f64).sum::<f64>() / n as f64
        } else {
            let excess = |[successes, trials]: [usize; 2]| successes as f64 - p * trials as f64;
            let squares: f64 = clusters.map(|cluster| excess(cluster).powi(2)).sum();
            squares * count as f64 / (count - 1) as f64 / independent
        };
        Self::with_design_effect(successes, n, design_effect.max(1.0))
    }

    fn with_design_effect(successes: usize, n: usize, design_effect: f64) -> Self {
        if n == 0 {
            return Self { successes, n, rate: 0.0, low: 0.0, high: 1.0, design_effect };
        }
        let (count, p) = (n as f64 / design_effect, successes as f64 / n as f64);
        let scale = 1.0 + Z * Z / count;
        let centre = (p + Z * Z / (2.0 * count)) / scale;
        let half = Z / scale * (p * (1.0 - p) / count + Z * Z / (4.0 * count * count)).sqrt();
        Self { successes, n, rate: p, low: (centre - half).max(0.0), high: (centre + half).min(1.0), design_effect }
    }

    /// The proportion with the confidence sequence of level 95 %, which holds although the outcomes decide how many trials
    /// there are (`betting`).
    pub fn sequential(successes: usize, n: usize) -> Self {
        let [low, high] = betting::rate(successes, n, 0.05);
        Self { low, high, ..Self::wilson(successes, n) }
    }
}

/// Summary statistics of many values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// The number of values.
    pub n: usize,
    /// The mean.
    pub mean: f64,
    /// The median.
    pub median: f64,
    /// The 95th percentile (nearest rank).
    pub p95: f64,
}

impl Summary {
    /// The summary of these values; `None` if there are none.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len();
        if n == 0 {
            return None;
        }
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        let median = (sorted[(n - 1) / 2] + sorted[n / 2]) / 2.0;
        Some(Self {
            n,
            mean: values.iter().sum::<f64>() / n as f64,
            median,
            p95: sorted[(n * 95).div_ceil(100).saturating_sub(1)],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_intervals_match_published_values() {
        // Newcombe 1998, table I: 81 of 263 gives 0.2553 to 0.3662; 15 of 148 gives 0.0624 to 0.1605; 0 of
        // 20 gives 0.0000 to 0.1611.
        for (successes, n, low, high) in [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)] {
            let p = Proportion::wilson(successes, n);
            assert!((p.low - low).abs() < 5e-5 && (p.high - high).abs() < 5e-5, "{p:?}");
        }
    }

    #[test]
    fn clusters_widen_intervals_by_their_design_effect() {
        let single = [[1, 1], [0, 1], [1, 1], [1, 1]];
        assert_eq!(Proportion::clustered(single.into_iter()), Proportion::wilson(3, 4));
        // Ten clusters of four trials that always agree: as ten trials, up to the factor m / (m - 1).
        let agreeing = (0..10).map(|i| [if i < 6 { 4 } else { 0 }, 4]);
        let clustered = Proportion::clustered(agreeing);
        assert!((clustered.design_effect - 40.0 / 9.0).abs() < 1e-9, "{clustered:?}");
        let (few, many) = (Proportion::wilson(6, 10), Proportion::wilson(24, 40));
        assert!(clustered.low < few.low && clustered.high > few.high && few.high > many.high);
        assert_eq!((clustered.successes, clustered.n, clustered.rate), (24, 40, 0.6));
        // Trials that disagree more than chance are no reason for a narrower interval.
        assert_eq!(Proportion::clustered((0..10).map(|_| [2, 4])), Proportion::wilson(20, 40));
        // Without a failure, the trials of a cluster may always agree.
        let all = Proportion::clustered((0..10).map(|_| [4, 4]));
        assert_eq!((all.design_effect, all.low), (4.0, Proportion::wilson(10, 10).low));
        assert_eq!(Proportion::clustered(std::iter::once([3, 5])).design_effect, 5.0);
        assert_eq!(Proportion::clustered(std::iter::empty()), Proportion::wilson(0, 0));
    }

    #[test]
    fn intervals_of_clusters_cover_the_rate() {
        use crate::Key;
        use rand::Rng as _;
        // Rates of clusters are 0.2 or 0.8, so that trials of one agree more often than chance.
        let mut covered = [0; 2];
        for repetition in 0..2000 {
            let mut rng = Key::new(7).at(repetition).rng();
            let mut cluster = || {
                let rate = if rng.random_bool(0.5) { 0.2 } else { 0.8 };
                [(0..5).filter(|_| rng.random_bool(rate)).count(), 5]
            };
            let clusters: Vec<[usize; 2]> = (0..30).map(|_| cluster()).collect();
            let clustered = Proportion::clustered(clusters.iter().copied());
            let naive = Proportion::wilson(clustered.successes, clustered.n);
            for (covered, p) in covered.iter_mut().zip([clustered, naive]) {
                *covered += usize::from(p.low <= 0.5 && 0.5 <= p.high);
            }
        }
        // 95 % of 2000, with three Monte Carlo errors of 10.
        assert!((1870..=1960).contains(&covered[0]), "{covered:?}");
        assert!(covered[1] < 1750, "the interval of independent trials is too narrow: {covered:?}");
    }

    #[test]
    fn confidence_sequences_hold_the_rate_and_are_wider_than_wilson_intervals() {
        for (successes, n) in [(0, 0), (0, 7), (7, 7), (3, 7), (450, 1400)] {
            let (sequential, fixed) = (Proportion::sequential(successes, n), Proportion::wilson(successes, n));
            assert_eq!((sequential.rate, sequential.n), (fixed.rate, n));
            assert!(sequential.low <= fixed.rate && fixed.rate <= sequential.high, "{sequential:?}");
            assert!(sequential.high - sequential.low >= fixed.high - fixed.low, "{sequential:?} {fixed:?}");
        }
    }

    #[test]
    fn summary_has_the_mean_the_median_and_the_95th_percentile() {
        let summary = Summary::of(&[3.0, 1.0, 2.0, 10.0]).expect("a summary of four values");
        assert_eq!((summary.mean, summary.median, summary.p95), (4.0, 2.5, 10.0));
        assert!(Summary::of(&[]).is_none());
    }
}
