//! [`Agent`]: the contract between a model and the online training loop.

use super::shared_model::SharedModel;
use crate::checkpoint::Checkpoint;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use swm_core::columns::{REWARD, TERMINATED};
use swm_core::{EnvSpec, Error, Policy, Result, Schema};

/// A model that learns by interaction.
pub trait Agent: Trainable {
    /// Creates a policy for `slots` environments of `spec` that always acts with the present weights of `model`. With
    /// `explore`, the actions include exploration noise.
    ///
    /// # Errors
    /// When the model does not fit the environment.
    fn policy(
        config: &TrainConfig<Self>,
        dataset_info: &DatasetInfo,
        model: SharedModel<Self>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Box<dyn AgentPolicy>>;
}

/// The policy of an agent. What it remembers of the running episodes is saved with a run, so that a continued run acts as an
/// uninterrupted one.
pub trait AgentPolicy: Policy {
    /// Returns what the policy remembers of the episode in each slot, beyond its key; empty if it remembers nothing.
    fn memory(&self) -> Vec<Vec<f32>> {
        vec![]
    }

    /// Takes up what [`Self::memory`] returned, after [`Policy::begin`] of every slot.
    ///
    /// # Errors
    /// When the memory has another shape.
    fn recall(&mut self, memory: &[Vec<f32>]) -> Result<()> {
        if memory.is_empty() {
            return Ok(());
        }
        Err(Error::mismatch("continuing a training run", "a policy with a memory", "one without"))
    }
}

/// Creates the policy of a trained agent, which does not explore.
///
/// # Errors
/// When the model does not fit the environment.
pub fn policy<M: Agent>(checkpoint: &Checkpoint<M>, spec: &EnvSpec, slots: usize) -> Result<Box<dyn Policy>> {
    let model = SharedModel::new(checkpoint.model.clone());
    Ok(M::policy(&checkpoint.config, &checkpoint.dataset_info, model, spec, slots, false)?)
}

/// Checks that a dataset has rewards to learn from.
///
/// # Errors
/// When a column is missing; the error names the column.
pub(crate) fn check_rewards(schema: &Schema) -> Result<()> {
    match [REWARD, TERMINATED].into_iter().find(|name| schema.find(name).is_none()) {
        None => Ok(()),
        Some(name) => Err(Error::config(
            format!("the column '{name}'"),
            "the dataset lacks this column",
            "train on a dataset with rewards, such as `swm collect` writes",
        )),
    }
}
