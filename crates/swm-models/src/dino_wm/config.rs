//! [`DinoWmConfig`]: the model configuration of a DINO-WM.

use super::predictor::FramePredictorConfig;
use crate::checks;
use crate::nn::BackboneConfig;
use crate::pixels::{self, ImageNormalization};
use crate::train::{check_sizes, limits};
use burn::tensor::{Device, Tensor};
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The name of the action column, which is an input of the predictor and not a prediction target.
pub const ACTION: &str = "action";

/// The model configuration of a DINO-WM.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DinoWmConfig {
    /// Side of the square input images in pixels.
    pub image: usize,
    /// Mean of each colour channel for pixel values in 0 ..= 1.
    pub pixel_mean: [f32; 3],
    /// Standard deviation of each colour channel for pixel values in 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Source of the encoder's weights: a file, or a repository of the Hugging Face hub such as
    /// `facebook/dinov2-small`; empty for random weights, which suffice for tests.
    pub weights: String,
    /// The encoder of patches, which is not trained.
    pub encoder: BackboneConfig,
    /// Columns whose features are appended to the features of every patch, in this order; `action` is required.
    pub columns: Vec<ColumnConfig>,
    /// The predictor.
    pub predictor: FramePredictorConfig,
    /// Hidden features of the image decoder, whose training does not influence the predictor; 0 for no decoder.
    pub decoder: usize,
}

/// A column whose features are appended to the features of every patch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColumnConfig {
    /// The name of the column in the dataset, such as `action` or `proprio`.
    pub name: String,
    /// Number of features of the encoded column.
    pub dim: usize,
}

impl DinoWmConfig {
    /// Returns the number of features of a patch: the features of the encoder, then the features of the columns.
    pub fn dim(&self) -> usize {
        self.encoder.patch_dim() + self.columns.iter().map(|column| column.dim).sum::<usize>()
    }

    /// Returns the number of patches of a frame.
    pub fn patches(&self) -> usize {
        self.encoder.patches(self.image)
    }

    /// The normalisation of input images.
    pub(super) const fn pixels(&self) -> ImageNormalization {
        ImageNormalization { side: self.image, mean: self.pixel_mean, std: self.pixel_std }
    }

    /// Converts images to normalised patches.
    ///
    /// # Shapes
    /// `rgb` is `[frames, image, image, 3]`; returns `[frames, patches, 3 * patch * patch]`.
    ///
    /// # Errors
    /// When the bytes are not a whole number of images.
    pub(super) fn image_patches(&self, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
        pixels::patches(&self.pixels(), self.encoder.patch(), rgb, device)
    }

    /// Checks the configuration.
    ///
    /// # Errors
    /// When a setting is invalid; the error names the first invalid setting.
    pub fn check(&self) -> Result<()> {
        self.encoder.check("model.encoder", self.image)?;
        let predictor = &self.predictor;
        check_sizes(&[
            ("model.decoder", self.decoder, 0, limits::FEATURES),
            ("model.predictor.history", predictor.history, 1, limits::FRAMES),
            ("model.predictor.depth", predictor.depth, 1, limits::LAYERS),
            ("model.predictor.heads", predictor.heads, 1, limits::FEATURES),
            ("model.predictor.dim_head", predictor.dim_head, 1, limits::FEATURES),
            ("model.predictor.mlp", predictor.mlp, 1, limits::FEATURES),
        ])?;
        if self.decoder > 0 && self.patches() * self.encoder.patch().pow(2) != self.image.pow(2) {
            return Err(Error::config(
                "model.decoder",
                "the patches of this encoder do not cover the image".to_owned(),
                "set model.decoder=0, or choose a `vit` or `dinov2` encoder",
            ));
        }
        checks::dropout_rates(&[
            ("model.predictor.dropout", predictor.dropout),
            ("model.predictor.emb_dropout", predictor.emb_dropout),
        ])?;
        checks::pixel_normalization(self.pixel_mean, self.pixel_std)?;
        let invalid = |problem: String, fix: &str| Err(Error::config("model.columns", problem, fix));
        if !self.columns.iter().any(|column| column.name == ACTION) {
            return invalid("the list lacks the action".to_owned(), "add { name = \"action\", dim = 10 }");
        }
        for (index, column) in self.columns.iter().enumerate() {
            check_sizes(&[("model.columns.dim", column.dim, 1, limits::FEATURES)])?;
            if self.columns[..index].iter().any(|other| other.name == column.name) {
                return invalid(format!("'{}' is listed twice", column.name), "list it once");
            }
        }
        Ok(())
    }
}
