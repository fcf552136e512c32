//! [`InversePolicy`]: a policy that acts with an inverse-dynamics network.

use super::InverseCheckpoint;
use crate::feed_forward::{ActionNetwork, FeedForwardPolicy};
use crate::lewm::{encode, pixels};
use crate::nn::parameters::host;
use burn::tensor::{Tensor, TensorData};
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{Result, RowRef, Schema};
use swm_plan::ActionScale;

/// A policy that takes the actions which an inverse-dynamics network predicts for the present image and the goal image,
/// one model step at a time.
pub type InversePolicy = FeedForwardPolicy<InverseCheckpoint>;

impl ActionNetwork for InverseCheckpoint {
    /// The latent of the goal, encoded at the first step of an episode.
    type EpisodeState = Option<Vec<f32>>;

    fn scale(&self) -> &ActionScale {
        &self.world_model.dataset_info.action
    }

    fn check(&self, infos: &Schema) -> Result<()> {
        [PIXELS, GOAL].into_iter().try_for_each(|name| pixels::check(&self.world_model.config.model, infos, name))
    }

    fn next_actions(&self, goal: &mut Option<Vec<f32>>, row: RowRef<'_>) -> Result<Vec<f32>> {
        let encode =
            |column: &str| encode(&self.world_model.model, &self.world_model.config.model, row.get::<u8>(column)?);
        let mut pair = encode(PIXELS)?;
        match goal {
            Some(goal) => pair.extend_from_slice(goal),
            None => pair.extend_from_slice(goal.insert(encode(GOAL)?)),
        }
        let width = pair.len();
        Ok(host(
            self.model.forward(Tensor::from_data(TensorData::new(pair, [1, width]), &self.world_model.model.device())),
        ))
    }
}
