//! [`Sac`]: the networks, under the names that Stable-Baselines3 gives their weights.

use super::config::{SacConfig, SacLoss};
use crate::nn::{Activation, Init, Linear};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// A policy, two Q functions, their running averages, and the temperature. A field `_2` is number 2 of a sequence, as in
/// PyTorch.
#[derive(Module, Debug)]
pub struct Sac {
    /// The policy.
    pub actor: Actor,
    /// The Q functions.
    pub critic: Critics,
    /// Their running averages.
    pub critic_target: Critics,
    /// The logarithm of the temperature, `[1]`.
    pub log_ent_coef: Param<Tensor<1>>,
}

/// Mean and spread of actions before they are squashed.
#[derive(Module, Debug)]
pub struct Actor {
    /// Two hidden layers.
    pub latent_pi: Hidden,
    /// The mean.
    pub mu: Linear,
    /// The logarithm of the standard deviation.
    pub log_std: Linear,
}

/// Two hidden layers with ReLU.
#[derive(Module, Debug)]
pub struct Hidden {
    /// The first.
    pub _0: Linear,
    /// The second.
    pub _2: Linear,
}

/// Two Q functions.
#[derive(Module, Debug)]
pub struct Critics {
    /// One.
    pub qf0: Critic,
    /// The other.
    pub qf1: Critic,
}

/// The value of an action.
#[derive(Module, Debug)]
pub struct Critic {
    /// The first hidden layer.
    pub _0: Linear,
    /// The second.
    pub _2: Linear,
    /// The read-out.
    pub _4: Linear,
}

/// Actions and the logarithm of their density, `[rows, actions]` and `[rows]`.
pub struct Drawn {
    /// Squashed.
    pub actions: Tensor<2>,
    /// The logarithm of their density.
    pub log_density: Tensor<1>,
}

impl Sac {
    /// Networks for observations of `inputs` numbers and actions of `actions`.
    #[allow(clippy::cast_possible_truncation)]
    pub fn init(config: &SacConfig, loss: &SacLoss, inputs: usize, actions: usize, key: Key, device: &Device) -> Self {
        let init = Init::new(key, device);
        let hidden = config.hidden;
        let actor = init.of("actor");
        let critic = |name: &str| {
            let init = init.of(name);
            Critic {
                _0: Linear::new(&init.of("0"), inputs + actions, hidden),
                _2: Linear::new(&init.of("2"), hidden, hidden),
                _4: Linear::new(&init.of("4"), hidden, 1),
            }
        };
        let critic = Critics { qf0: critic("qf0"), qf1: critic("qf1") };
        Self {
            actor: Actor {
                latent_pi: Hidden {
                    _0: Linear::new(&actor.of("0"), inputs, hidden),
                    _2: Linear::new(&actor.of("2"), hidden, hidden),
                },
                mu: Linear::new(&actor.of("mu"), hidden, actions),
                log_std: Linear::new(&actor.of("log_std"), hidden, actions),
            },
            critic_target: critic.clone().no_grad(),
            critic,
            log_ent_coef: init.constant([1], loss.temperature.ln() as f32),
        }
    }

    /// Numbers of an observation.
    pub fn inputs(&self) -> usize {
        self.actor.latent_pi._0.weight.dims()[1]
    }
}

impl Actor {
    /// Mean and logarithm of the standard deviation, which lies between -20 and 2.
    pub fn forward(&self, observations: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let relu = |x| Activation::Relu.forward(x);
        let hidden = relu(self.latent_pi._2.forward(relu(self.latent_pi._0.forward(observations))));
        (self.mu.forward(hidden.clone()), self.log_std.forward(hidden).clamp(-20.0, 2.0))
    }

    /// Draws actions with standard normal `noise`.
    pub fn draw(&self, observations: Tensor<2>, noise: Tensor<2>) -> Drawn {
        let (mean, log_std) = self.forward(observations);
        let raw = mean + log_std.clone().exp() * noise.clone();
        let normal = (noise.square() + (2.0 * std::f64::consts::PI).ln()) * -0.5 - log_std;
        // ln(1 - tanh² x) = 2 (ln 2 - x - softplus(-2 x)), which does not run out of digits.
        let squash =
            (raw.clone() + burn::tensor::activation::softplus(raw.clone() * -2.0, 1.0)).neg() + std::f64::consts::LN_2;
        Drawn { actions: raw.tanh(), log_density: (normal - squash * 2.0).sum_dim(1).squeeze_dim(1) }
    }
}

impl Critics {
    /// The values of `[rows, inputs + actions]`, `[rows]` each.
    pub fn forward(&self, x: Tensor<2>) -> [Tensor<1>; 2] {
        [self.qf0.forward(x.clone()), self.qf1.forward(x)]
    }
}

impl Critic {
    fn forward(&self, x: Tensor<2>) -> Tensor<1> {
        let relu = |x| Activation::Relu.forward(x);
        self._4.forward(relu(self._2.forward(relu(self._0.forward(x))))).squeeze_dim(1)
    }
}
