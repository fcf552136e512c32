//! [`Pldm`]: a world model and the inverse dynamics it is trained beside.

use crate::lewm::{Lewm, LewmConfig};
use crate::nn::{Activation, Init, LayerNorm, Linear};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// A PLDM as it is trained. What plans is its world model; the inverse dynamics exist for the loss.
#[derive(Module, Debug)]
pub struct Pldm {
    /// The world model, which is that of a LeWM.
    pub model: Lewm,
    /// From a latent and the next one to the action between them.
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
    /// Normalises them.
    pub _1: LayerNorm,
    /// Out of them.
    pub _3: Linear,
}

/// What the normalisation adds to the variance.
const EPSILON: f64 = 1e-5;

impl Pldm {
    /// A model of `actions` numbers an action (of all environment steps in a model step), whose inverse dynamics have
    /// `hidden` features, drawn from `key`.
    pub fn init(config: &LewmConfig, actions: usize, hidden: usize, key: Key, device: &Device) -> Self {
        let init = Init::new(key, device).of("idm");
        let model = Lewm::init(config, actions, key, device);
        Self { model, idm: Idm::new(&init, config.latent, hidden, actions) }
    }
}

impl Idm {
    /// Inverse dynamics of `latent` numbers.
    pub fn new(init: &Init, latent: usize, hidden: usize, actions: usize) -> Self {
        Self {
            net: IdmNet {
                _0: Linear::new(&init.of("0"), 2 * latent, hidden),
                _1: LayerNorm::new(init, hidden, EPSILON),
                _3: Linear::new(&init.of("3"), hidden, actions),
            },
        }
    }

    /// The action between each latent and the next.
    ///
    /// # Shapes
    /// `[clips, steps, latent]` to `[clips, steps - 1, actions]`.
    pub fn forward(&self, latents: Tensor<3>) -> Tensor<3> {
        let [clips, steps, latent] = latents.dims();
        let frames = |from: usize, to: usize| latents.clone().slice([0..clips, from..to, 0..latent]);
        // The later one first, as published.
        let pairs = Tensor::cat(vec![frames(1, steps), frames(0, steps - 1)], 2);
        let hidden = self.net._1.forward(self.net._0.forward(pairs));
        self.net._3.forward(Activation::Gelu.forward(hidden))
    }
}
