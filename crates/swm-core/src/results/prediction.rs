//! [`Prediction`]: how well a model predicted recorded trajectories, beside whether its plans succeeded there.

use super::Summary;
use serde::{Deserialize, Serialize};

/// How well a model predicted recorded trajectories, open loop: from the latent of their first observation and their
/// recorded actions alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prediction {
    /// Environment steps in one model step.
    pub frameskip: usize,
    /// The variance of the latents of all observations that were to be predicted, averaged over a latent's numbers. Errors
    /// are told in it: always predicting the mean latent has an error of 1.
    pub variance: f64,
    /// Every trajectory.
    pub trajectories: Vec<Trajectory>,
    /// All trajectories, then those of successes and those of failures, where that is known.
    pub groups: Vec<Group>,
}

/// One trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Trajectory {
    /// Where it starts: `[episode, step]`.
    pub start: [usize; 2],
    /// Whether its episode succeeded, where that is known.
    pub success: Option<bool>,
    /// The mean squared error of each model step's latent, in units of [`Prediction::variance`].
    pub errors: Vec<f64>,
}

/// Some of the trajectories.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Group {
    /// Successes, failures, or all of them for `None`.
    pub success: Option<bool>,
    /// The errors of whole trajectories, each the mean over its steps.
    pub trajectory: Summary,
    /// The errors of each model step.
    pub steps: Vec<Summary>,
}

impl Prediction {
    /// Puts trajectories of equally many steps into groups. A group without trajectories is left out.
    pub fn new(frameskip: usize, variance: f64, trajectories: Vec<Trajectory>) -> Self {
        let groups =
            [None, Some(true), Some(false)].into_iter().filter_map(|success| Group::of(success, &trajectories));
        Self { frameskip, variance, groups: groups.collect(), trajectories }
    }
}

impl Trajectory {
    /// Its error as a whole: the mean over its steps.
    #[allow(clippy::cast_precision_loss)]
    pub fn error(&self) -> f64 {
        self.errors.iter().sum::<f64>() / self.errors.len() as f64
    }
}

impl Group {
    fn of(success: Option<bool>, trajectories: &[Trajectory]) -> Option<Self> {
        let mine = || trajectories.iter().filter(|trajectory| success.is_none() || trajectory.success == success);
        let horizon = mine().next()?.errors.len();
        let at =
            |step: usize| mine().filter_map(|trajectory| trajectory.errors.get(step).copied()).collect::<Vec<f64>>();
        Some(Self {
            success,
            trajectory: Summary::of(&mine().map(Trajectory::error).collect::<Vec<f64>>())?,
            steps: (0..horizon).filter_map(|step| Summary::of(&at(step))).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_told_apart_by_success() {
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
