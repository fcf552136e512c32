//! [`GcrlConfig`]: the configuration of a goal-conditioned model.

use super::transformer::{PatchGrid, TransformerConfig};
use crate::checks;
use crate::nn::BackboneConfig;
use crate::pixels::ImageNormalization;
use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The configuration of a goal-conditioned model. All heads have the same sizes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GcrlConfig {
    /// Side of the square input images in pixels.
    pub image: usize,
    /// Mean of each colour channel for pixel values in 0 ..= 1.
    pub pixel_mean: [f32; 3],
    /// Standard deviation of each colour channel for pixel values in 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Number of input frames, including the current frame.
    pub history: usize,
    /// Whether the encoder is not trained.
    pub frozen: bool,
    /// Source of the encoder's initial weights: a file, a checkpoint or a repository; empty for random weights.
    pub weights: String,
    /// The encoder.
    pub encoder: BackboneConfig,
    /// The heads.
    pub head: TransformerConfig,
    /// Hidden features of the critic's head, for families with a critic.
    #[serde(default = "critic")]
    pub critic: usize,
    /// Dimensions of the space in which the value of GCIVL is a negative distance, as in HILP; 0 for a value that is none.
    #[serde(default)]
    pub metric: usize,
}

/// Returns the published number of hidden features of the critic's head.
fn critic() -> usize {
    256
}

impl GcrlConfig {
    /// Returns the normalisation of input images.
    pub fn pixels(&self) -> ImageNormalization {
        ImageNormalization { side: self.image, mean: self.pixel_mean, std: self.pixel_std }
    }

    /// Returns the sizes of the heads' input. An encoder without patches gives one patch per image.
    pub(super) fn patch_grid(&self) -> PatchGrid {
        let patches = self.encoder.patches(self.image);
        PatchGrid { frames: self.history, patches, dim: self.encoder.patch_dim() }
    }

    /// Checks that the value is no metric, for a family without that option.
    ///
    /// # Errors
    /// When the value is a metric.
    pub(super) fn check_no_metric(&self, family: &str) -> Result<()> {
        if self.metric == 0 {
            return Ok(());
        }
        Err(Error::config(
            "model.metric",
            format!("{}, but {family} has no value that is a metric", self.metric),
            "train gcivl, or leave the setting out",
        ))
    }

    /// Checks the configuration.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        self.encoder.check("model.encoder", self.image)?;
        let TransformerConfig { depth, heads, dim_head, mlp, dropout, emb_dropout } = self.head;
        check_sizes(&[
            ("model.head.depth", depth, 1, limits::LAYERS),
            ("model.history", self.history, 1, limits::FRAMES),
            ("model.head.heads", heads, 1, limits::FEATURES),
            ("model.head.dim_head", dim_head, 1, limits::FEATURES),
            ("model.head.mlp", mlp, 1, limits::FEATURES),
            ("model.critic", self.critic, 1, limits::FEATURES),
            ("model.metric", self.metric, 0, limits::FEATURES),
        ])?;
        if depth < 3 {
            return Err(Error::config(
                "model.head.depth",
                format!("with {depth} layers a policy never attends to the goal"),
                "give at least 3: one for the frames, one for the goal, one for pooling",
            ));
        }
        checks::dropout_rates(&[("model.head.dropout", dropout), ("model.head.emb_dropout", emb_dropout)])?;
        checks::pixel_normalization(self.pixel_mean, self.pixel_std)?;
        if self.frozen && self.weights.is_empty() {
            return Err(Error::config(
                "model.weights",
                "a frozen encoder without weights would keep its random initial values",
                "set model.weights, or set model.frozen=false",
            ));
        }
        Ok(())
    }
}
