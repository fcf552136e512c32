//! [`Prediction`]: a model's prediction errors on recorded trajectories, grouped by the success of the episodes.

use super::Summary;
use serde::{Deserialize, Serialize};

/// A model's open-loop prediction errors on recorded trajectories. The model predicts from the latent of the first
/// observation and the recorded actions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// Environment steps per model step.
    pub frameskip: usize,
    /// The variance of the latents of all predicted observations, averaged over latent dimensions. This variance is
    /// the unit of errors: always predicting the mean latent has an error of 1.
    pub variance: f64,
    /// The errors of every trajectory.
    pub trajectories: Vec<Trajectory>,
    /// The group of all trajectories, then the group of successes and the group of failures.
    pub groups: Vec<Group>,
}

/// The prediction errors of one trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// The dataset row at which the trajectory starts: `[episode, step]`.
    pub start: [usize; 2],
    /// Whether the trajectory's episode succeeded, if known.
    pub success: Option<bool>,
    /// The mean squared error of each model step's latent, in units of [`Prediction::variance`].
    pub errors: Vec<f64>,
}

/// The prediction errors of one group of trajectories.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Group {
    /// `true` for the group of successes, `false` for the group of failures, `None` for all trajectories.
    pub success: Option<bool>,
    /// The summary of [`Trajectory::error`] over the trajectories.
    pub trajectory: Summary,
    /// The summary of the errors of each model step.
    pub steps: Vec<Summary>,
}

impl Prediction {
    /// Groups trajectories of equal length. Empty groups are omitted.
    pub fn new(frameskip: usize, variance: f64, trajectories: Vec<Trajectory>) -> Self {
        let groups =
            [None, Some(true), Some(false)].into_iter().filter_map(|success| Group::of(success, &trajectories));
        Self { frameskip, variance, groups: groups.collect(), trajectories }
    }
}

impl Trajectory {
    /// The mean error over the model steps.
    pub fn error(&self) -> f64 {
        self.errors.iter().sum::<f64>() / self.errors.len() as f64
    }
}

impl Group {
    fn of(success: Option<bool>, trajectories: &[Trajectory]) -> Option<Self> {
        let members = || trajectories.iter().filter(|trajectory| success.is_none() || trajectory.success == success);
        let horizon = members().next()?.errors.len();
        let at =
            |step: usize| members().filter_map(|trajectory| trajectory.errors.get(step).copied()).collect::<Vec<f64>>();
        Some(Self {
            success,
            trajectory: Summary::of(&members().map(Trajectory::error).collect::<Vec<f64>>())?,
            steps: (0..horizon).filter_map(|step| Summary::of(&at(step))).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prediction_errors_are_grouped_by_success() {
        let trajectory = |success, errors: &[f64]| Trajectory { start: [0, 0], success, errors: errors.to_vec() };
        let found = Prediction::new(
            5,
            2.0,
            vec![
                trajectory(Some(true), &[0.1, 0.3]),
                trajectory(Some(false), &[0.4, 0.8]),
                trajectory(Some(true), &[0.2, 0.2]),
                trajectory(None, &[1.0, 1.0]),
            ],
        );
        let means: Vec<_> = found.groups.iter().map(|g| (g.success, g.trajectory.n, g.steps[1].median)).collect();
        assert_eq!(means, [(None, 4, 0.55), (Some(true), 2, 0.25), (Some(false), 1, 0.8)]);
        assert!((found.groups[1].trajectory.mean - 0.2).abs() < 1e-12);
        let unknown = Prediction::new(5, 2.0, vec![trajectory(None, &[1.0])]);
        assert_eq!(unknown.groups.len(), 1);
        assert_eq!(Prediction::new(5, 2.0, vec![]).groups, []);
    }
}
