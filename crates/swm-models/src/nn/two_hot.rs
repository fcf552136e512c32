//! Scalars as distributions over bins (Bellemare et al. 2017; Hafner et al. 2023, section "Critic learning"): the
//! two-hot encoding puts weight on the two bins next to a scalar, on a logarithmic axis.

use super::with_derivative;
use burn::tensor::{Device, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};

/// Computes `sign(x) ln(1 + |x|)`.
///
/// # Shapes
/// Maps `[…]` to the same shape.
pub fn symlog<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    x.clone().sign() * (x.abs() + 1.0).log()
}

/// Computes the inverse of [`symlog`], `sign(x) (exp |x| - 1)`.
///
/// # Shapes
/// Maps `[…]` to the same shape.
pub fn symexp<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    x.clone().sign() * (x.abs().exp() - 1.0)
}

/// Equally spaced bins on the axis of [`symlog`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bins {
    /// The number of bins, at least 2.
    pub count: usize,
    /// The centre of the first bin, on the axis of [`symlog`].
    pub low: f64,
    /// The centre of the last bin, on the axis of [`symlog`].
    pub high: f64,
}

impl Bins {
    fn width(&self) -> f64 {
        (self.high - self.low) / (self.count - 1) as f64
    }

    /// The centres of the bins on the axis of [`symlog`], `[bins]`.
    fn centres(&self, device: &Device) -> Tensor<1> {
        let centres: Vec<f32> = (0..self.count).map(|i| (self.low + i as f64 * self.width()) as f32).collect();
        Tensor::from_data(TensorData::new(centres, [self.count]), device)
    }

    /// Encodes scalars: the weight of a bin falls linearly from 1 at the bin's centre to 0 at the neighbouring
    /// centres.
    ///
    /// # Shapes
    /// Maps `[rows]` to `[rows, bins]`.
    pub fn two_hot(&self, x: Tensor<1>) -> Tensor<2> {
        let position = (symlog(x).clamp(self.low, self.high) - self.low) / self.width();
        let indices: Vec<f32> = (0..self.count).map(|i| i as f32).collect();
        let indices = Tensor::<1>::from_data(TensorData::new(indices, [self.count]), &position.device());
        let distance = (position.unsqueeze_dim::<2>(1) - indices.unsqueeze()).abs();
        activation::relu(distance.neg() + 1.0)
    }

    /// Decodes distributions: `symexp` of the mean of the centres, weighted by the softmax of the logits.
    ///
    /// # Shapes
    /// Maps `[rows, bins]` to `[rows]`.
    pub fn expectation(&self, logits: Tensor<2>) -> Tensor<1> {
        let centres = if logits.is_autodiff() {
            self.centres(&logits.clone().inner().device()).autodiff()
        } else {
            self.centres(&logits.device())
        };
        symexp((activation::softmax(logits, 1) * centres.unsqueeze()).sum_dim(1).squeeze_dim(1))
    }
}

/// Computes the cross-entropy `-Σ target log softmax(logits)`. The gradient,
/// `softmax(logits) - target`, is computed explicitly.
///
/// # Shapes
/// `logits` and `target` are `[rows, bins]`; returns `[rows]`.
pub fn cross_entropy(logits: Tensor<2>, target: Tensor<2>) -> Tensor<1> {
    let inner = logits.clone().inner();
    let [rows, _] = inner.dims();
    let log = activation::log_softmax(inner, 1);
    let value: Tensor<1> = (log.clone() * target.clone()).sum_dim(1).neg().squeeze_dim(1);
    if !logits.is_autodiff() {
        return value;
    }
    let derivative = log.exp() - target;
    let sum = with_derivative(logits, Tensor::zeros(derivative.dims(), &derivative.device()), derivative)
        .sum_dim(1)
        .reshape([rows]);
    sum + value.autodiff()
}
