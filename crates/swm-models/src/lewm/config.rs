//! [`LewmConfig`]: the model configuration of a LeWM.

use crate::checks;
pub use crate::nn::BackboneConfig as EncoderConfig;
use crate::nn::PredictorConfig;
use crate::train::{check_sizes, limits};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The model configuration of a LeWM.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LewmConfig {
    /// Side of the square input images in pixels.
    pub image: usize,
    /// Mean of each colour channel for pixel values in 0 ..= 1.
    pub pixel_mean: [f32; 3],
    /// Standard deviation of each colour channel for pixel values in 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Latent dimension.
    pub latent: usize,
    /// Output features of the first layer of the action encoder; 0 for the action dimension.
    #[serde(default)]
    pub smoothed: usize,
    /// Hidden features of the projectors after the encoder and the predictor.
    pub projector: usize,
    /// The encoder.
    pub encoder: EncoderConfig,
    /// The predictor.
    pub predictor: PredictorConfig,
    /// A decoder of latents, for an encoder with fixed features; none if left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub decoder: Option<DecoderConfig>,
}

/// A decoder that computes the encoder's fixed features from a latent. It is part of the loss only.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DecoderConfig {
    /// Hidden features.
    pub hidden: usize,
    /// The weight of the decoder's mean squared error in the loss.
    pub weight: f32,
}

impl LewmConfig {
    /// Checks the configuration.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        let predictor = &self.predictor;
        check_sizes(&[
            ("model.image", self.image, 1, limits::SIDE),
            ("model.latent", self.latent, 1, limits::FEATURES),
            ("model.smoothed", self.smoothed, 0, limits::FEATURES),
            ("model.projector", self.projector, 1, limits::FEATURES),
            ("model.predictor.history", predictor.history, 1, limits::FRAMES),
            ("model.predictor.dim", predictor.dim, 1, limits::FEATURES),
            ("model.predictor.depth", predictor.depth, 1, limits::LAYERS),
            ("model.predictor.heads", predictor.heads, 1, limits::FEATURES),
            ("model.predictor.dim_head", predictor.dim_head, 1, limits::FEATURES),
            ("model.predictor.mlp", predictor.mlp, 1, limits::FEATURES),
        ])?;
        checks::dropout_rates(&[
            ("model.predictor.dropout", predictor.dropout),
            ("model.predictor.emb_dropout", predictor.emb_dropout),
        ])?;
        checks::pixel_normalization(self.pixel_mean, self.pixel_std)?;
        if let Some(decoder) = &self.decoder {
            check_sizes(&[("model.decoder.hidden", decoder.hidden, 1, limits::FEATURES)])?;
            checks::loss_weights(&[("model.decoder.weight", decoder.weight)])?;
            if !matches!(self.encoder, EncoderConfig::Keypoints(_)) {
                let given = "the encoder has no fixed features, which are decoded";
                let fix = "leave out model.decoder, or choose an encoder with keypoints or colours: --preset keypoints";
                return Err(Error::config("model.decoder", given, fix));
            }
        }
        self.encoder.check("model.encoder", self.image)
    }
}
