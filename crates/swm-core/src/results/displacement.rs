//! [`ByDisplacement`]: whether a prediction error tells failed episodes from solved ones, for near and for far goals.

use super::{Discrimination, ErrorAndSuccess, Played, Prediction};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The trajectories whose goals are about equally far away, and how well errors tell the failed ones from the solved ones.
///
/// The displacement of a start is its distance to the goal, in the environment's unit ([`Env::goal_distance`](crate::Env)).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ByDisplacement {
    /// The smallest displacement.
    pub from: f64,
    /// The largest displacement.
    pub to: f64,
    /// The number of solved trajectories.
    pub solved: usize,
    /// The number of failed trajectories.
    pub failed: usize,
    /// The errors along the recorded trajectories; `None` unless some are solved and some failed.
    pub recorded: Option<Discrimination>,
    /// The errors along the trajectories that the policy played.
    pub played: Option<Discrimination>,
}

impl ByDisplacement {
    /// The number of groups: near, middle and far goals.
    pub const GROUPS: usize = 3;

    /// Splits trajectories into groups of about equal size. Equal displacements are in one group. Nothing if fewer than two
    /// trajectories for each group have a displacement.
    pub fn of(prediction: &Prediction, played: &Played) -> Vec<Self> {
        let known = || played.trajectories.iter().filter(|trajectory| !trajectory.errors.is_empty());
        let displaced = known().filter_map(|known| Some((known.start, known.displacement.filter(|d| d.is_finite())?)));
        let displacements: BTreeMap<[usize; 2], f64> = displaced.collect();
        let mut sorted: Vec<f64> = displacements.values().copied().collect();
        sorted.sort_by(f64::total_cmp);
        if sorted.len() < 2 * Self::GROUPS {
            return vec![];
        }
        let ends: Vec<f64> = (1..Self::GROUPS).map(|group| sorted[group * sorted.len() / Self::GROUPS]).collect();
        let group = |start: [usize; 2]| {
            let displacement = displacements.get(&start)?;
            Some((ends.iter().filter(|end| *displacement >= **end).count(), *displacement))
        };
        // As for all trajectories together: the model steps that all of them have.
        let steps = known().map(|trajectory| trajectory.errors.len()).min().unwrap_or_default();
        let of = |index: usize| {
            let is_in = |start: [usize; 2]| group(start).is_some_and(|(found, _)| found == index);
            let members = || sorted.iter().filter(|d| ends.iter().filter(|end| **d >= **end).count() == index);
            let recorded = prediction.trajectories.iter().filter(|trajectory| is_in(trajectory.start));
            let recorded = ErrorAndSuccess::of_errors(
                recorded.filter_map(|known| Some((known.success?, known.error(), known.start[0]))),
            );
            let played = known().filter(|trajectory| is_in(trajectory.start)).map(|trajectory| {
                let sum: f64 = trajectory.errors[..steps].iter().sum();
                (trajectory.success, sum, trajectory.start[0])
            });
            let played = ErrorAndSuccess::of_errors(played);
            Some(Self {
                from: *members().next()?,
                to: *members().next_back()?,
                solved: recorded.solved.len(),
                failed: recorded.failed.len(),
                recorded: recorded.discrimination,
                played: played.discrimination,
            })
        };
        (0..Self::GROUPS).filter_map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::results::{PlayedTrajectory, Trajectory};

    #[test]
    fn groups_have_the_trajectories_of_their_displacements() {
        // Near goals: errors of failures are larger. Far goals: smaller. Every fourth start has no displacement.
        let n = 120;
        let (mut trajectories, mut played) = (vec![], vec![]);
        for i in 0..n {
            let (start, success, far) = ([i, 3], i % 2 == 0, i as f64 / n as f64);
            let sign = if success == (far < 0.5) { -1.0 } else { 1.0 };
            let errors = vec![1.0 + sign * 0.5 + 0.001 * i as f64];
            let displacement = (i % 4 != 3).then_some(far);
            trajectories.push(Trajectory { start, success: Some(success), errors: errors.clone() });
            played.push(PlayedTrajectory { start, success, errors, optimism: None, displacement });
        }
        let prediction = Prediction::new(1, 1.0, trajectories);
        let found = ByDisplacement::of(&prediction, &Played { trajectories: played.clone() });
        assert_eq!(found.len(), 3);
        assert!(found.windows(2).all(|pair| pair[0].to < pair[1].from), "{found:?}");
        assert_eq!(found.iter().map(|group| group.solved + group.failed).sum::<usize>(), 90);
        let areas: Vec<f64> = found.iter().filter_map(|group| Some(group.recorded?.auc)).collect();
        assert!(areas[0] > 0.95 && areas[2] < 0.05 && (0.2..0.8).contains(&areas[1]), "{areas:?}");
        assert_eq!(found[0].played.map(|found| found.auc), Some(areas[0]));
        // Equal displacements are not split, and few trajectories make no groups.
        played.iter_mut().for_each(|known| known.displacement = Some(2.0));
        let equal = ByDisplacement::of(&prediction, &Played { trajectories: played.clone() });
        assert!(equal.len() == 1 && (equal[0].from, equal[0].to) == (2.0, 2.0), "{equal:?}");
        played.truncate(5);
        assert_eq!(ByDisplacement::of(&prediction, &Played { trajectories: played }), []);
    }
}
