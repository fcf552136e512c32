//! The models: an encoder, a policy head, and what values its data need. Parameters carry the published names.

use super::config::GcrlConfig;
use super::heads::{Critic, Head};
use super::transformer::Pool;
use crate::nn::{Backbone, Init, parameters};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// Goal-conditioned behavioural cloning.
#[derive(Module, Debug)]
pub struct Gcbc {
    /// From pictures to patches.
    pub encoder: Backbone,
    /// The mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' spread, which cloning does not learn.
    pub log_stds: Param<Tensor<1>>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// Goal-conditioned implicit value learning.
#[derive(Module, Debug)]
pub struct Gcivl {
    /// From pictures to patches.
    pub encoder: Backbone,
    /// The mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' spread.
    pub log_stds: Param<Tensor<1>>,
    /// What a state is worth.
    pub value_predictor: Slow<Head>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// Goal-conditioned implicit Q-learning.
#[derive(Module, Debug)]
pub struct Gciql {
    /// From pictures to patches.
    pub encoder: Backbone,
    /// The mean action.
    pub action_predictor: Head,
    /// The logarithm of the actions' spread.
    pub log_stds: Param<Tensor<1>>,
    /// What a state is worth.
    pub value_predictor: Slow<Head>,
    /// What an action is worth.
    pub critic_predictor: Slow<Critic>,
    #[module(skip)]
    pub(super) config: GcrlConfig,
}

/// A network, and a copy that follows it slowly, which gives the targets.
#[derive(Module, Debug)]
pub struct Slow<N: Module> {
    /// What is trained.
    pub student: N,
    /// What follows.
    pub teacher: N,
}

impl<N: Module> Slow<N> {
    fn new(network: N) -> Self {
        Self { teacher: network.clone().no_grad(), student: network }
    }

    /// Moves the copy: it keeps a share of what it was.
    #[must_use]
    pub fn follow(self, keep: f64) -> Self {
        Self { teacher: parameters::blend(self.teacher, &self.student, keep), student: self.student }
    }
}

/// The parts that all models begin with, drawn.
struct Parts<'a> {
    config: &'a GcrlConfig,
    actions: usize,
    init: Init,
}

impl<'a> Parts<'a> {
    fn new(config: &'a GcrlConfig, actions: usize, key: Key, device: &Device) -> Self {
        Self { config, actions, init: Init::new(key, device) }
    }

    fn encoder(&self) -> Backbone {
        let encoder = self.config.encoder.init(&self.init.of("encoder"), self.config.image);
        if self.config.frozen { encoder.no_grad() } else { encoder }
    }

    fn policy(&self) -> Head {
        let init = self.init.of("action_predictor");
        Head::new(&init, &self.config.head, self.config.patch_grid(), Pool::Attention, self.actions)
    }

    fn log_stds(&self) -> Param<Tensor<1>> {
        self.init.constant([self.actions], 0.0)
    }

    fn value(&self) -> Slow<Head> {
        let init = self.init.of("value_predictor");
        Slow::new(Head::new(&init, &self.config.head, self.config.patch_grid(), Pool::Mean, 1))
    }

    fn critic(&self) -> Slow<Critic> {
        let GcrlConfig { head, critic, .. } = self.config;
        let init = self.init.of("critic_predictor");
        Slow::new(Critic::new(&init, head, self.config.patch_grid(), Pool::Mean, self.actions, *critic))
    }
}

impl Gcbc {
    /// A model of `actions` numbers an action (of all environment steps in a model step), drawn from `key`.
    pub fn init(config: &GcrlConfig, actions: usize, key: Key, device: &Device) -> Self {
        let parts = Parts::new(config, actions, key, device);
        Self {
            encoder: parts.encoder(),
            action_predictor: parts.policy(),
            log_stds: parts.log_stds().set_require_grad(false),
            config: config.clone(),
        }
    }
}

impl Gcivl {
    /// As [`Gcbc::init`].
    pub fn init(config: &GcrlConfig, actions: usize, key: Key, device: &Device) -> Self {
        let parts = Parts::new(config, actions, key, device);
        Self {
            encoder: parts.encoder(),
            action_predictor: parts.policy(),
            log_stds: parts.log_stds(),
            value_predictor: parts.value(),
            config: config.clone(),
        }
    }
}

impl Gciql {
    /// As [`Gcbc::init`].
    pub fn init(config: &GcrlConfig, actions: usize, key: Key, device: &Device) -> Self {
        let parts = Parts::new(config, actions, key, device);
        Self {
            encoder: parts.encoder(),
            action_predictor: parts.policy(),
            log_stds: parts.log_stds(),
            value_predictor: parts.value(),
            critic_predictor: parts.critic(),
            config: config.clone(),
        }
    }
}
