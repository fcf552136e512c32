//! Online training: playing and learning by turns, in one process.
//!
//! A round is one step of every world, then as many gradient steps as the settings say. What happens goes to a replay buffer
//! in parts of an episode; batches are drawn from it uniformly. Everything is decided by the seed: an episode by its number, a batch by the
//! number of its gradient step and what the buffer holds then. Neither threads nor the machine's speed have a say.
//!
//! What an episode's clock cut short is not its end: only `terminated` stops a value from looking further.

mod collector;
mod config;
mod evaluation;
mod learner;
mod planner_config;
mod run;
mod shared_model;
mod stochastic_policy;
mod world;

pub use config::OnlineConfig;
pub use planner_config::PlannerConfig;
pub use run::{OnlineSummary, train_online};
pub use shared_model::SharedModel;
pub use stochastic_policy::{StochasticActor, StochasticPolicy};
pub use world::dataset_info;

use crate::checkpoint::Checkpoint;
use crate::train::{DatasetInfo, TrainConfig, Trainable};
use swm_core::{EnvSpec, Error, Policy, Result, Schema};

/// A model that learns by playing.
pub trait Agent: Trainable {
    /// Who acts with the weights that `live` holds, whatever they are at the moment; `explore` also tries what it does not
    /// think best.
    ///
    /// # Errors
    /// When the model does not fit the world.
    fn policy(
        config: &TrainConfig<Self>,
        dataset_info: &DatasetInfo,
        live: SharedModel<Self>,
        spec: &EnvSpec,
        slots: usize,
        explore: bool,
    ) -> Result<Box<dyn Policy>>;
}

/// Returns the policy of a trained agent, which does not explore.
///
/// # Errors
/// When the model does not fit the environment.
pub fn policy<M: Agent>(checkpoint: &Checkpoint<M>, spec: &EnvSpec, slots: usize) -> Result<Box<dyn Policy>> {
    let model = SharedModel::new(checkpoint.model.clone());
    M::policy(&checkpoint.config, &checkpoint.dataset_info, model, spec, slots, false)
}

/// Checks that there are rewards to learn from.
///
/// # Errors
/// Naming the column that is missing.
pub(crate) fn has_rewards(schema: &Schema) -> Result<()> {
    match ["reward", "terminated"].into_iter().find(|name| schema.find(name).is_none()) {
        None => Ok(()),
        Some(name) => Err(Error::config(
            format!("the column '{name}'"),
            "the dataset has none",
            "train on a dataset with rewards, such as `swm collect` writes",
        )),
    }
}
