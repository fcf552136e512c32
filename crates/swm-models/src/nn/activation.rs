//! Activations and dropout.

use burn::tensor::{Tensor, TensorData, activation};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::Rng;

/// A nonlinearity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// `max(x, 0)`.
    #[default]
    Relu,
    /// `x Φ(x)`, with the error function, not its approximation by tanh.
    Gelu,
    /// `x / (1 + exp(-x))`.
    Silu,
}

impl Activation {
    /// Applies it to every number.
    pub fn forward<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Relu => activation::relu(x),
            Self::Gelu => activation::gelu(x),
            Self::Silu => activation::silu(x),
        }
    }
}

/// Dropout noise of one training pass; none when evaluating.
pub struct Noise<'a>(pub Option<&'a mut Rng>);

impl Noise<'_> {
    /// No noise: evaluation.
    pub fn off() -> Self {
        Noise(None)
    }

    /// Sets numbers to zero with probability `rate` and scales the others by `1 / (1 - rate)`.
    pub fn dropout<const D: usize>(&mut self, x: Tensor<D>, rate: f32) -> Tensor<D> {
        let Some(rng) = self.0.as_deref_mut().filter(|_| rate > 0.0) else { return x };
        let keep = 1.0 / (1.0 - rate);
        let shape = x.dims();
        let mask: Vec<f32> =
            (0..shape.iter().product()).map(|_| if rng.random::<f32>() < rate { 0.0 } else { keep }).collect();
        let mask = Tensor::from_data(TensorData::new(mask, shape), &x.device());
        x * mask
    }
}
