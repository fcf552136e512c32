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
}

impl Proportion {
    /// The proportion of `successes` in `n` trials (Wilson, "Probable inference, the law of succession, and
    /// statistical inference", 1927, with z = 1.96).
    pub fn wilson(successes: usize, n: usize) -> Self {
        if n == 0 {
            return Self { successes, n, rate: 0.0, low: 0.0, high: 1.0 };
        }
        let (count, p) = (n as f64, successes as f64 / n as f64);
        let scale = 1.0 + Z * Z / count;
        let centre = (p + Z * Z / (2.0 * count)) / scale;
        let half = Z / scale * (p * (1.0 - p) / count + Z * Z / (4.0 * count * count)).sqrt();
        Self { successes, n, rate: p, low: (centre - half).max(0.0), high: (centre + half).min(1.0) }
    }

    /// The proportion with the confidence sequence of level 95 %, which holds although the outcomes decide how many trials
    /// there are ([`betting`](super::betting)).
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
