//! [`Tdmpc2`]: the networks, under the names of the published weights.

use super::config::Tdmpc2Config;
use super::eyes::{self, Eyes};
use crate::nn::{Dynamics, Head, Init, LayerNorm, Linear, ModuleDict, NormalizedLinear, normalized_mlp};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};
use swm_core::Key;

/// An encoder of observations, dynamics and rewards of latents, Q functions and a policy, all of them small networks.
#[derive(Module, Debug)]
pub struct Tdmpc2 {
    /// How far values of a batch spread, a running measure.
    pub scale: RunningScale,
    /// What pictures go through, where there are any.
    pub cnn: Option<Eyes>,
    /// From there to a latent.
    pub pixel_encoder: Option<Linear>,
    /// What columns of numbers go through.
    pub extra_encoders: ModuleDict<NumberEncoder>,
    /// From a latent and an action to the next latent.
    pub dynamics: Dynamics,
    /// The reward of an action, as logits of bins.
    pub reward: Head,
    /// The policy: mean and spread of actions before they are squashed.
    pub pi: Head,
    /// Q functions, as logits of bins.
    pub qs: Vec<Head>,
    /// Their running averages.
    pub target_qs: Vec<Head>,
    /// The logit of an episode's end at a latent, where it is predicted.
    pub termination: Option<Head>,
    #[module(skip)]
    config: Tdmpc2Config,
}

/// The running spread.
#[derive(Module, Debug)]
pub struct RunningScale {
    /// `[1]`.
    pub value: Param<Tensor<1>>,
}

/// An encoder of numbers. A field `_1` is number 1 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct NumberEncoder {
    /// Into hidden features.
    pub _0: NormalizedLinear,
    /// Out of them.
    pub _1: Linear,
    /// The normalisation.
    pub _2: LayerNorm,
}

/// Observations of some moments.
#[derive(Clone)]
pub struct Observation {
    /// `[rows, 3, image, image]`, where the model sees pictures.
    pub pixels: Option<Tensor<4>>,
    /// `[rows, numbers]` of every other column, in the model's order.
    pub numbers: Vec<Tensor<2>>,
}

impl Observation {
    /// Some rows.
    #[must_use]
    pub fn rows(&self, range: std::ops::Range<usize>) -> Self {
        Self {
            pixels: self.pixels.as_ref().map(|pixels| pixels.clone().slice([range.clone()])),
            numbers: self.numbers.iter().map(|numbers| numbers.clone().slice([range.clone()])).collect(),
        }
    }

    /// One after another.
    #[must_use]
    pub fn cat(parts: &[Self]) -> Self {
        let columns = parts.first().map_or(0, |part| part.numbers.len());
        let pixels: Option<Vec<_>> = parts.iter().map(|part| part.pixels.clone()).collect();
        let column = |i: usize| Tensor::cat(parts.iter().map(|part| part.numbers[i].clone()).collect(), 0);
        Self { pixels: pixels.map(|pixels| Tensor::cat(pixels, 0)), numbers: (0..columns).map(column).collect() }
    }

    /// The same as constants of a graph.
    #[must_use]
    pub fn autodiff(self) -> Self {
        Self {
            pixels: self.pixels.map(Tensor::autodiff),
            numbers: self.numbers.into_iter().map(Tensor::autodiff).collect(),
        }
    }
}

/// Mean and logarithm of the standard deviation of actions before they are squashed, `[rows, actions]` each.
pub struct Gaussian {
    /// The mean.
    pub mean: Tensor<2>,
    /// The logarithm of the standard deviation.
    pub log_std: Tensor<2>,
}

impl Gaussian {
    /// Of the two halves of a network's output; the logarithm lies between -10 and 2.
    pub fn of(raw: Tensor<2>) -> Self {
        let [rows, both] = raw.dims();
        let half = both / 2;
        let mean = raw.clone().slice([0..rows, 0..half]);
        Self { mean, log_std: (raw.slice([0..rows, half..both]).tanh() + 1.0) * 6.0 - 10.0 }
    }

