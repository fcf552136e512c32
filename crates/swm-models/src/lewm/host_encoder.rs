//! [`HostEncoder`]: encodes images on the CPU with the kernels of `swm-kernels`.

use super::config::{EncoderConfig, LewmConfig};
use super::model::{Encoder, Lewm};
use crate::nn::kernels::{conv_encoder, projector_panels, vit_encoder};
use swm_kernels::functions::gelu;
use swm_kernels::{ConvEncoder, Panels, VitEncoder};

/// An encoder and its projector, with weights packed for the CPU kernels.
pub struct HostEncoder {
    backbone: Backbone,
    /// The two linear layers of the projector.
    projector: [Panels; 2],
}

enum Backbone {
    Vit(VitEncoder),
    Conv(ConvEncoder),
}

impl HostEncoder {
    /// Packs the weights of a model's encoder; returns `None` if there are no kernels for this kind of encoder.
    pub fn new(model: &Lewm, config: &LewmConfig) -> Option<Self> {
        let backbone = match (&model.encoder, &config.encoder) {
            (Encoder::Vit(vit), EncoderConfig::Vit(sizes)) => {
                Backbone::Vit(vit_encoder(vit, (config.image / sizes.patch).pow(2))?)
            }
            (Encoder::Conv(conv), _) => Backbone::Conv(conv_encoder(conv, config.image)),
            _ => return None,
        };
        Some(Self { backbone, projector: projector_panels(&model.projector) })
    }

    /// Returns the latent of one image, given as normalised patches.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`; returns `[latent]`.
    pub fn encode(&self, patches: &[f32]) -> Vec<f32> {
        let [into, out] = &self.projector;
        let mut hidden = vec![0.0; into.outputs()];
        let features = match &self.backbone {
            Backbone::Vit(vit) => vit.encode(patches),
            Backbone::Conv(conv) => conv.encode(patches),
        };
        into.apply(&features, &mut hidden);
        gelu(&mut hidden);
        let mut latent = vec![0.0; out.outputs()];
        out.apply(&hidden, &mut latent);
        latent
    }
}
