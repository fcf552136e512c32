//! [`Gcbc`], [`Gcivl`] and [`Gciql`]: an encoder, a policy head, and the value networks that the method needs, with the
//! published parameter names.

use super::config::GcrlConfig;
use super::heads::{Critic, Head, ValueHead};
use super::transformer::Pool;
use crate::nn::{Backbone, Init, parameters};
use burn::module::{Module, Param};
use burn::tensor::Tensor;

/// The networks of goal-conditioned behavioural cloning (GCBC).
#[derive(Module, Debug)]
pub struct Gcbc {
    /// Maps images to patches.
    pub encoder: Backbone,
    /// The policy head, which computes the mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' standard deviation, which behavioural cloning does not train.
    pub log_stds: Param<Tensor<1>>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// The networks of goal-conditioned implicit value learning (GCIVL).
#[derive(Module, Debug)]
pub struct Gcivl {
    /// Maps images to patches.
    pub encoder: Backbone,
    /// The policy head, which computes the mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' standard deviation.
    pub log_stds: Param<Tensor<1>>,
    /// The value head, which computes the value of a state.
    pub value_predictor: WithTarget<ValueHead>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// The networks of goal-conditioned implicit Q-learning (GCIQL).
#[derive(Module, Debug)]
pub struct Gciql {
    /// Maps images to patches.
    pub encoder: Backbone,
    /// The policy head, which computes the mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' standard deviation.
    pub log_stds: Param<Tensor<1>>,
    /// The value head, which computes the value of a state.
    pub value_predictor: WithTarget<ValueHead>,
    /// The critic, which computes the value of an action.
    pub critic_predictor: WithTarget<Critic>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// A network and its target network, an exponential moving average of the network.
#[derive(Module, Debug)]
pub struct WithTarget<N: Module> {
    /// The trained network.
    pub student: N,
    /// The target network.
    pub teacher: N,
}

impl<N: Module> WithTarget<N> {
    fn new(network: N) -> Self {
        Self { teacher: network.clone().no_grad(), student: network }
    }

    /// Updates the target network: every weight becomes `keep * teacher + (1 - keep) * student`.
    #[must_use]
    pub fn update_target(self, keep: f64) -> Self {
        Self { teacher: parameters::blend(self.teacher, &self.student, keep), student: self.student }
    }
}

/// Creates the networks of a model with random weights.
struct Builder<'a> {
    config: &'a GcrlConfig,
    action_dim: usize,
    init: Init,
}

impl<'a> Builder<'a> {
    fn new(config: &'a GcrlConfig, action_dim: usize, init: &Init) -> Self {
        Self { config, action_dim, init: init.clone() }
    }

    fn encoder(&self) -> Backbone {
        let encoder = self.config.encoder.init(&self.init.of("encoder"), self.config.image);
        if self.config.frozen { encoder.no_grad() } else { encoder }
    }

    fn policy(&self) -> Head {
        let init = self.init.of("action_predictor");
        Head::new(&init, &self.config.head, self.config.patch_grid(), Pool::Attention, self.action_dim)
    }

    fn log_stds(&self) -> Param<Tensor<1>> {
        self.init.constant([self.action_dim], 0.0)
    }

    fn value(&self) -> WithTarget<ValueHead> {
        let init = self.init.of("value_predictor");
        WithTarget::new(ValueHead::new(&init, &self.config.head, self.config.patch_grid(), self.config.metric))
    }

    fn critic(&self) -> WithTarget<Critic> {
        let GcrlConfig { head, critic, .. } = self.config;
        let init = self.init.of("critic_predictor");
        WithTarget::new(Critic::new(&init, head, self.config.patch_grid(), Pool::Mean, self.action_dim, *critic))
    }
}

impl Gcbc {
    /// Creates a model with random weights for actions of `action_dim` elements per model step.
    pub fn init(config: &GcrlConfig, action_dim: usize, init: &Init) -> Self {
        let builder = Builder::new(config, action_dim, init);
        Self {
            encoder: builder.encoder(),
            action_predictor: builder.policy(),
            log_stds: builder.log_stds().set_require_grad(false),
            config: config.clone(),
        }
    }
}

impl Gcivl {
    /// Creates a model with random weights, as [`Gcbc::init`].
    pub fn init(config: &GcrlConfig, action_dim: usize, init: &Init) -> Self {
        let builder = Builder::new(config, action_dim, init);
        Self {
            encoder: builder.encoder(),
            action_predictor: builder.policy(),
            log_stds: builder.log_stds(),
            value_predictor: builder.value(),
            config: config.clone(),
        }
    }
}

impl Gciql {
    /// Creates a model with random weights, as [`Gcbc::init`].
    pub fn init(config: &GcrlConfig, action_dim: usize, init: &Init) -> Self {
        let builder = Builder::new(config, action_dim, init);
        Self {
            encoder: builder.encoder(),
            action_predictor: builder.policy(),
            log_stds: builder.log_stds(),
            value_predictor: builder.value(),
            critic_predictor: builder.critic(),
            config: config.clone(),
        }
    }
}
