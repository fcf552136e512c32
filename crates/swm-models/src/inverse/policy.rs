//! Acting with an inverse-dynamics network.

use super::InverseCheckpoint;
use crate::feed_forward::{ActionNetwork, FeedForwardPolicy};
use crate::lewm::pixels;
use crate::nn::parameters::IntoF32;
use burn::tensor::{Device, Tensor, TensorData};
use swm_core::{Error, Result, RowRef, Schema};
use swm_plan::ActionScale;

/// Does what the network says leads from the picture to the goal's picture, a model step at a time.
pub type InversePolicy = FeedForwardPolicy<InverseCheckpoint>;

impl ActionNetwork for InverseCheckpoint {
    /// The latent of the goal, once it was seen.
    type EpisodeState = Option<Vec<f32>>;

    fn scale(&self) -> &ActionScale {
        &self.world.dataset_info.action
    }

    fn check(&self, infos: &Schema) -> Result<()> {
        ["pixels", "goal"].into_iter().try_for_each(|name| pixels::check(&self.world.config.model, infos, name))
    }

    fn next_actions(&self, goal: &mut Option<Vec<f32>>, row: RowRef<'_>) -> Result<Vec<f32>> {
        let device = Device::flex();
        let encode = |column: &str| {
            let patches = pixels::patches(&self.world.config.model, row.get::<u8>(column)?, &device)?;
            Ok::<_, Error>(self.world.model.encode(patches).into_data().into_f32_vec())
        };
        let mut pair = encode("pixels")?;
        match goal {
            Some(goal) => pair.extend_from_slice(goal),
            None => pair.extend_from_slice(goal.insert(encode("goal")?)),
        }
        let width = pair.len();
        let said = self.model.forward(Tensor::from_data(TensorData::new(pair, [1, width]), &device));
        Ok(said.into_data().into_f32_vec())
    }
}
