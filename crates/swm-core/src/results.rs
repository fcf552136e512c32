//! [`Results`]: what an evaluation found, as written to `results.json` and read by reports.
//!
//! Everything but [`Run::timing`] is decided by the manifest: two equal evaluations write equal results,
//! latencies aside.

use crate::Manifest;
use serde::{Deserialize, Serialize};

/// The content of a `results.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Results {
    /// Where the numbers came from.
    pub manifest: Manifest,
    /// The environment.
    pub env: String,
    /// The protocol: `episodic` or `dataset`.
    pub protocol: String,
    /// One entry a policy and condition.
    pub runs: Vec<Run>,
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
    /// Starts that already satisfied the goal, left out of `success`.
    pub solved_at_start: usize,
    /// The success rate.
    pub success: Proportion,
    /// Steps to the goal among successes.
    pub time_to_goal: Option<Summary>,
    /// How long it took: the only part that differs between equal runs.
    pub timing: Timing,
    /// Videos, as paths relative to the results file.
    #[serde(default)]
    pub videos: Vec<String>,
}

/// One episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EpisodeResult {
    /// Its seed.
    pub seed: u64,
    /// Whether the goal was reached.
    pub success: bool,
    /// Whether the start already satisfied the goal.
    pub solved_at_start: bool,
    /// Steps played.
    pub steps: usize,
    /// The sum of rewards.
    pub total_reward: f64,
    /// Where it started in a dataset, if it did: `[episode, step]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub start: Option<[usize; 2]>,
}

/// A share of successes with its 95 % Wilson score interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Proportion {
    /// Successes.
    pub successes: usize,
    /// Tries.
    pub n: usize,
    /// `successes / n`; 0 where nothing was tried.
    pub rate: f64,
    /// The lower end of the interval.
    pub low: f64,
    /// The upper end of the interval.
    pub high: f64,
}

impl Proportion {
    /// The share of `successes` in `n` tries (Wilson, "Probable inference, the law of succession, and
    /// statistical inference", 1927, with z = 1.96).
    #[allow(clippy::cast_precision_loss)]
    pub fn wilson(successes: usize, n: usize) -> Self {
        if n == 0 {
            return Self { successes, n, rate: 0.0, low: 0.0, high: 1.0 };
        }
        const Z: f64 = 1.959_963_984_540_054;
        let (count, p) = (n as f64, successes as f64 / n as f64);
        let scale = 1.0 + Z * Z / count;
        let centre = (p + Z * Z / (2.0 * count)) / scale;
        let half = Z / scale * (p * (1.0 - p) / count + Z * Z / (4.0 * count * count)).sqrt();
        Self { successes, n, rate: p, low: (centre - half).max(0.0), high: (centre + half).min(1.0) }
    }
}

/// A few numbers about many.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Summary {
    /// How many.
    pub n: usize,
    /// Their mean.
    pub mean: f64,
    /// Their median.
    pub median: f64,
    /// Their 95th percentile (nearest rank).
    pub p95: f64,
}

impl Summary {
    /// A summary of these numbers, or none where there are none.
    #[allow(clippy::cast_precision_loss)]
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

/// How long it took.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Timing {
    /// Seconds one plan took, over all plans; none for policies that do not plan.
    pub plan_seconds: Option<Summary>,
    /// Seconds the whole run took.
    pub wall_seconds: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_matches_published_values() {
        // Newcombe 1998, table I: 81 of 263 gives 0.2553 to 0.3662; 15 of 148 gives 0.0624 to 0.1605; 0 of
        // 20 gives 0.0000 to 0.1611.
        for (successes, n, low, high) in [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)] {
            let p = Proportion::wilson(successes, n);
            assert!((p.low - low).abs() < 5e-5 && (p.high - high).abs() < 5e-5, "{p:?}");
        }
    }

    #[test]
    fn summaries_take_the_middle() {
        let summary = Summary::of(&[3.0, 1.0, 2.0, 10.0]).expect("some");
        assert_eq!((summary.mean, summary.median, summary.p95), (4.0, 2.5, 10.0));
        assert!(Summary::of(&[]).is_none());
    }
}
