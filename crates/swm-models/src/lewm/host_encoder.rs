//! [`HostEncoder`]: encodes images on the CPU with the kernels of `swm-kernels`.

use super::config::{EncoderConfig, LewmConfig};
use super::model::{Encoder, Lewm};
use crate::nn::kernels::{projector_panels, vit_encoder};
use swm_kernels::functions::gelu;
use swm_kernels::{Panels, VitEncoder};

/// A vision transformer and its projector, with weights packed for the CPU kernels.
pub struct HostEncoder {
    vit: VitEncoder,
    /// The two linear layers of the projector.
    projector: [Panels; 2],
}

impl HostEncoder {
    /// Packs the weights of a model's encoder; returns `None` if the encoder is not a vision transformer.
    pub fn new(model: &Lewm, config: &LewmConfig) -> Option<Self> {
        let (Encoder::Vit(vit), EncoderConfig::Vit(sizes)) = (&model.encoder, &config.encoder) else { return None };
        let patches = (config.image / sizes.patch).pow(2);
        Some(Self { vit: vit_encoder(vit, patches)?, projector: projector_panels(&model.projector) })
    }

    /// Returns the latent of one image, given as normalised patches.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`; returns `[latent]`.
    pub fn encode(&self, patches: &[f32]) -> Vec<f32> {
        let [into, out] = &self.projector;
        let mut hidden = vec![0.0; into.outputs()];
        into.apply(&self.vit.encode(patches), &mut hidden);
        gelu(&mut hidden);
        let mut latent = vec![0.0; out.outputs()];
        out.apply(&hidden, &mut latent);
        latent
    }
}
