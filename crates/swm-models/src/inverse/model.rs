//! [`InverseModel`]: the network.

use crate::nn::{Activation, Init, Linear};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// Two hidden layers with GELU. A field `_2` is number 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct InverseModel {
    /// Into hidden features.
    pub _0: Linear,
    /// From hidden features to hidden features.
    pub _2: Linear,
    /// To actions.
    pub _4: Linear,
}

impl InverseModel {
    /// A network for latents of `latent` numbers and model steps of `actions` numbers, drawn from `key`.
    pub fn new(latent: usize, hidden: usize, actions: usize, key: Key, device: &Device) -> Self {
        let init = Init::new(key, device);
        Self {
            _0: Linear::new(&init.of("0"), 2 * latent, hidden),
            _2: Linear::new(&init.of("2"), hidden, hidden),
            _4: Linear::new(&init.of("4"), hidden, actions),
        }
    }

    /// # Shapes
    /// `[pairs, 2 * latent]`, present and goal beside each other, to `[pairs, actions]` in model units.
    pub fn forward(&self, pairs: Tensor<2>) -> Tensor<2> {
        let hidden = Activation::Gelu.forward(self._0.forward(pairs));
        self._4.forward(Activation::Gelu.forward(self._2.forward(hidden)))
    }
}
