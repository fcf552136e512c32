//! [`EvalRequest::replay`]: plays some episodes of an evaluation again, without its dataset if their rows are given.
//!
//! An episode depends on the request and on its number only, so it has the outcome that it has among all episodes.

use crate::request::{EvalRequest, StartsRequest};
use crate::runner::{Resolver, RunOptions};
use crate::starts::Starts;
use crate::world::World;
use swm_core::results::{Counting, Run};
use swm_core::run::Control;
use swm_core::{Batch, Error, Result, Schema};

/// The episodes of an evaluation that are played again.
#[derive(Clone, Copy, Debug)]
pub struct Recorded<'a> {
    /// The numbers of the episodes.
    pub numbers: &'a [usize],
    /// The rows that the episodes start from and the dataset's `[episode, step]` of each start; `None` to read the
    /// dataset of the request, or if there is none.
    pub rows: Option<(&'a Batch, &'a [[usize; 2]])>,
}

/// Some episodes of an evaluation.
#[derive(Clone, Debug)]
pub struct Replay {
    /// The outcomes, in the order of the numbers.
    pub run: Run,
    /// The columns of the environment after the reset, a row for each episode.
    pub starts: Batch,
    /// The start row and the goal row of each episode, alternating, if the starts come from a dataset.
    pub rows: Option<Batch>,
}

impl EvalRequest {
    /// Plays some episodes of this evaluation, which has one policy and one condition.
    ///
    /// # Errors
    /// When there are several policies or conditions, counting is not strict, an episode does not exist, or playing
    /// fails, as in [`EvalRequest::run`].
    pub fn replay(
        &self,
        recorded: Recorded<'_>,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<Replay> {
        self.check()?;
        let ([policy], [condition], Counting::Strict { .. }) =
            (&self.policies[..], &self.conditions[..], self.counting)
        else {
            let given = format!("{} policies, {} conditions", self.policies.len(), self.conditions.len());
            let problem = format!("{given}, counting {}", self.counting.name());
            let fix = "evaluate one policy under one condition with strict counting";
            return Err(Error::config("playing episodes again", problem, fix));
        };
        let envs = options.envs.min(recorded.numbers.len()).max(1);
        let mut world = self.world(resolver, envs, options)?;
        let variation = condition.variation.clone();
        world.spec().variation_space.check(&variation)?;
        let starts = match (&self.starts, recorded.rows) {
            (StartsRequest::Dataset { goal_offset, .. }, Some((rows, picks))) => {
                if picks.len() != recorded.numbers.len() {
                    let given = format!("{} rows of the dataset", picks.len());
                    let expected = format!("{}, one for each episode", recorded.numbers.len());
                    return Err(Error::mismatch("playing episodes again", given, expected));
                }
                Starts::from_rows(rows.clone(), picks.to_vec(), *goal_offset, self.seed, variation)?
                    .numbered(recorded.numbers.to_vec())
            }
            (StartsRequest::Dataset { dataset, .. }, None) => {
                let reader = resolver.dataset(dataset)?;
                self.starts(Some(&*reader), world.pool().env(0), variation)?.only(recorded.numbers)?
            }
            (StartsRequest::Episodic, _) => {
                self.starts(None, world.pool().env(0), variation)?.only(recorded.numbers)?
            }
        };
        let mut resolved = resolver.policy(policy, &world)?;
        let observed = observe(&mut world, &starts)?;
        let run = world.evaluate(&mut *resolved.policy, &starts, &self.config(policy, condition, options), control)?;
        Ok(Replay { run, starts: observed, rows: starts.rows().cloned() })
    }
}

/// Resets the world to every start and returns the columns of the environment, a row for each start.
fn observe(world: &mut World, starts: &Starts) -> Result<Batch> {
    let columns = world.spec().columns.clone();
    let mut observed = Batch::zeros(&Schema::new(columns.clone())?, starts.len());
    let slots = world.pool().len();
    for first in (0..starts.len()).step_by(slots) {
        let starting: Vec<(usize, usize)> = (0..slots.min(starts.len() - first)).map(|i| (i, first + i)).collect();
        starts.start(world.pool_mut(), &starting)?;
        let infos = world.pool().infos();
        for (slot, start) in starting {
            for (index, column) in columns.iter().enumerate() {
                let n = column.row_bytes();
                observed.bytes_mut(index)[start * n..][..n].copy_from_slice(&infos.bytes(index)[slot * n..][..n]);
            }
        }
    }
    Ok(observed)
}
