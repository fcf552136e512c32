//! [`StochasticPolicy`]: acting by a network alone.

use super::SharedModel;
use crate::Checkpoint;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use std::time::Instant;
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result, RowRef};
use swm_plan::ActionScale;

/// A model that knows what to do at a glance.
pub trait StochasticActor: Trainable {
    /// The action for what a row shows, in model units from -1 to 1: the one it thinks best, or one drawn by `key`.
    ///
    /// # Errors
    /// When the row lacks what the model sees.
    fn act(&self, config: &TrainConfig<Self>, row: RowRef<'_>, key: Option<Key>) -> Result<Vec<f32>>;
}

/// Does what a network says. Every slot is a call of its own, so what is done in one does not depend on the others.
pub struct StochasticPolicy<M: StochasticActor> {
    config: TrainConfig<M>,
    scale: ActionScale,
    bounds: Vec<(f32, f32)>,
    live: SharedModel<M>,
    explore: bool,
    slots: Vec<Key>,
    latencies: Vec<f64>,
}

impl<M: StochasticActor> StochasticPolicy<M> {
    /// A policy for `slots` worlds of `spec`; `explore` draws actions instead of taking the best.
    ///
    /// # Errors
    /// When the model was trained for other actions.
    #[allow(clippy::cast_possible_truncation)]
    pub fn new(
        config: &TrainConfig<M>,
        dataset_info: &DatasetInfo,
        live: SharedModel<M>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Self> {
        dataset_info.action.check(spec)?;
        let bounds = (0..spec.action_dim()).map(|i| spec.action_space.bounds(i));
        Ok(Self {
            config: config.clone(),
            scale: dataset_info.action.clone(),
            bounds: bounds.map(|(low, high)| (low as f32, high as f32)).collect(),
            live,
            explore,
            slots: vec![Key::new(0); slots],
            latencies: vec![],
        })
    }

    /// The policy of a checkpoint.
    ///
    /// # Errors
    /// As [`StochasticPolicy::new`].
    pub fn of(checkpoint: &Checkpoint<M>, spec: &EnvSpec, slots: usize) -> Result<Self> {
        let live = SharedModel::new(checkpoint.model.clone());
        Self::new(&checkpoint.config, &checkpoint.dataset_info, live, spec, slots, false)
    }
}

impl<M: StochasticActor> Policy for StochasticPolicy<M> {
    fn begin(&mut self, slot: usize, key: Key) {
        self.slots[slot] = key.with("reflex");
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index("action")?;
        // Of the episode, not of this policy: who comes in later does the same.
        let steps = infos.get::<i32>("step_idx")?;
        let model = self.live.get();
        let mut action = vec![0.0; self.bounds.len()];
        for (slot, key) in self.slots.iter().enumerate().filter(|&(slot, _)| active[slot]) {
            let begun = Instant::now();
            let key = self.explore.then(|| key.at(steps[slot].unsigned_abs().into()));
            let said = model.act(&self.config, infos.row(slot), key)?;
            if said.len() != action.len() {
                let expected = format!("{}, as the world has", action.len());
                return Err(Error::mismatch("acting", format!("{} numbers an action", said.len()), expected));
            }
            self.scale.to_env(&said, &mut action);
            for (number, &(low, high)) in action.iter_mut().zip(&self.bounds) {
                *number = number.clamp(low, high);
            }
            actions.row_mut(slot).set(column, &action);
            self.latencies.push(begun.elapsed().as_secs_f64());
        }
        Ok(())
    }

    fn uses_threads(&self) -> bool {
        false
    }

    /// Seconds each decision took.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
