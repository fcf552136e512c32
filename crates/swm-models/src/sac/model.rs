//! [`Sac`]: the networks of a SAC, with the parameter names of Stable-Baselines3.

use super::config::{SacConfig, SacLoss};
use crate::nn::{Init, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use burn::tensor::activation::relu;

/// The networks of a SAC: a policy, two Q functions with target networks, and the temperature. A field `_i` of a
/// network is element i of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct Sac {
    /// The policy.
    pub actor: Actor,
    /// The Q functions.
    pub critic: Critics,
    /// The target networks: exponential moving averages of the Q functions.
    pub critic_target: Critics,
    /// The logarithm of the temperature, `[1]`.
    pub log_ent_coef: Param<Tensor<1>>,
}

/// The policy: mean and standard deviation of actions before `tanh`.
#[derive(Module, Debug)]
pub struct Actor {
    /// Two hidden layers.
    pub latent_pi: Hidden,
    /// The output layer for the mean.
    pub mu: Linear,
    /// The output layer for the logarithm of the standard deviation.
    pub log_std: Linear,
}

/// Two hidden layers with ReLU.
#[derive(Module, Debug)]
pub struct Hidden {
    /// The first hidden layer.
    pub _0: Linear,
    /// The second hidden layer.
    pub _2: Linear,
}

/// Two Q functions.
#[derive(Module, Debug)]
pub struct Critics {
    /// The first Q function.
    pub qf0: Critic,
    /// The second Q function.
    pub qf1: Critic,
}

/// A Q function, which computes the value of an action.
#[derive(Module, Debug)]
pub struct Critic {
    /// The first hidden layer.
    pub _0: Linear,
    /// The second hidden layer.
    pub _2: Linear,
    /// The output layer.
    pub _4: Linear,
}

/// Sampled actions and the logarithm of the density of the actions.
pub struct ActionSample {
    /// The actions after `tanh`, `[rows, action_dim]`.
    pub actions: Tensor<2>,
    /// The logarithm of the density of the actions, `[rows]`.
    pub log_density: Tensor<1>,
}

impl Sac {
    /// Creates networks with random weights for observations of `inputs` elements and actions of `action_dim` elements.
    pub fn init(config: &SacConfig, loss: &SacLoss, inputs: usize, action_dim: usize, init: &Init) -> Self {
        let hidden = config.hidden;
        let actor = init.of("actor");
        let critic = |name: &str| {
            let init = init.of(name);
            Critic {
                _0: Linear::new(&init.of("0"), inputs + action_dim, hidden),
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
                mu: Linear::new(&actor.of("mu"), hidden, action_dim),
                log_std: Linear::new(&actor.of("log_std"), hidden, action_dim),
            },
            critic_target: critic.clone().no_grad(),
            critic,
            log_ent_coef: init.constant([1], loss.temperature.ln() as f32),
        }
    }

    /// Returns the number of elements of an observation.
    pub fn inputs(&self) -> usize {
        self.actor.latent_pi._0.weight.dims()[1]
    }
}

impl Actor {
    /// Returns mean and logarithm of the standard deviation, which is clamped to -20 ..= 2.
    ///
    /// # Shapes
    /// `observations` is `[rows, inputs]`; returns `[rows, action_dim]` twice.
    pub fn forward(&self, observations: Tensor<2>) -> (Tensor<2>, Tensor<2>) {
        let hidden = relu(self.latent_pi._2.forward(relu(self.latent_pi._0.forward(observations))));
        (self.mu.forward(hidden.clone()), self.log_std.forward(hidden).clamp(-20.0, 2.0))
    }

    /// Samples actions with standard normal `noise`.
    ///
    /// # Shapes
    /// `observations` is `[rows, inputs]`, `noise` is `[rows, action_dim]`.
    pub fn sample(&self, observations: Tensor<2>, noise: Tensor<2>) -> ActionSample {
        let (mean, log_std) = self.forward(observations);
        let raw = mean + log_std.clone().exp() * noise.clone();
        let normal = (noise.square() + (2.0 * std::f64::consts::PI).ln()) * -0.5 - log_std;
        // ln(1 - tanh² x) = 2 (ln 2 - x - softplus(-2 x)), which is accurate for large x.
        let squash =
            (raw.clone() + burn::tensor::activation::softplus(raw.clone() * -2.0, 1.0)).neg() + std::f64::consts::LN_2;
        ActionSample { actions: raw.tanh(), log_density: (normal - squash * 2.0).sum_dim(1).squeeze_dim(1) }
    }
}

impl Critics {
    /// Returns the values of both Q functions.
    ///
    /// # Shapes
    /// `x` is `[rows, inputs + action_dim]`; returns `[rows]` twice.
    pub fn forward(&self, x: Tensor<2>) -> [Tensor<1>; 2] {
        [self.qf0.forward(x.clone()), self.qf1.forward(x)]
    }
}

impl Critic {
    fn forward(&self, x: Tensor<2>) -> Tensor<1> {
        self._4.forward(relu(self._2.forward(relu(self._0.forward(x))))).squeeze_dim(1)
    }
}
