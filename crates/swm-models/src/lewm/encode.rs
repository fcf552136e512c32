//! [`FastEncoder`]: from a picture to its latent, as fast as a CPU does it.

use super::config::{EncoderConfig, LewmConfig};
use super::model::{Encoder, Lewm};
use crate::fast::dense::folded;
use crate::fast::functions::gelu;
use crate::fast::{FastVit, Panels};

/// A vision transformer and the projection behind it.
pub struct FastEncoder {
    vit: FastVit,
    project: [Panels; 2],
}

impl FastEncoder {
    /// The weights of a model; none for an encoder that is no transformer.
    pub fn new(model: &Lewm, config: &LewmConfig) -> Option<Self> {
        let (Encoder::Vit(vit), EncoderConfig::Vit(sizes)) = (&model.encoder, &config.encoder) else { return None };
        let patches = (config.image / sizes.patch).pow(2);
        Some(Self { vit: FastVit::new(vit, sizes.heads, patches), project: folded(&model.projector) })
    }

    /// # Shapes
    /// The normalised patches of one picture, `[patches, 3 * patch * patch]`, to `[latent]`.
    pub fn encode(&self, patches: &[f32]) -> Vec<f32> {
        let [into, out] = &self.project;
        let mut hidden = vec![0.0; into.outputs()];
        into.apply(&self.vit.encode(patches), &mut hidden);
        gelu(&mut hidden);
        let mut latent = vec![0.0; out.outputs()];
        out.apply(&hidden, &mut latent);
        latent
    }
}
