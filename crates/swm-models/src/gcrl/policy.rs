//! Acting with a goal-conditioned policy: the mean action, given the present frame, those before it, and the goal.

use super::config::GcrlConfig;
use super::heads::Head;
use super::transformer::PatchGrid;
use crate::feed_forward::{ActionNetwork, FeedForwardPolicy};
use crate::nn::parameters::IntoF32;
use crate::nn::{Backbone, DropoutRng};
use crate::pixels;
use crate::probe::ImageEncoder;
use burn::tensor::{Device, Tensor};
use std::collections::VecDeque;
use swm_core::{EnvSpec, Result, RowRef, Schema};
use swm_plan::ActionScale;

/// Does what a trained model says, a model step at a time.
pub type GcrlPolicy = FeedForwardPolicy<Actor>;

/// What of a model acts.
pub struct Actor {
    pub(super) encoder: Backbone,
    pub(super) head: Head,
    pub(super) config: GcrlConfig,
    pub(super) scale: ActionScale,
}

/// Patches seen in an episode, `[1, patches, dim]` each.
#[derive(Default)]
pub struct Seen {
    goal: Option<Tensor<3>>,
    /// The frames of the model steps before, oldest first, as many as the history has.
    frames: VecDeque<Tensor<3>>,
}

impl Actor {
    /// A policy for `slots` environments of `spec`.
    ///
    /// # Errors
    /// When the model was trained for other actions.
    pub fn policy(self, spec: &EnvSpec, slots: usize) -> Result<GcrlPolicy> {
        FeedForwardPolicy::new(self, spec, slots)
    }

    /// The patches of pictures, `[frames, patches, dim]`.
    fn patches(&self, rgb: &[u8]) -> Result<Tensor<3>> {
        let (pixels, patch) = (self.config.pixels(), self.config.encoder.patch());
        Ok(self.encoder.patches(pixels::patches(&pixels, patch, rgb, &Device::flex())?))
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
    type EpisodeState = Seen;

    fn scale(&self) -> &ActionScale {
        &self.scale
    }

    fn check(&self, infos: &Schema) -> Result<()> {
        ["pixels", "goal"].into_iter().try_for_each(|name| pixels::check(self.config.image, infos, name))
    }

    fn next_actions(&self, seen: &mut Seen, row: RowRef<'_>) -> Result<Vec<f32>> {
        if seen.frames.len() == self.config.history {
            seen.frames.pop_front();
        }
        seen.frames.push_back(self.patches(row.get("pixels")?)?);
        let goal = match &mut seen.goal {
            Some(goal) => goal,
            none => none.insert(self.patches(row.get("goal")?)?),
        };
        let frames = Tensor::cat(seen.frames.iter().cloned().collect(), 1);
        let means = self.head.forward(&frames, goal, &mut DropoutRng::disabled());
        let [_, steps, numbers] = means.dims();
        Ok(means.slice([0..1, steps - 1..steps, 0..numbers]).into_data().into_f32_vec())
    }
}
