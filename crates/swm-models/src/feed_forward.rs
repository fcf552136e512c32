//! [`FeedForwardPolicy`]: a policy that runs a network once per model step, without planning.

use rayon::prelude::*;
use std::time::Instant;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result, RowRef, Schema};
use swm_plan::ActionScale;

/// A network that computes the actions of a model step.
pub trait ActionNetwork: Send + Sync {
    /// The state of the network within an episode, such as the encoded goal.
    type EpisodeState: Default + Send;

    /// Returns the scale between environment units and model units of actions.
    fn scale(&self) -> &ActionScale;

    /// Checks that `infos` has the columns that the network reads.
    ///
    /// # Errors
    /// When a column is missing or has another shape.
    fn check(&self, infos: &Schema) -> Result<()>;

    /// Computes the actions of the next model step in model units.
    ///
    /// # Shapes
    /// Returns `[action_block, action_dim]`.
    ///
    /// # Errors
    /// When the row lacks a column that the network reads.
    fn next_actions(&self, state: &mut Self::EpisodeState, row: RowRef<'_>) -> Result<Vec<f32>>;
}

/// A policy that executes the actions of a network, one model step at a time.
///
/// The network processes every environment separately, so the actions of an environment depend neither on the other
/// environments nor on the number of threads.
pub struct FeedForwardPolicy<N: ActionNetwork> {
    network: N,
    /// The bounds of each element of an environment action, `[action_dim]`.
    bounds: Vec<(f32, f32)>,
    slots: Vec<Slot<N::EpisodeState>>,
    /// Seconds per model step since the last call of [`Policy::take_latencies`].
    latencies: Vec<f64>,
}

/// The state of an environment's episode.
#[derive(Default)]
struct Slot<S> {
    state: S,
    /// The actions of the current model step, `[action_block, action_dim]`, in environment units.
    actions: Vec<f32>,
    /// The number of elements of `actions` that have been executed.
    done: usize,
    /// Whether the network must compute the next actions.
    due: bool,
    /// The error of the last model step, until [`Policy::act`] returns the error.
    failed: Option<Error>,
}

impl<N: ActionNetwork> FeedForwardPolicy<N> {
    /// Creates a policy for `slots` environments with the specification `spec`.
    ///
    /// # Errors
    /// When the network was trained for another action space.
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

/// Computes a slot's next actions, clamped to `bounds`.
fn compute_actions<N: ActionNetwork>(
    network: &N,
    bounds: &[(f32, f32)],
    slot: &mut Slot<N::EpisodeState>,
    row: RowRef<'_>,
) -> Result<()> {
    let model_actions = network.next_actions(&mut slot.state, row)?;
    let dim = bounds.len();
    slot.actions.resize(model_actions.len(), 0.0);
    slot.done = 0;
    for (to, from) in slot.actions.chunks_exact_mut(dim).zip(model_actions.chunks_exact(dim)) {
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
        let start = Instant::now();
        let (network, bounds) = (&self.network, &self.bounds);
        self.slots.par_iter_mut().enumerate().filter(|(_, slot)| slot.due).for_each(|(row, slot)| {
            slot.failed = compute_actions(network, bounds, slot, infos.row(row)).err();
        });
        if let Some(error) = self.slots.iter_mut().find_map(|slot| slot.failed.take()) {
            return Err(error);
        }
        let due = self.slots.iter().filter(|slot| slot.due).count();
        if due > 0 {
            let seconds = start.elapsed().as_secs_f64() / due as f64;
            self.latencies.extend(std::iter::repeat_n(seconds, due));
        }
        let dim = self.bounds.len();
        for (row, slot) in self.slots.iter_mut().enumerate().filter(|&(row, _)| active[row]) {
            actions.row_mut(row).set(column, &slot.actions[slot.done..][..dim]);
            slot.done += dim;
        }
        Ok(())
    }

    /// Returns the seconds of each model step, encoding included. The time of a parallel computation is divided equally
    /// among the environments.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
