//! [`DinoWmConfig`]: the size of a DINO-WM.

use super::predictor::FramePredictorConfig;
use crate::nn::BackboneConfig;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The column of actions, which the predictor gets and does not predict.
pub const ACTION: &str = "action";

/// The size of a DINO-WM.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DinoWmConfig {
    /// Side of the square pictures it sees, in pixels.
    pub image: usize,
    /// Mean of the pixels by colour, of 0 ..= 1; pixels are normalised with it.
    pub pixel_mean: [f32; 3],
    /// Spread of the pixels by colour, of 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Where the encoder's weights come from: a file, or a repository of the Hugging Face hub such as
    /// `facebook/dinov2-small`; empty for random ones, which are enough to try things out.
    pub weights: String,
    /// The encoder of patches, which is not trained.
    pub encoder: BackboneConfig,
    /// What stands beside the features of every patch, in this order; `action` must be there.
    pub columns: Vec<ColumnConfig>,
    /// The predictor.
    pub predictor: FramePredictorConfig,
    /// Hidden features of the decoder of pictures, which learns beside the predictor and changes nothing in it; 0 for no
    /// decoder.
    pub decoder: usize,
}

/// A column that stands beside the features of every patch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColumnConfig {
    /// Its name in the dataset, such as `action` or `proprio`.
    pub name: String,
    /// Features it becomes.
    pub dim: usize,
}

impl DinoWmConfig {
    /// Features of a patch: those of the encoder, then those of the columns.
    pub fn dim(&self) -> usize {
        self.encoder.dim() + self.columns.iter().map(|column| column.dim).sum::<usize>()
    }

    /// Patches of a frame.
    pub fn patches(&self) -> usize {
        self.encoder.patches(self.image)
    }

    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        let wrong = |what: &str, problem: String, fix: &str| Err(Error::config(what, problem, fix));
        self.encoder.check("model.encoder", self.image)?;
        let predictor = &self.predictor;
        let sizes = [
            ("model.predictor.history", predictor.history),
            ("model.predictor.depth", predictor.depth),
            ("model.predictor.heads", predictor.heads),
            ("model.predictor.dim_head", predictor.dim_head),
            ("model.predictor.mlp", predictor.mlp),
        ];
        for (what, size) in sizes {
            if size == 0 {
                return wrong(what, "0".to_owned(), "give at least 1");
            }
        }
        for (what, rate) in
            [("model.predictor.dropout", predictor.dropout), ("model.predictor.emb_dropout", predictor.emb_dropout)]
        {
            if !(0.0..1.0).contains(&rate) {
                return wrong(what, rate.to_string(), "give a probability below 1");
            }
        }
        if self.pixel_std.iter().any(|std| *std <= 0.0) {
            return wrong("model.pixel_std", format!("{:?}", self.pixel_std), "give three positive numbers");
        }
        if !self.columns.iter().any(|column| column.name == ACTION) {
            return wrong("model.columns", "no action".to_owned(), "add { name = \"action\", dim = 10 }");
        }
        for (index, column) in self.columns.iter().enumerate() {
            if column.dim == 0 {
                return wrong("model.columns", format!("'{}' has no features", column.name), "give at least 1");
            }
            if self.columns[..index].iter().any(|other| other.name == column.name) {
                return wrong("model.columns", format!("'{}' is there twice", column.name), "name it once");
            }
        }
        Ok(())
    }
}
