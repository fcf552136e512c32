//! Policies that need no training and show what a success rate means: [`NoOpPolicy`], [`ReplayPolicy`] and
//! [`NearestPolicy`].
//!
//! Where doing nothing solves starts, success says little; where recorded actions do not solve their own starts, the
//! environment does not repeat what was recorded; where the nearest recorded actions solve starts, memory suffices.

use crate::nearest::{NearestPolicy, Recordings};
use crate::request::{HeldOut, PolicyKind};
use crate::starts::Starts;
use crate::world::World;
use std::collections::HashMap;
use std::sync::Arc;
use swm_core::columns::ACTION;
use swm_core::policy::write_action;
use swm_core::{Batch, ColumnSpec, DType, EnvSpec, Error, Key, Policy, RandomPolicy, Result, Space};
use swm_data::{Part, Reader, StepRange};

/// Makes the baselines of an evaluation, the random-policy floor included.
pub(crate) struct Baselines<'a> {
    /// The dataset that the starts come from.
    dataset: Option<&'a dyn Reader>,
    /// The part of the dataset that the starts come from.
    held_out: Option<HeldOut>,
    /// What [`NearestPolicy`] searches, which is read once.
    recordings: Option<Arc<Recordings>>,
}

impl<'a> Baselines<'a> {
    /// The baselines of starts from a dataset, if they come from one.
    pub(crate) fn new(dataset: Option<&'a dyn Reader>, held_out: Option<HeldOut>) -> Self {
        Self { dataset, held_out, recordings: None }
    }

    /// Checks a baseline before the first episode; returns whether the policy is one.
    ///
    /// # Errors
    /// When the environment or the dataset does not have what the baseline needs.
    pub(crate) fn check(&mut self, kind: &PolicyKind, world: &World) -> Result<bool> {
        match kind {
            PolicyKind::Random => {}
            PolicyKind::NoOp => drop(NoOpPolicy::new(world.spec())?),
            PolicyKind::Replay => {
                recorded("replay", self.dataset)?;
            }
            PolicyKind::Nearest => drop(self.recordings(world)?),
            _ => return Ok(false),
        }
        Ok(true)
    }

    /// Makes the policy for these starts; `None` if it is no baseline.
    ///
    /// # Errors
    /// As [`Baselines::check`].
    pub(crate) fn policy(
        &mut self,
        kind: &PolicyKind,
        world: &World,
        starts: &Starts,
    ) -> Result<Option<Box<dyn Policy>>> {
        let (spec, slots) = (world.spec(), world.pool().len());
        Ok(Some(match kind {
            PolicyKind::Random => Box::new(RandomPolicy::new(spec, slots)),
            PolicyKind::NoOp => Box::new(NoOpPolicy::new(spec)?),
            PolicyKind::Replay => {
                let budget = world.pool().max_episode_steps();
                Box::new(ReplayPolicy::new(spec, slots, (starts, self.dataset), budget)?)
            }
            PolicyKind::Nearest => Box::new(NearestPolicy::new(spec, slots, starts, self.recordings(world)?)?),
            _ => return Ok(None),
        }))
    }

    /// The recordings that [`NearestPolicy`] searches: those that a model may be trained on, if the starts are held out.
    fn recordings(&mut self, world: &World) -> Result<Arc<Recordings>> {
        if let Some(recordings) = &self.recordings {
            return Ok(Arc::clone(recordings));
        }
        let reader = recorded("nearest", self.dataset)?;
        let positions = match self.held_out {
            Some(HeldOut { split, .. }) => split.episodes(reader, Part::Train)?,
            None => (0..reader.episodes().len()).collect(),
        };
        let read = Recordings::read(world.spec(), world.pool().infos().schema(), reader, &positions)?;
        Ok(Arc::clone(self.recordings.insert(Arc::new(read))))
    }
}

/// Returns the dataset that the starts come from.
///
/// # Errors
/// When there is none, so that the policy with this name has no recorded actions.
fn recorded<'a>(policy: &str, reader: Option<&'a dyn Reader>) -> Result<&'a dyn Reader> {
    reader.ok_or_else(|| {
        let problem = "the environment draws the starts, so no actions are recorded";
        Error::config(format!("policy '{policy}'"), problem, "take starts from a dataset (--dataset)")
    })
}

/// Checks that the recorded actions, a column of a dataset, are actions of an environment.
///
/// # Errors
/// When their number of elements or their type differs.
pub(crate) fn check_actions(spec: &EnvSpec, given: &ColumnSpec) -> Result<()> {
    let is_float = |dtype| matches!(dtype, DType::Float32 | DType::Float64);
    let (len, dim) = (given.len(), spec.action_dim());
    if len == dim && is_float(given.dtype) == is_float(spec.action_space.dtype()) {
        return Ok(());
    }
    let expected = format!("{dim} of type {:?}", spec.action_space.dtype());
    Err(Error::mismatch(
        format!("repeating the recorded actions in {}", spec.id),
        format!("actions of {len} elements of type {:?}", given.dtype),
        expected,
    ))
}

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
        let reader = recorded("replay", reader)?;
        let picks: Vec<[usize; 2]> = (0..starts.len()).filter_map(|i| starts.pick(i)).collect();
        let steps = |[episode, step]: [usize; 2]| {
            let length = reader.episodes().get(episode).map_or(0, |episode| episode.length);
            // The last row of an episode has no action.
            length.saturating_sub(step + 1).min(budget)
        };
        let picked = picks.iter().enumerate().map(|(i, &pick)| (i, StepRange::new(pick[0], pick[1], steps(pick))));
        let (episodes, ranges): (Vec<usize>, Vec<StepRange>) = picked.filter(|(_, range)| range.length > 0).unzip();
        let read = reader.read(&[ACTION], &ranges)?;
        check_actions(spec, &read.schema().columns()[0])?;
        let (mut by_key, mut row) = (HashMap::new(), 0);
        for (episode, range) in episodes.into_iter().zip(&ranges) {
            let actions: Result<_> = (row..row + range.length).map(|row| read.row(row).to_f64(ACTION)).collect();
            row += range.length;
            by_key.insert(starts.key(episode), actions?);
        }
        Ok(Self { recorded: by_key, no_op: no_op(spec), slots: vec![(Key::new(0), 0); slots] })
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
