//! [`Pldm`]: a world model, and the inverse-dynamics network of the training loss.

use crate::lewm::{Lewm, LewmConfig};
use crate::nn::{Activation, Init, LayerNorm, Linear};
use burn::module::Module;
use burn::tensor::Tensor;

/// The networks of a PLDM. Planning uses the world model only; the inverse dynamics are part of the loss.
#[derive(Module, Debug)]
pub struct Pldm {
    /// The world model, with the networks of a LeWM.
    pub model: Lewm,
    /// The inverse dynamics, which predict the action between two successive latents.
    pub idm: Idm,
}

/// Inverse dynamics: linear, layer normalisation, GELU, linear.
#[derive(Module, Debug)]
pub struct Idm {
    /// The layers.
    pub net: IdmNet,
}

/// The layers of an [`Idm`]. A field `_i` is element i of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct IdmNet {
    /// The linear layer to the hidden features.
    pub _0: Linear,
    /// The layer normalisation.
    pub _1: LayerNorm,
    /// The linear layer from the hidden features.
    pub _3: Linear,
}

/// The epsilon of the layer normalisation.
const EPSILON: f64 = 1e-5;

impl Pldm {
    /// Creates a model with random weights. A model step has an action of dimension `action_dim`; the inverse dynamics
    /// have `hidden` hidden features.
    pub fn init(config: &LewmConfig, action_dim: usize, hidden: usize, init: &Init) -> Self {
        let model = Lewm::init(config, action_dim, init);
        Self { model, idm: Idm::new(&init.of("idm"), config.latent, hidden, action_dim) }
    }
}

impl Idm {
    /// Creates inverse dynamics with random weights for latents of dimension `latent`.
    pub fn new(init: &Init, latent: usize, hidden: usize, action_dim: usize) -> Self {
        Self {
            net: IdmNet {
                _0: Linear::new(&init.of("0"), 2 * latent, hidden),
                _1: LayerNorm::new(init, hidden, EPSILON),
                _3: Linear::new(&init.of("3"), hidden, action_dim),
            },
        }
    }

    /// Predicts the action between each latent and the next.
    ///
    /// # Shapes
    /// `latents` is `[clips, steps, latent]`; returns `[clips, steps - 1, action_dim]`.
    pub fn forward(&self, latents: Tensor<3>) -> Tensor<3> {
        let [clips, steps, latent] = latents.dims();
        let range = |from: usize, to: usize| latents.clone().slice([0..clips, from..to, 0..latent]);
        // As in the published code, the later latent of a pair comes first.
        let pairs = Tensor::cat(vec![range(1, steps), range(0, steps - 1)], 2);
        let hidden = self.net._1.forward(self.net._0.forward(pairs));
        self.net._3.forward(Activation::Gelu.forward(hidden))
    }
}
