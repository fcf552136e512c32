//! [`GcrlConfig`]: the size of a goal-conditioned model.

use super::transformer::{PatchGrid, TransformerConfig};
use crate::nn::BackboneConfig;
use crate::pixels::ImageNormalization;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// The size of a goal-conditioned model; all its heads are of one size.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GcrlConfig {
    /// Side of the square pictures it sees, in pixels.
    pub image: usize,
    /// Mean of the pixels by colour, of 0 ..= 1; pixels are normalised with it.
    pub pixel_mean: [f32; 3],
    /// Spread of the pixels by colour, of 0 ..= 1.
    pub pixel_std: [f32; 3],
    /// Frames it sees: the present one and those before it.
    pub history: usize,
    /// Whether the encoder keeps the weights it begins with.
    pub frozen: bool,
    /// The weights the encoder begins with: a file, a checkpoint or a repository; empty for drawn ones.
    pub weights: String,
    /// The encoder.
    pub encoder: BackboneConfig,
    /// The heads.
    pub head: TransformerConfig,
    /// Hidden features behind the critic's transformer, where there is a critic.
    #[serde(default = "critic")]
    pub critic: usize,
}

/// As published.
fn critic() -> usize {
    256
}

impl GcrlConfig {
    /// How pictures become numbers.
    pub fn pixels(&self) -> ImageNormalization {
        ImageNormalization { side: self.image, mean: self.pixel_mean, std: self.pixel_std }
    }

    /// What the heads look at. An encoder without patches gives one for the whole picture.
    pub(super) fn patch_grid(&self) -> PatchGrid {
        let patches = self.encoder.patches(self.image);
        PatchGrid { frames: self.history, patches, dim: self.encoder.dim() }
    }

    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        let wrong = |what: &str, problem: String, fix: &str| Err(Error::config(what, problem, fix));
        self.encoder.check("model.encoder", self.image)?;
        let TransformerConfig { depth, heads, dim_head, mlp, dropout, emb_dropout } = self.head;
        let sizes = [
            ("model.history", self.history),
            ("model.head.heads", heads),
            ("model.head.dim_head", dim_head),
            ("model.head.mlp", mlp),
            ("model.critic", self.critic),
        ];
        if let Some((what, _)) = sizes.iter().find(|(_, size)| *size == 0) {
            return wrong(what, "0".to_owned(), "give at least 1");
        }
        if depth < 3 {
            let problem = format!("with {depth} layers a policy never looks at the goal");
            return wrong(
                "model.head.depth",
                problem,
                "give at least 3: one for the frames, one for the goal, one to gather",
            );
        }
        for (what, rate) in [("model.head.dropout", dropout), ("model.head.emb_dropout", emb_dropout)] {
            if !(0.0..1.0).contains(&rate) {
                return wrong(what, rate.to_string(), "give a probability below 1");
            }
        }
        if self.pixel_std.iter().any(|std| *std <= 0.0) {
            return wrong("model.pixel_std", format!("{:?}", self.pixel_std), "give three positive numbers");
        }
        if self.frozen && self.weights.is_empty() {
            let problem = "a frozen encoder without weights stays as it was drawn".to_owned();
            return wrong("model.weights", problem, "name its weights, or say model.frozen=false");
        }
        Ok(())
    }
}
