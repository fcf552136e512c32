//! [`GcrlPolicy`]: a policy that acts with the mean actions of a goal-conditioned model, given recent frames and the
//! goal.

use super::config::GcrlConfig;
use super::heads::Head;
use super::transformer::PatchGrid;
use crate::feed_forward::{ActionNetwork, FeedForwardPolicy};
use crate::nn::parameters::IntoF32;
use crate::nn::{Backbone, DropoutRng};
use crate::pixels;
use crate::probe::ImageEncoder;
use burn::tensor::Tensor;
use std::collections::VecDeque;
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{EnvSpec, Result, RowRef, Schema};
use swm_plan::ActionScale;

/// A policy that acts with the mean actions of a goal-conditioned model, one model step at a time.
pub type GcrlPolicy = FeedForwardPolicy<Actor>;

/// The encoder and the policy head of a goal-conditioned model.
pub struct Actor {
    pub(super) encoder: Backbone,
    pub(super) head: Head,
    pub(super) config: GcrlConfig,
    pub(super) scale: ActionScale,
}

/// The encoded patches of an episode's images, `[1, patches, dim]` per image.
#[derive(Default)]
pub struct EpisodePatches {
    goal: Option<Tensor<3>>,
    /// The frames of the last model steps, oldest first, at most as many as the history.
    frames: VecDeque<Tensor<3>>,
}

impl Actor {
    /// Creates a policy for `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the model was trained for another action space.
    pub fn policy(self, spec: &EnvSpec, slots: usize) -> Result<GcrlPolicy> {
        FeedForwardPolicy::new(self, spec, slots)
    }

    /// Encodes images.
    ///
    /// # Shapes
    /// `rgb` is `[frames, image, image, 3]`; returns `[frames, patches, dim]`.
    fn patches(&self, rgb: &[u8]) -> Result<Tensor<3>> {
        let (pixels, patch) = (self.config.pixels(), self.config.encoder.patch());
        Ok(self.encoder.patches(pixels::patches(&pixels, patch, rgb, &self.head.pos_embedding.val().device())?))
    }
}

impl ImageEncoder for Actor {
    fn image_size(&self) -> usize {
        self.config.image
    }

    fn latent_dim(&self) -> usize {
        let PatchGrid { patches, dim, .. } = self.config.patch_grid();
        patches * dim
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        Ok(self.patches(rgb)?.into_data().into_f32_vec())
    }
}

impl ActionNetwork for Actor {
    type EpisodeState = EpisodePatches;

    fn scale(&self) -> &ActionScale {
        &self.scale
    }

    fn check(&self, infos: &Schema) -> Result<()> {
        [PIXELS, GOAL].into_iter().try_for_each(|name| pixels::check(self.config.image, infos, name))
    }

    fn next_actions(&self, episode: &mut EpisodePatches, row: RowRef<'_>) -> Result<Vec<f32>> {
        if episode.frames.len() == self.config.history {
            episode.frames.pop_front();
        }
        episode.frames.push_back(self.patches(row.get(PIXELS)?)?);
        let goal = match &mut episode.goal {
            Some(goal) => goal,
            none => none.insert(self.patches(row.get(GOAL)?)?),
        };
        let frames = Tensor::cat(episode.frames.iter().cloned().collect(), 1);
        let means = self.head.forward(&frames, goal, &mut DropoutRng::disabled());
        let [_, steps, elements] = means.dims();
        Ok(means.slice([0..1, steps - 1..steps, 0..elements]).into_data().into_f32_vec())
    }
}
