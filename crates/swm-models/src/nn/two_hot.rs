//! Numbers as distributions over bins (Bellemare et al. 2017; Hafner et al. 2023, "two-hot"): a number lies between two bins,
//! each of which gets a share, on an axis on which large numbers are nearer to each other.

use super::with_derivative;
use burn::tensor::{Device, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};

/// `sign(x) ln(1 + |x|)`.
pub fn symlog<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    x.clone().sign() * (x.abs() + 1.0).log()
}

/// The inverse of [`symlog`].
pub fn symexp<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    x.clone().sign() * (x.abs().exp() - 1.0)
}

/// Equally spaced bins on the axis of [`symlog`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bins {
    /// How many, at least 2.
    pub count: usize,
    /// The first, as `symlog`.
    pub low: f64,
    /// The last, as `symlog`.
    pub high: f64,
}

impl Bins {
    #[allow(clippy::cast_precision_loss)]
    fn width(&self) -> f64 {
        (self.high - self.low) / (self.count - 1) as f64
    }

    /// The places of the bins, `[bins]`.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    fn places(&self, device: &Device) -> Tensor<1> {
        let places: Vec<f32> = (0..self.count).map(|i| (self.low + i as f64 * self.width()) as f32).collect();
        Tensor::from_data(TensorData::new(places, [self.count]), device)
    }

    /// Shares of the bins: `[rows]` to `[rows, bins]`. The share of a bin falls linearly to 0 at its neighbours.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    pub fn two_hot(&self, x: Tensor<1>) -> Tensor<2> {
        let position = (symlog(x).clamp(self.low, self.high) - self.low) / self.width();
        let numbers: Vec<f32> = (0..self.count).map(|i| i as f32).collect();
        let numbers = Tensor::<1>::from_data(TensorData::new(numbers, [self.count]), &position.device());
        let away = (position.unsqueeze_dim::<2>(1) - numbers.unsqueeze()).abs();
        activation::relu(away.neg() + 1.0)
    }

    /// The numbers that distributions stand for: logits `[rows, bins]` to `[rows]`.
    pub fn expectation(&self, logits: Tensor<2>) -> Tensor<1> {
        let places = if logits.is_autodiff() {
            self.places(&logits.clone().inner().device()).autodiff()
        } else {
            self.places(&logits.device())
        };
        symexp((activation::softmax(logits, 1) * places.unsqueeze()).sum_dim(1).squeeze_dim(1))
    }
}

/// The cross-entropy of logits to shares, both `[rows, bins]`: `[rows]`. Its gradient, the difference of both distributions,
/// is written down.
pub fn cross_entropy(logits: Tensor<2>, shares: Tensor<2>) -> Tensor<1> {
    let inner = logits.clone().inner();
    let [rows, _] = inner.dims();
    let log = activation::log_softmax(inner, 1);
    let value: Tensor<1> = (log.clone() * shares.clone()).sum_dim(1).neg().squeeze_dim(1);
    if !logits.is_autodiff() {
        return value;
    }
    let slope = log.exp() - shares;
    let sum = with_derivative(logits, Tensor::zeros(slope.dims(), &slope.device()), slope).sum_dim(1).reshape([rows]);
    sum + value.autodiff()
}