    /// Squashed actions for standard normal `noise`.
    pub fn sample(&self, noise: Tensor<2>) -> Tensor<2> {
        (self.mean.clone() + self.log_std.clone().exp() * noise).tanh()
    }
}

impl Tdmpc2 {
    /// A model of `actions` numbers an action, drawn from `key`; `widths` are the numbers of each observed column but the
    /// pictures, in the order of the configuration.
    pub fn init(config: &Tdmpc2Config, widths: &[usize], actions: usize, key: Key, device: &Device) -> Self {
        let init = Init::new(key, device);
        let (latent, hidden, bins) = (config.latent(), config.hidden, config.bins.count);
        let encoder = |(part, &width): (&super::Encoding, &usize)| {
            let init = init.of("extra_encoders").of(&part.column);
            let encoder = NumberEncoder {
                _0: NormalizedLinear::new(&init.of("0"), width, config.encoder),
                _1: Linear::normal(&init.of("1"), config.encoder, part.latent, 0.02),
                _2: LayerNorm::new(&init.of("2"), part.latent, 1e-5),
            };
            (part.column.clone(), encoder)
        };
        let critic = |i| Head::zero_initialized(&init.of("qs").at(i), latent + actions, hidden, bins);
        let qs: Vec<Head> = (0..config.critics).map(critic).collect();
        let pictures = config.pictures();
        Self {
            scale: RunningScale { value: init.buffer([1], 10.0) },
            cnn: pictures.map(|_| Eyes::new(&init.of("cnn"))),
            pixel_encoder: pictures.map(|part| eyes::projection(&init.of("pixel_encoder"), config.image, part.latent)),
            extra_encoders: ModuleDict(config.numbers().zip(widths).map(encoder).collect()),
            dynamics: Dynamics::new(&init.of("dynamics"), latent + actions, hidden, latent),
            reward: Head::zero_initialized(&init.of("reward"), latent + actions, hidden, bins),
            pi: Head::new(&init.of("pi"), latent, hidden, 2 * actions),
            target_qs: qs.clone().into_iter().map(Module::no_grad).collect(),
            qs,
            termination: config.termination.then(|| Head::zero_initialized(&init.of("termination"), latent, hidden, 1)),
            config: config.clone(),
        }
    }

    /// Its sizes.
    pub fn config(&self) -> &Tdmpc2Config {
        &self.config
    }

    /// Where it lives.
    pub fn device(&self) -> Device {
        self.scale.value.val().device()
    }

    /// Numbers of an action.
    pub fn actions(&self) -> usize {
        self.pi._2.weight.dims()[0] / 2
    }

    /// Latents of observations, `[rows, latent]`.
    pub fn encode(&self, observation: Observation) -> Tensor<2> {
        let Observation { pixels, numbers } = observation;
        let seen = self.cnn.as_ref().zip(self.pixel_encoder.as_ref()).zip(pixels);
        let seen = seen.map(|((cnn, encoder), pixels)| encoder.forward(cnn.forward(pixels)));
        let read = self.extra_encoders.iter().zip(numbers).map(|((_, encoder), numbers)| encoder.forward(numbers));
        normalized_mlp::sim_norm(Tensor::cat(seen.into_iter().chain(read).collect(), 1), self.config.simplex)
    }

    /// The latents that follow `[rows, latent + actions]`.
    pub fn next(&self, latents_actions: Tensor<2>) -> Tensor<2> {
        self.dynamics.forward(latents_actions, self.config.simplex)
    }

    /// The policy at latents.
    pub fn policy(&self, latents: Tensor<2>) -> Gaussian {
        Gaussian::of(self.pi.forward(latents))
    }
}

impl NumberEncoder {
    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self._2.forward(self._1.forward(normalized_mlp::mish(self._0.forward(x))))
    }
}
