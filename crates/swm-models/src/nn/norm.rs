//! Normalisation layers.

use super::{Init, Named};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, module};

/// Layer normalisation over the last axis (Ba et al. 2016).
#[derive(Module, Debug)]
pub struct LayerNorm {
    /// Scale, `[features]`.
    pub weight: Param<Tensor<1>>,
    /// Shift, `[features]`.
    pub bias: Param<Tensor<1>>,
    epsilon: f64,
}

impl LayerNorm {
    /// Creates a layer with scale 1 and shift 0.
    pub fn new(init: &Init, features: usize, epsilon: f64) -> Self {
        Self { weight: init.constant([features], 1.0), bias: init.constant([features], 0.0), epsilon }
    }

    /// The value added to the variance.
    pub fn epsilon(&self) -> f64 {
        self.epsilon
    }

    /// Applies the layer.
    ///
    /// # Shapes
    /// Maps `[…, features]` to the same shape.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        module::layer_norm(x, self.weight.val(), Some(self.bias.val()), self.epsilon)
    }
}

/// Normalises the last axis to mean 0 and variance 1, without scale and shift.
///
/// # Shapes
/// Maps `[…, features]` to the same shape.
pub fn standardize<const D: usize>(x: Tensor<D>, epsilon: f64) -> Tensor<D> {
    let mean = x.clone().mean_dim(D - 1);
    let centred = x - mean;
    let variance = centred.clone().square().mean_dim(D - 1);
    centred / (variance + epsilon).sqrt()
}

/// Batch normalisation of `[rows, features]` (Ioffe and Szegedy 2015).
#[derive(Module, Debug)]
pub struct BatchNorm {
    /// Scale, `[features]`.
    pub weight: Param<Tensor<1>>,
    /// Shift, `[features]`.
    pub bias: Param<Tensor<1>>,
    /// The running mean, `[features]`, used when evaluating.
    pub running_mean: Param<Tensor<1>>,
    /// The running (unbiased) variance, `[features]`, used when evaluating.
    pub running_var: Param<Tensor<1>>,
}

/// Mean and unbiased variance of one training batch, `[features]` each.
#[derive(Clone, Debug)]
pub struct BatchStatistics {
    mean: Tensor<1>,
    variance: Tensor<1>,
}

impl BatchStatistics {
    /// Creates statistics from mean and unbiased variance, `[features]` each.
    pub fn new(mean: Tensor<1>, variance: Tensor<1>) -> Self {
        Self { mean, variance }
    }

    /// Inserts the statistics into `tensors` under `name`.
    pub fn store(self, name: &str, tensors: &mut Named<Tensor<1>>) {
        tensors.insert(format!("{name}.mean"), self.mean);
        tensors.insert(format!("{name}.variance"), self.variance);
    }

    /// Removes the statistics that [`BatchStatistics::store`] inserted.
    pub fn take(name: &str, tensors: &mut Named<Tensor<1>>) -> Option<Self> {
        let mut tensor = |part: &str| tensors.remove(&format!("{name}.{part}"));
        Some(Self { mean: tensor("mean")?, variance: tensor("variance")? })
    }
}

impl BatchNorm {
    /// The value added to the variance.
    pub const EPSILON: f64 = 1e-5;
    /// The weight of a batch in the running statistics.
    const MOMENTUM: f64 = 0.1;

    /// Creates a layer with scale 1, shift 0 and the running statistics of a standard normal distribution.
    pub fn new(init: &Init, features: usize) -> Self {
        Self {
            weight: init.constant([features], 1.0),
            bias: init.constant([features], 0.0),
            running_mean: init.buffer([features], 0.0),
            running_var: init.buffer([features], 1.0),
        }
    }

    /// Normalises with the running statistics.
    ///
    /// # Shapes
    /// Maps `[rows, features]` to the same shape.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let scale = self.weight.val() / (self.running_var.val() + Self::EPSILON).sqrt();
        let shift = self.bias.val() - self.running_mean.val() * scale.clone();
        x * scale.unsqueeze() + shift.unsqueeze()
    }

    /// Normalises with the statistics of the batch; also returns the statistics, for [`BatchNorm::track`].
    ///
    /// # Shapes
    /// Maps `[rows, features]` to the same shape.
    pub fn forward_train(&self, x: Tensor<2>) -> (Tensor<2>, BatchStatistics) {
        let [rows, _] = x.dims();
        let mean = x.clone().mean_dim(0);
        let centred = x - mean.clone();
        let variance = centred.clone().square().mean_dim(0);
        let normal = centred / (variance.clone() + Self::EPSILON).sqrt();
        let unbiased = rows as f64 / (rows as f64 - 1.0).max(1.0);
        let statistics = BatchStatistics {
            mean: mean.inner().squeeze_dim(0),
            variance: (variance.inner() * unbiased).squeeze_dim(0),
        };
        (normal * self.weight.val().unsqueeze() + self.bias.val().unsqueeze(), statistics)
    }

    /// Updates the running statistics with the statistics of a batch.
    pub fn track(&mut self, batch: BatchStatistics) {
        let update = |running: &mut Param<Tensor<1>>, value: Tensor<1>| {
            let next = running.val().inner() * (1.0 - Self::MOMENTUM) + value * Self::MOMENTUM;
            *running = Param::from_tensor(next).set_require_grad(false);
        };
        update(&mut self.running_mean, batch.mean);
        update(&mut self.running_var, batch.variance);
    }

    /// The device of the layer.
    pub fn device(&self) -> Device {
        self.weight.val().device()
    }
}
