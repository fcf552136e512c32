//! Activation functions and dropout.

use super::parameters::host;
use crate::device::is_cpu;
use burn::tensor::{DType, Tensor, TensorData, activation};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_2_SQRT_PI};
use swm_core::Rng;
use swm_kernels::functions;

/// An activation function.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Activation {
    /// `max(x, 0)`.
    #[default]
    Relu,
    /// `x Φ(x)` (Hendrycks and Gimpel 2016), with the error function and not its approximation by tanh.
    Gelu,
    /// `x / (1 + exp(-x))`, also called swish.
    Silu,
}

impl Activation {
    /// Applies the function to every element.
    ///
    /// # Shapes
    /// Maps `[…]` to the same shape.
    pub fn forward<const D: usize>(self, x: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Relu => activation::relu(x),
            Self::Gelu => gelu(x),
            Self::Silu => activation::silu(x),
        }
    }
}

/// `x Φ(x)`. The CPU uses the vectorised kernel of `swm-kernels`: Burn computes the error function one element at a
/// time, and twice in training.
fn gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    if has_kernels(&x) {
        return with_kernels(x, functions::gelu, functions::gelu_tangent);
    }
    if !is_cpu(&x.device()) && x.is_autodiff() { differentiable_gelu(x) } else { activation::gelu(x) }
}

/// Whether the CPU kernels of `swm-kernels` apply to a tensor.
pub(crate) fn has_kernels<const D: usize>(x: &Tensor<D>) -> bool {
    is_cpu(&x.device()) && x.dtype() == DType::F32
}

/// Applies an elementwise function of `swm-kernels` on the CPU. `tangent` replaces elements by the values at 0 of the function's
/// tangents, and writes the slopes of the tangents.
pub(super) fn with_kernels<const D: usize>(
    x: Tensor<D>,
    function: fn(&mut [f32]),
    tangent: fn(&mut [f32], &mut [f32]),
) -> Tensor<D> {
    let (shape, device) = (x.dims(), x.device());
    let tensor = |values: Vec<f32>| Tensor::<D>::from_data(TensorData::new(values, shape), &device);
    if !x.is_autodiff() {
        let mut values = host(x);
        function(&mut values);
        return tensor(values);
    }
    // The tangent at an element has the function's value and derivative at that element, so the backward pass through
    // the tangent is exact.
    let mut offsets = host(x.clone().inner());
    let mut slopes = vec![0.0; offsets.len()];
    tangent(&mut offsets, &mut slopes);
    x * tensor(slopes) + tensor(offsets)
}

/// `x Φ(x)` with its derivative, `Φ(x) + x φ(x)`: Burn differentiates the approximation by tanh, whose derivative differs by
/// 1e-3.
fn differentiable_gelu<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let inner = x.clone().inner();
    let cdf = (inner.clone() * FRAC_1_SQRT_2).erf() * 0.5 + 0.5;
    let tail = inner.clone() * (inner.clone().square() * -0.5).exp() * (0.5 * FRAC_2_SQRT_PI * FRAC_1_SQRT_2);
    // As on the CPU, the tangent at an element.
    let offset = (inner * tail.clone()).neg();
    x * (cdf + tail).autodiff() + offset.autodiff()
}

/// The random generator of dropout in one training pass; `None` in evaluation.
pub struct DropoutRng<'a>(pub Option<&'a mut Rng>);

impl DropoutRng<'_> {
    /// Disables dropout, for evaluation.
    pub fn disabled() -> Self {
        DropoutRng(None)
    }

    /// Sets elements to zero with probability `rate` and scales the remaining elements by `1 / (1 - rate)` (Srivastava
    /// et al. 2014).
    ///
    /// # Shapes
    /// Maps `[…]` to the same shape.
    pub fn dropout<const D: usize>(&mut self, x: Tensor<D>, rate: f32) -> Tensor<D> {
        let (shape, device) = (x.dims(), x.device());
        match self.mask(shape.iter().product(), rate) {
            Some(mask) => x * Tensor::from_data(TensorData::new(mask, shape), &device),
            None => x,
        }
    }

    /// Draws the factors of [`DropoutRng::dropout`] for `count` elements; `None` if it changes nothing.
    pub(super) fn mask(&mut self, count: usize, rate: f32) -> Option<Vec<f32>> {
        let rng = self.0.as_deref_mut().filter(|_| rate > 0.0)?;
        let scale = 1.0 / (1.0 - rate);
        Some((0..count).map(|_| if rng.random::<f32>() < rate { 0.0 } else { scale }).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    #[test]
    fn gelu_of_every_device_has_the_values_and_derivatives_of_the_cpu() {
        let values: Vec<f32> = (-60..=60).map(|i| i as f32 / 10.0).collect();
        let outputs = |function: fn(Tensor<1>) -> Tensor<1>| -> [Vec<f32>; 2] {
            let x = Tensor::<1>::from_floats(values.as_slice(), &Device::flex().autodiff()).require_grad();
            let y = function(x.clone());
            let gradient = x.grad(&y.clone().sum().backward()).expect("a gradient");
            [host(y.inner()), host(gradient)]
        };
        for (found, expected) in outputs(differentiable_gelu).iter().zip(&outputs(gelu)) {
            for ((found, expected), x) in found.iter().zip(expected).zip(&values) {
                assert!((found - expected).abs() < 2e-6, "{x}: {found}, not {expected}");
            }
        }
    }
}
