//! [`Tdmpc2`]: the networks of a TD-MPC2, with the published parameter names.

use super::config::Tdmpc2Config;
use super::image_encoder::{self, ImageCnn};
use crate::nn::{Dynamics, Head, Init, LayerNorm, Linear, ModuleDict, NormalizedLinear, normalized_mlp};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor};

/// The networks of a TD-MPC2: encoders of observations, latent dynamics, rewards, Q functions and a policy.
#[derive(Module, Debug)]
pub struct Tdmpc2 {
    /// The running spread of the values of a batch.
    pub scale: RunningScale,
    /// The convolutions of images; absent in a state-only model.
    pub cnn: Option<ImageCnn>,
    /// Maps convolution features to a latent; absent in a state-only model.
    pub pixel_encoder: Option<Linear>,
    /// The encoders of the columns other than images.
    pub extra_encoders: ModuleDict<ColumnEncoder>,
    /// Maps a latent and an action to the next latent.
    pub dynamics: Dynamics,
    /// The reward of an action, as logits of bins.
    pub reward: Head,
    /// The policy: mean and standard deviation of actions before `tanh`.
    pub pi: Head,
    /// The Q functions, as logits of bins.
    pub qs: Vec<Head>,
    /// The target networks: exponential moving averages of the Q functions.
    pub target_qs: Vec<Head>,
    /// The logit of termination at a latent; absent if terminations are not predicted.
    pub termination: Option<Head>,
    #[module(skip)]
    config: Tdmpc2Config,
}

/// A running average of the spread of values, the distance from the 5th to the 95th percentile.
#[derive(Module, Debug)]
pub struct RunningScale {
    /// The average spread, `[1]`.
    pub value: Param<Tensor<1>>,
}

/// The encoder of a column. A field `_i` is element i of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct ColumnEncoder {
    /// The layer to the hidden features.
    pub _0: NormalizedLinear,
    /// The layer from the hidden features.
    pub _1: Linear,
    /// The normalisation of the encoded column.
    pub _2: LayerNorm,
}

/// A batch of observations.
#[derive(Clone)]
pub struct Observation {
    /// The images, `[rows, 3, image, image]`; `None` for a state-only model.
    pub pixels: Option<Tensor<4>>,
    /// Every column other than images, `[rows, features]` each, in the order of the configuration.
    pub columns: Vec<Tensor<2>>,
}

impl Observation {
    /// Returns a range of rows.
    #[must_use]
    pub fn rows(&self, range: std::ops::Range<usize>) -> Self {
        Self {
            pixels: self.pixels.as_ref().map(|pixels| pixels.clone().slice([range.clone()])),
            columns: self.columns.iter().map(|column| column.clone().slice([range.clone()])).collect(),
        }
    }

    /// Concatenates the rows of several batches.
    #[must_use]
    pub fn cat(batches: &[Self]) -> Self {
        let count = batches.first().map_or(0, |batch| batch.columns.len());
        let pixels: Option<Vec<_>> = batches.iter().map(|batch| batch.pixels.clone()).collect();
        let column = |i: usize| Tensor::cat(batches.iter().map(|batch| batch.columns[i].clone()).collect(), 0);
        Self { pixels: pixels.map(|pixels| Tensor::cat(pixels, 0)), columns: (0..count).map(column).collect() }
    }

    /// Returns the observations as constants of an autodiff graph.
    #[must_use]
    pub fn autodiff(self) -> Self {
        Self {
            pixels: self.pixels.map(Tensor::autodiff),
            columns: self.columns.into_iter().map(Tensor::autodiff).collect(),
        }
    }
}

/// A Gaussian policy before `tanh`: mean and logarithm of the standard deviation, `[rows, action_dim]` each.
pub struct Gaussian {
    /// The mean.
    pub mean: Tensor<2>,
    /// The logarithm of the standard deviation.
    pub log_std: Tensor<2>,
}

impl Gaussian {
    /// Splits the output of a policy network into a mean and the logarithm of a standard deviation, which is mapped to
    /// -10 ..= 2.
    ///
    /// # Shapes
    /// `raw` is `[rows, 2 * action_dim]`.
    pub fn of(raw: Tensor<2>) -> Self {
        let [rows, both] = raw.dims();
        let half = both / 2;
        let mean = raw.clone().slice([0..rows, 0..half]);
        Self { mean, log_std: (raw.slice([0..rows, half..both]).tanh() + 1.0) * 6.0 - 10.0 }
    }

