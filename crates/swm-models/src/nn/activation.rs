//! Activations and dropout.

use super::kernels::host;
use burn::tensor::{DType, Device, Tensor, TensorData, activation};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::Rng;
use swm_kernels::functions;

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
            Self::Gelu => gelu(x),
            Self::Silu => activation::silu(x),
        }
    }
}

/// `x Φ(x)`. On the CPU by our own kernel: Burn's computes the error function number by number, twice in training.
fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let device = x.device();
    if device.clone().inner() != Device::flex() || x.dtype() != DType::F32 {
        return activation::gelu(x);
    }
    let shape = x.dims();
    let tensor = |values: Vec<f32>| Tensor::<D>::from_data(TensorData::new(values, shape), &device);
    if !device.is_autodiff() {
        let mut values = host(x);
        functions::gelu(&mut values);
        return tensor(values);
    }
    // A line through every number that has the value and the slope of the curve there: that is all backward asks for.
    let mut offsets = host(x.clone().inner());
    let mut slopes = vec![0.0; offsets.len()];
    functions::gelu_tangent(&mut offsets, &mut slopes);
    x * tensor(slopes) + tensor(offsets)
}

/// Dropout noise of one training pass; none when evaluating.
pub struct DropoutRng<'a>(pub Option<&'a mut Rng>);

impl DropoutRng<'_> {
    /// No noise: evaluation.
    pub fn disabled() -> Self {
        DropoutRng(None)
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
