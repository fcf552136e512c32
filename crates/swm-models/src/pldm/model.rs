//! [`Pldm`]: a world model and the inverse dynamics of its training loss.

use crate::lewm::{Lewm, LewmConfig};
use crate::nn::{Activation, Init, LayerNorm, Linear};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// A PLDM. Planning uses the world model only; the inverse dynamics are part of the loss.
#[derive(Module, Debug)]
pub struct Pldm {
    /// The world model, with the networks of a LeWM.
    pub model: Lewm,
    /// Predicts the action between a latent and the next one.
    pub idm: Idm,
}

/// Inverse dynamics: linear, layer normalisation, GELU, linear.
#[derive(Module, Debug)]
pub struct Idm {
    /// The sequence.
    pub net: IdmNet,
}

/// The sequence of an [`Idm`].
#[derive(Module, Debug)]
pub struct IdmNet {
    /// Into the hidden features.
    pub _0: Linear,
    /// The normalisation.
    pub _1: LayerNorm,
    /// From the hidden features.
    pub _3: Linear,
}

/// Number added to the variance by the normalisation.
const EPSILON: f64 = 1e-5;

impl Pldm {
    /// A model with random weights for actions of `actions` elements per model step, whose inverse dynamics have `hidden`
    /// features.
    pub fn init(config: &LewmConfig, actions: usize, hidden: usize, key: Key, device: &Device) -> Self {
        let init = Init::new(key, device).of("idm");
        let model = Lewm::init(config, actions, key, device);
        Self { model, idm: Idm::new(&init, config.latent, hidden, actions) }
    }
}

impl Idm {
    /// Inverse dynamics for latents of dimension `latent`, with random weights.
    pub fn new(init: &Init, latent: usize, hidden: usize, actions: usize) -> Self {
        Self {
            net: IdmNet {
                _0: Linear::new(&init.of("0"), 2 * latent, hidden),
                _1: LayerNorm::new(init, hidden, EPSILON),
                _3: Linear::new(&init.of("3"), hidden, actions),
            },
        }
    }

    /// Predicts the action between each latent and the next.
    ///
    /// # Shapes
    /// `latents` is `[clips, steps, latent]`; returns `[clips, steps - 1, actions]`.
    pub fn forward(&self, latents: Tensor<3>) -> Tensor<3> {
        let [clips, steps, latent] = latents.dims();
        let frames = |from: usize, to: usize| latents.clone().slice([0..clips, from..to, 0..latent]);
        // The later latent comes first, as published.
        let pairs = Tensor::cat(vec![frames(1, steps), frames(0, steps - 1)], 2);
        let hidden = self.net._1.forward(self.net._0.forward(pairs));
        self.net._3.forward(Activation::Gelu.forward(hidden))
    }
}
