//! Policies that need no training and show what a success rate means: [`NoOpPolicy`] and [`ReplayPolicy`].
//!
//! Where doing nothing solves starts, success says little; where recorded actions do not solve their own starts, the
//! environment does not repeat what was recorded.

use crate::starts::Starts;
use std::collections::HashMap;
use swm_core::columns::ACTION;
use swm_core::policy::write_action;
use swm_core::{Batch, DType, EnvSpec, Error, Key, Policy, Result, Space};
use swm_data::{Reader, StepRange};

/// Does nothing: all its actions are zero, or the bound nearest to zero.
pub struct NoOpPolicy {
    action: Vec<f64>,
}

impl NoOpPolicy {
    /// A policy for an environment.
    ///
    /// # Errors
    /// When the actions are integers, of which none is known to do nothing.
    pub fn new(spec: &EnvSpec) -> Result<Self> {
        match no_op(spec) {
            Some(action) => Ok(Self { action }),
            None => Err(Error::config(
                "policy 'no-op'",
                format!("{} has the actions {}", spec.id, spec.action_space.describe()),
                "leave it out: of integers, none is known to do nothing",
            )),
        }
    }
}

/// The action that does nothing; `None` for actions that are integers.
fn no_op(spec: &EnvSpec) -> Option<Vec<f64>> {
    let space = &spec.action_space;
    let nearest = |i| {
        let (low, high) = space.bounds(i);
        0.0_f64.clamp(low.min(high), high)
    };
    matches!(space, Space::Box { .. }).then(|| (0..space.len()).map(nearest).collect())
}

impl Policy for NoOpPolicy {
    fn begin(&mut self, _: usize, _: Key) {}

    fn act(&mut self, _: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(ACTION)?;
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            write_action(&mut actions.row_mut(slot), column, &self.action);
        }
        Ok(())
    }

    fn uses_threads(&self) -> bool {
        false
    }
}

/// Repeats the recorded actions that follow the rows which the starts come from. After their end it does nothing, or
/// repeats the last one if actions are integers.
pub struct ReplayPolicy {
    /// The actions of every episode, `[steps, dim]`, by its key.
    recorded: HashMap<Key, Vec<Vec<f64>>>,
    /// The action after the end of the recorded ones.
    no_op: Option<Vec<f64>>,
    /// The episode of each slot and its number of actions so far.
    slots: Vec<(Key, usize)>,
}

impl ReplayPolicy {
    /// Returns the dataset that the starts come from.
    ///
    /// # Errors
    /// When there is none.
    pub fn check(reader: Option<&dyn Reader>) -> Result<&dyn Reader> {
        reader.ok_or_else(|| {
            let problem = "the environment draws the starts, so no actions are recorded";
            Error::config("policy 'replay'", problem, "take starts from a dataset (--dataset)")
        })
    }

    /// A policy for these starts in `slots` environments, which play at most `budget` steps.
    ///
    /// # Errors
    /// When the starts do not come from a dataset, or the dataset has other actions than the environment.
    pub fn new(
        spec: &EnvSpec,
        slots: usize,
        (starts, reader): (&Starts, Option<&dyn Reader>),
        budget: usize,
    ) -> Result<Self> {
        let reader = Self::check(reader)?;
        let picks: Vec<[usize; 2]> = (0..starts.len()).filter_map(|i| starts.pick(i)).collect();
        let steps = |[episode, step]: [usize; 2]| {
            let length = reader.episodes().get(episode).map_or(0, |episode| episode.length);
            // The last row of an episode has no action.
            length.saturating_sub(step + 1).min(budget)
        };
        let picked = picks.iter().enumerate().map(|(i, &pick)| (i, StepRange::new(pick[0], pick[1], steps(pick))));
        let (episodes, ranges): (Vec<usize>, Vec<StepRange>) = picked.filter(|(_, range)| range.length > 0).unzip();
        let read = reader.read(&[ACTION], &ranges)?;
        let (given, dim) = (&read.schema().columns()[0], spec.action_dim());
        let is_float = |dtype| matches!(dtype, DType::Float32 | DType::Float64);
        let len: usize = given.shape.iter().product();
        if len != dim || is_float(given.dtype) != is_float(spec.action_space.dtype()) {
            let what = format!("repeating the recorded actions in {}", spec.id);
            let expected = format!("{dim} of type {:?}", spec.action_space.dtype());
            return Err(Error::mismatch(
                what,
                format!("actions of {len} elements of type {:?}", given.dtype),
                expected,
            ));
        }
        let (mut recorded, mut row) = (HashMap::new(), 0);
        for (episode, range) in episodes.into_iter().zip(&ranges) {
            let actions = (row..row + range.length).map(|row| values(&read, row)).collect();
            row += range.length;
            recorded.insert(starts.key(episode), actions);
        }
        Ok(Self { recorded, no_op: no_op(spec), slots: vec![(Key::new(0), 0); slots] })
    }
}

/// The action in a row, in the type of its column.
fn values(read: &Batch, row: usize) -> Vec<f64> {
    match read.schema().columns()[0].dtype {
        DType::Float32 => read.row(row).at::<f32>(0).iter().map(|&value| value.into()).collect(),
        DType::Float64 => read.row(row).at::<f64>(0).to_vec(),
        _ => read.row(row).at::<i64>(0).iter().map(|&value| value as f64).collect(),
    }
}

impl Policy for ReplayPolicy {
    fn begin(&mut self, slot: usize, key: Key) {
        self.slots[slot] = (key, 0);
    }

    fn act(&mut self, _: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(ACTION)?;
        for slot in (0..active.len()).filter(|&slot| active[slot]) {
            let (key, step) = &mut self.slots[slot];
            let recorded = self.recorded.get(key).map_or(&[][..], Vec::as_slice);
            let action = recorded.get(*step).or(self.no_op.as_ref()).or_else(|| recorded.last());
            if let Some(action) = action {
                write_action(&mut actions.row_mut(slot), column, action);
            }
            *step += 1;
        }
        Ok(())
    }

    fn uses_threads(&self) -> bool {
        false
    }
}
