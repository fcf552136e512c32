//! [`Played`]: a model's prediction errors along the trajectories that its policy played, and its optimism.

use super::discrimination::ErrorAndSuccess;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, StudentsT};
use std::collections::BTreeMap;

/// Predictions from the first observation of each episode and the actions that the policy chose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Played {
    /// The trajectories that have at least one model step, in the order of the episodes.
    pub trajectories: Vec<PlayedTrajectory>,
}

/// The predictions along one episode, up to its end.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlayedTrajectory {
    /// The dataset row at which the episode starts: `[episode, step]`.
    pub start: [usize; 2],
    /// Whether the episode succeeded.
    pub success: bool,
    /// The mean squared error of each model step's latent, in the units of the latents.
    pub errors: Vec<f64>,
    /// The optimism of the prediction: the squared distance from the goal's latent that the last model step reached, minus that
    /// which the model predicted for the same actions. `None` without an observation of the goal.
    pub optimism: Option<f64>,
    /// The distance from the start to its goal, in the environment's unit; `None` where it was not recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub displacement: Option<f64>,
}

/// What [`Played`] shows.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlayedErrors {
    /// The errors by success: means over the model steps that all trajectories have.
    pub errors: ErrorAndSuccess,
    /// The mean optimism over all trajectories; `None` without observations of the goal.
    pub optimism: Option<ClusteredMean>,
}

/// A mean with its 95 % interval, where values of one recorded episode form a cluster: the variance of the mean is that of the
/// sums over clusters, and the quantile that of Student's t distribution with one degree of freedom less than clusters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ClusteredMean {
    /// The mean.
    pub mean: f64,
    /// The lower end.
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

impl PlayedErrors {
    /// Summarises trajectories in units of `variance`: that of the latents of recorded observations
    /// ([`Prediction::variance`](super::Prediction::variance)).
    pub fn of(played: &Played, variance: f64) -> Self {
        let known = || played.trajectories.iter().filter(|trajectory| !trajectory.errors.is_empty());
        // Solved episodes end early, and errors grow with the model steps: only those that all trajectories have are comparable.
        let steps = known().map(|trajectory| trajectory.errors.len()).min().unwrap_or_default();
        let error = |trajectory: &PlayedTrajectory| {
            let mean = trajectory.errors[..steps].iter().sum::<f64>() / steps as f64;
            (trajectory.success, mean / variance, trajectory.start[0])
        };
        let optimism: Vec<(f64, usize)> =
            known().filter_map(|trajectory| Some((trajectory.optimism? / variance, trajectory.start[0]))).collect();
        Self { errors: ErrorAndSuccess::of_errors(known().map(error)), optimism: ClusteredMean::of(&optimism) }
    }
}

impl ClusteredMean {
    /// The mean of values with their clusters; `None` for fewer than two clusters.
    fn of(values: &[(f64, usize)]) -> Option<Self> {
        let n = values.len() as f64;
        let mean = values.iter().map(|(value, _)| value).sum::<f64>() / n;
        let mut sums: BTreeMap<usize, f64> = BTreeMap::new();
        for (value, cluster) in values {
            *sums.entry(*cluster).or_default() += value - mean;
        }
        let clusters = sums.len() as f64;
        if clusters < 2.0 || !mean.is_finite() {
            return None;
        }
        let variance = clusters / (clusters - 1.0) * sums.values().map(|sum| sum * sum).sum::<f64>() / (n * n);
        let t = StudentsT::new(0.0, 1.0, clusters - 1.0).map_or(f64::INFINITY, |t| t.inverse_cdf(0.975));
        let half = t * variance.sqrt();
        Some(Self { mean, low: mean - half, high: mean + half })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intervals_of_clustered_means_equal_those_of_numpy() {
        // numpy 2.4.6 and scipy 1.17.1: c / (c - 1) * (sums ** 2).sum() / n ** 2 and stats.t.ppf(0.975, c - 1).
        let values: Vec<(f64, usize)> =
            (0..40).map(|i| (f64::from((i * 37) % 23) / 10.0 - 1.0, i as usize % 7)).collect();
        let found = ClusteredMean::of(&values).expect("seven clusters");
        let expected = [0.08, -0.17340112489359877, 0.3334011248935988];
        let values = [found.mean, found.low, found.high];
        assert!(values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{values:?}");
        assert_eq!(ClusteredMean::of(&[(1.0, 0), (2.0, 0)]), None);
        assert_eq!(ClusteredMean::of(&[]), None);
    }

    #[test]
    fn played_trajectories_may_end_early_and_lack_a_goal() {
        let trajectory = |start, success, errors: &[f64], optimism| PlayedTrajectory {
            start: [start, 0],
            success,
            errors: errors.to_vec(),
            optimism,
            displacement: None,
        };
        let trajectories = vec![
            trajectory(0, true, &[0.1], None),
            trajectory(1, false, &[0.2, 0.4], Some(1.0)),
            trajectory(2, true, &[], Some(9.0)),
            trajectory(3, false, &[0.05], Some(3.0)),
        ];
        let found = PlayedErrors::of(&Played { trajectories }, 0.5);
        assert_eq!((&found.errors.solved[..], found.errors.failed.len()), (&[0.2][..], 2));
        assert!((found.errors.failed[0] - 0.4).abs() < 1e-12);
        assert_eq!(found.optimism.map(|found| found.mean), Some(4.0));
    }
}
