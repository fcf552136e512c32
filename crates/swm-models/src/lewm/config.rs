//! [`LewmConfig`]: the size of a LeWM.

pub use crate::nn::BackboneConfig as EncoderConfig;
use crate::nn::PredictorConfig;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The size of a LeWM.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LewmConfig {
    /// Side of the square pictures it sees, in pixels.
    pub image: usize,
    /// Mean of the pixels by colour, of 0 ..= 1; pixels are normalised with it.
    pub pixel_mean: [f32; 3],
    /// Spread of the pixels by colour, of 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Numbers in a latent.
    pub latent: usize,
    /// Numbers that the first layer of the action encoder makes of an action's; 0 for as many as there are.
    #[serde(default)]
    pub smoothed: usize,
    /// Hidden features of the projections behind encoder and predictor.
    pub projector: usize,
    /// The encoder.
    pub encoder: EncoderConfig,
    /// The predictor.
    pub predictor: PredictorConfig,
}

impl LewmConfig {
    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        let wrong = |what: &str, problem: String, fix: &str| Err(Error::config(what, problem, fix));
        let predictor = &self.predictor;
        let sizes = [
            ("model.image", self.image),
            ("model.latent", self.latent),
            ("model.projector", self.projector),
            ("model.predictor.history", predictor.history),
            ("model.predictor.dim", predictor.dim),
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
        self.encoder.check("model.encoder", self.image)
    }
}