    /// Returns `tanh(mean + std * noise)` for standard normal `noise`.
    ///
    /// # Shapes
    /// `noise` is `[rows, action_dim]`; returns the same shape.
    pub fn sample(&self, noise: Tensor<2>) -> Tensor<2> {
        (self.mean.clone() + self.log_std.clone().exp() * noise).tanh()
    }
}

impl Tdmpc2 {
    /// Creates a model with random weights for actions of `action_dim` elements. `widths` holds the number of
    /// elements of each observed column other than images, in the order of the configuration.
    pub fn init(config: &Tdmpc2Config, widths: &[usize], action_dim: usize, init: &Init) -> Self {
        let (latent, hidden, bins) = (config.latent(), config.hidden, config.bins.count);
        let encoder = |(encoding, &width): (&super::Encoding, &usize)| {
            let init = init.of("extra_encoders").of(&encoding.column);
            let encoder = ColumnEncoder {
                _0: NormalizedLinear::new(&init.of("0"), width, config.encoder),
                _1: Linear::normal(&init.of("1"), config.encoder, encoding.latent, 0.02),
                _2: LayerNorm::new(&init.of("2"), encoding.latent, 1e-5),
            };
            (encoding.column.clone(), encoder)
        };
        let critic = |i| Head::zero_initialized(&init.of("qs").at(i), latent + action_dim, hidden, bins);
        let qs: Vec<Head> = (0..config.critics).map(critic).collect();
        let images = config.image_encoding();
        Self {
            scale: RunningScale { value: init.buffer([1], 10.0) },
            cnn: images.map(|_| ImageCnn::new(&init.of("cnn"))),
            pixel_encoder: images
                .map(|encoding| image_encoder::projection(&init.of("pixel_encoder"), config.image, encoding.latent)),
            extra_encoders: ModuleDict(config.column_encodings().zip(widths).map(encoder).collect()),
            dynamics: Dynamics::new(&init.of("dynamics"), latent + action_dim, hidden, latent),
            reward: Head::zero_initialized(&init.of("reward"), latent + action_dim, hidden, bins),
            pi: Head::new(&init.of("pi"), latent, hidden, 2 * action_dim),
            target_qs: qs.clone().into_iter().map(Module::no_grad).collect(),
            qs,
            termination: config.termination.then(|| Head::zero_initialized(&init.of("termination"), latent, hidden, 1)),
            config: config.clone(),
        }
    }

    /// Returns the configuration.
    pub fn config(&self) -> &Tdmpc2Config {
        &self.config
    }

    /// Returns the device of the weights.
    pub fn device(&self) -> Device {
        self.scale.value.val().device()
    }

    /// Returns the number of elements of an action.
    pub fn action_dim(&self) -> usize {
        self.pi._2.weight.dims()[0] / 2
    }

    /// Encodes observations.
    ///
    /// # Shapes
    /// Returns `[rows, latent]`.
    pub fn encode(&self, observation: Observation) -> Tensor<2> {
        let Observation { pixels, columns } = observation;
        let images = self.cnn.as_ref().zip(self.pixel_encoder.as_ref()).zip(pixels);
        let images = images.map(|((cnn, encoder), pixels)| encoder.forward(cnn.forward(pixels)));
        let columns = self.extra_encoders.iter().zip(columns).map(|((_, encoder), column)| encoder.forward(column));
        normalized_mlp::sim_norm(Tensor::cat(images.into_iter().chain(columns).collect(), 1), self.config.simplex)
    }

    /// Predicts the next latents.
    ///
    /// # Shapes
    /// `latents_actions` is `[rows, latent + action_dim]`; returns `[rows, latent]`.
    pub fn next(&self, latents_actions: Tensor<2>) -> Tensor<2> {
        self.dynamics.forward(latents_actions, self.config.simplex)
    }

    /// Returns the policy's action distribution at latents.
    ///
    /// # Shapes
    /// `latents` is `[rows, latent]`.
    pub fn policy(&self, latents: Tensor<2>) -> Gaussian {
        Gaussian::of(self.pi.forward(latents))
    }
}

impl ColumnEncoder {
    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self._2.forward(self._1.forward(normalized_mlp::mish(self._0.forward(x))))
    }
}
