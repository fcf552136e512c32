//! [`FeedForwardPolicy`]: acting with a network that is asked once a model step, without planning.

use rayon::prelude::*;
use std::time::Instant;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result, RowRef, Schema};
use swm_plan::ActionScale;

/// A network that says what to do.
pub trait ActionNetwork: Send + Sync {
    /// What it remembers of an episode.
    type EpisodeState: Default + Send;

    /// Between environment actions and its own.
    fn scale(&self) -> &ActionScale;

    /// Checks that everything needed is there.
    ///
    /// # Errors
    /// When a column is missing or of another shape.
    fn check(&self, infos: &Schema) -> Result<()>;

    /// The actions of the next model step, in model units: one environment action after another.
    ///
    /// # Errors
    /// When what the row holds cannot be read.
    fn next_actions(&self, memory: &mut Self::EpisodeState, row: RowRef<'_>) -> Result<Vec<f32>>;
}

/// Does what a network says, a model step at a time. Every environment is decided for by itself, so what it does is the
/// same bytes whoever plays beside it and however many threads there are.
pub struct FeedForwardPolicy<N: ActionNetwork> {
    network: N,
    /// Bounds of an environment action.
    bounds: Vec<(f32, f32)>,
    slots: Vec<Slot<N::EpisodeState>>,
    latencies: Vec<f64>,
}

#[derive(Default)]
struct Slot<M> {
    memory: M,
    /// The actions of the present model step, in environment units, and how many of their numbers are done.
    actions: Vec<f32>,
    done: usize,
    due: bool,
    failed: Option<Error>,
}

impl<N: ActionNetwork> FeedForwardPolicy<N> {
    /// A policy for `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the network was trained for other actions.
    #[allow(clippy::cast_possible_truncation)]
    pub fn new(network: N, spec: &EnvSpec, slots: usize) -> Result<Self> {
        network.scale().check(spec)?;
        let bounds = (0..spec.action_dim()).map(|i| spec.action_space.bounds(i));
        Ok(Self {
            network,
            bounds: bounds.map(|(low, high)| (low as f32, high as f32)).collect(),
            slots: (0..slots).map(|_| Slot::default()).collect(),
            latencies: vec![],
        })
    }
}

/// Asks for a slot's next actions, within `bounds`.
fn ask<N: ActionNetwork>(
    network: &N,
    bounds: &[(f32, f32)],
    slot: &mut Slot<N::EpisodeState>,
    row: RowRef<'_>,
) -> Result<()> {
    let said = network.next_actions(&mut slot.memory, row)?;
    let dim = bounds.len();
    slot.actions.resize(said.len(), 0.0);
    slot.done = 0;
    for (to, from) in slot.actions.chunks_exact_mut(dim).zip(said.chunks_exact(dim)) {
        network.scale().to_env(from, to);
        for (value, &(low, high)) in to.iter_mut().zip(bounds) {
            *value = value.clamp(low, high);
        }
    }
    Ok(())
}

impl<N: ActionNetwork> Policy for FeedForwardPolicy<N> {
    fn begin(&mut self, slot: usize, _: Key) {
        self.slots[slot] = Slot::default();
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index("action")?;
        self.network.check(infos.schema())?;
        for (slot, &active) in self.slots.iter_mut().zip(active) {
            slot.due = active && slot.done == slot.actions.len();
        }
        let begun = Instant::now();
        let (network, bounds) = (&self.network, &self.bounds);
        self.slots.par_iter_mut().enumerate().filter(|(_, slot)| slot.due).for_each(|(row, slot)| {
            slot.failed = ask(network, bounds, slot, infos.row(row)).err();
        });
        if let Some(error) = self.slots.iter_mut().find_map(|slot| slot.failed.take()) {
            return Err(error);
        }
        let due = self.slots.iter().filter(|slot| slot.due).count();
        if due > 0 {
            #[allow(clippy::cast_precision_loss)]
            let share = begun.elapsed().as_secs_f64() / due as f64;
            self.latencies.extend(std::iter::repeat_n(share, due));
        }
        let dim = self.bounds.len();
        for (row, slot) in self.slots.iter_mut().enumerate().filter(|&(row, _)| active[row]) {
            actions.row_mut(row).set(column, &slot.actions[slot.done..][..dim]);
            slot.done += dim;
        }
        Ok(())
    }

    /// Seconds each decision took, encodings included: environments decided together share their time equally.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
