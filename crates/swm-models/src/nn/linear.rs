//! A linear layer in PyTorch's layout.

use super::Init;
use super::activation::has_kernels;
use super::fused_layers;
use crate::device::matmul;
use burn::module::{Module, Param};
use burn::tensor::Tensor;

/// A linear layer, `y = x Wᵀ + b`.
#[derive(Module, Debug)]
pub struct Linear {
    /// The weights `W`, `[outputs, inputs]`.
    pub weight: Param<Tensor<2>>,
    /// The bias `b`, `[outputs]`.
    pub bias: Option<Param<Tensor<1>>>,
}

impl Linear {
    /// Creates a layer with PyTorch's default initialisation: uniform within `1 / sqrt(inputs)`.
    pub fn new(init: &Init, inputs: usize, outputs: usize) -> Self {
        let bound = 1.0 / (inputs as f32).sqrt();
        Self {
            weight: init.uniform("weight", [outputs, inputs], bound),
            bias: Some(init.uniform("bias", [outputs], bound)),
        }
    }

    /// Creates a layer without bias.
    pub fn without_bias(init: &Init, inputs: usize, outputs: usize) -> Self {
        Self { bias: None, ..Self::new(init, inputs, outputs) }
    }

    /// Creates a zero-initialised layer.
    pub fn zeros(init: &Init, inputs: usize, outputs: usize) -> Self {
        Self { weight: init.constant([outputs, inputs], 0.0), bias: Some(init.constant([outputs], 0.0)) }
    }

    /// Creates a layer with normally distributed weights (standard deviation `std`) and bias 0.
    pub fn normal(init: &Init, inputs: usize, outputs: usize, std: f32) -> Self {
        Self { weight: init.normal("weight", [outputs, inputs], std), bias: Some(init.constant([outputs], 0.0)) }
    }

    /// Applies the layer, on the CPU as one operation; all leading axes are rows of one matrix product.
    ///
    /// # Shapes
    /// Maps `[…, inputs]` to `[…, outputs]`.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let [outputs, inputs] = self.weight.dims();
        let mut shape = x.dims();
        let rows = shape[..D - 1].iter().product::<usize>();
        shape[D - 1] = outputs;
        let x = x.reshape([rows, inputs]);
        let y = match &self.bias {
            Some(bias) if has_kernels(&x) => fused_layers::linear(x, self.weight.val(), bias.val()),
            Some(bias) => matmul(x, self.weight.val().transpose()) + bias.val().unsqueeze(),
            None => matmul(x, self.weight.val().transpose()),
        };
        y.reshape(shape)
    }
}
