//! [`StochasticPolicy`]: a policy that draws actions from a network's distribution, without planning.

use super::agent::AgentPolicy;
use super::shared_model::SharedModel;
use crate::checkpoint::Checkpoint;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use std::time::Instant;
use swm_core::columns::{ACTION, STEP_IDX};
use swm_core::{Batch, EnvSpec, Error, Key, Policy, Result, RowRef};
use swm_plan::ActionScale;

/// A model with a distribution over actions.
pub trait StochasticActor: Trainable {
    /// Returns an action for the observation in a row, in model units from -1 to 1: drawn with `key`, or the most
    /// likely action if `key` is `None`.
    ///
    /// # Shapes
    /// Returns `[action_dim]`.
    ///
    /// # Errors
    /// When the row lacks a column that the model observes.
    fn act(&self, config: &TrainConfig<Self>, row: RowRef<'_>, key: Option<Key>) -> Result<Vec<f32>>;
}

/// A policy that executes the actions of a network. Every slot is computed separately, so the actions of a slot do not
/// depend on the other slots.
pub struct StochasticPolicy<M: StochasticActor> {
    config: TrainConfig<M>,
    scale: ActionScale,
    /// Bounds of an environment action, element by element.
    bounds: Vec<(f32, f32)>,
    model: SharedModel<M>,
    explore: bool,
    /// The key of each slot's episode.
    keys: Vec<Key>,
    /// Seconds per decision since the latencies were last taken.
    latencies: Vec<f64>,
}

impl<M: StochasticActor> StochasticPolicy<M> {
    /// Creates a policy for `slots` environments of `spec`; with `explore`, the policy draws actions, else the
    /// policy takes the most likely actions.
    ///
    /// # Errors
    /// When the model was trained for another action space.
    pub fn new(
        config: &TrainConfig<M>,
        dataset_info: &DatasetInfo,
        model: SharedModel<M>,
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
            model,
            explore,
            keys: vec![Key::new(0); slots],
            latencies: vec![],
        })
    }

    /// Creates the policy of a checkpoint, which does not explore.
    ///
    /// # Errors
    /// As [`StochasticPolicy::new`].
    pub fn of(checkpoint: &Checkpoint<M>, spec: &EnvSpec, slots: usize) -> Result<Self> {
        let model = SharedModel::new(checkpoint.model.clone());
        Self::new(&checkpoint.config, &checkpoint.dataset_info, model, spec, slots, false)
    }
}

impl<M: StochasticActor> AgentPolicy for StochasticPolicy<M> {}

impl<M: StochasticActor> Policy for StochasticPolicy<M> {
    fn begin(&mut self, slot: usize, key: Key) {
        self.keys[slot] = key.with("reflex");
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        let column = actions.schema().index(ACTION)?;
        // The key depends on the step of the episode, so that a policy that starts in mid-episode draws the same
        // actions.
        let steps = infos.get::<i32>(STEP_IDX)?;
        let model = self.model.get();
        let mut env_action = vec![0.0; self.bounds.len()];
        for (slot, key) in self.keys.iter().enumerate().filter(|&(slot, _)| active[slot]) {
            let start = Instant::now();
            let key = self.explore.then(|| key.at(steps[slot].unsigned_abs().into()));
            let action = model.act(&self.config, infos.row(slot), key)?;
            if action.len() != env_action.len() {
                let expected = format!("{}, the dimension of the environment's actions", env_action.len());
                return Err(Error::mismatch("acting", format!("{} elements per action", action.len()), expected));
            }
            self.scale.to_env(&action, &mut env_action);
            for (value, &(low, high)) in env_action.iter_mut().zip(&self.bounds) {
                *value = value.clamp(low, high);
            }
            actions.row_mut(slot).set(column, &env_action);
            self.latencies.push(start.elapsed().as_secs_f64());
        }
        Ok(())
    }

    fn uses_threads(&self) -> bool {
        false
    }

    /// Returns the seconds of each decision.
    fn take_latencies(&mut self) -> Vec<f64> {
        std::mem::take(&mut self.latencies)
    }
}
