//! Layers as single operations of an autodiff graph on the CPU: a [`linear`] layer in place of up to four, and a
//! [`hidden`] layer (linear, dropout, layer normalisation, Mish) in place of some twenty. Burn would allocate, clear and copy memory for
//! each.

use burn::backend::autodiff::checkpoint::{base::Checkpointer, strategy::CheckpointStrategy};
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::ops::FloatTensorOps as _;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Backend, Dispatch, Flex, TensorMetadata as _, backend_extension};
use burn::tensor::{Tensor, TensorData};
use std::sync::Arc;
use swm_kernels::{Matrix, NormMish, NormMishTape, functions, multiply};

/// Computes `x Wᵀ + b` on the CPU.
///
/// # Shapes
/// `x` is `[rows, inputs]`, `weight` `[outputs, inputs]`, `bias` `[outputs]`; returns `[rows, outputs]`.
pub(super) fn linear(x: Tensor<2>, weight: Tensor<2>, bias: Tensor<1>) -> Tensor<2> {
    let (x, weight, bias) = (x.into_dispatch(), weight.into_dispatch(), bias.into_dispatch());
    Tensor::from_dispatch(<Dispatch as Layers>::linear(x, weight, bias))
}

/// The parameters of a hidden layer.
pub(super) struct HiddenParameters {
    /// The weights, `[outputs, inputs]`.
    pub weight: Tensor<2>,
    /// The bias, `[outputs]`.
    pub bias: Tensor<1>,
    /// The scale of the normalisation, `[outputs]`.
    pub scale: Tensor<1>,
    /// The shift of the normalisation, `[outputs]`.
    pub shift: Tensor<1>,
    /// The value that the normalisation adds to the variance.
    pub epsilon: f64,
}

/// Computes a hidden layer on the CPU: `x Wᵀ + b`, dropout, layer normalisation, Mish. `mask`, which may be empty, holds the factors of
/// dropout.
///
/// # Shapes
/// `x` is `[rows, inputs]`, `mask` `[rows, outputs]`; returns `[rows, outputs]`.
pub(super) fn hidden(x: Tensor<2>, parameters: HiddenParameters, mask: Vec<f32>) -> Tensor<2> {
    let HiddenParameters { weight, bias, scale, shift, epsilon } = parameters;
    let (x, weight) = (x.into_dispatch(), weight.into_dispatch());
    let [bias, scale, shift] = [bias, scale, shift].map(Tensor::into_dispatch);
    Tensor::from_dispatch(<Dispatch as Layers>::hidden(x, weight, bias, scale, shift, mask, epsilon))
}

/// The operations of this file. Only the CPU has them.
#[backend_extension(Flex, Autodiff)]
trait Layers: Backend {
    /// See [`linear`].
    fn linear(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self>;

    /// See [`hidden`].
    fn hidden(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        mask: Vec<f32>,
        epsilon: f64,
    ) -> FloatTensor<Self>;
}

impl Layers for Flex {
    fn linear(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let mut y = product(&x, &weight);
        let bias = bias.to_contiguous();
        let bias = elements(&bias);
        for row in y.chunks_exact_mut(bias.len()) {
            row.iter_mut().zip(bias).for_each(|(y, bias)| *y += bias);
        }
        rows(y, bias.len())
    }

    fn hidden(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        mask: Vec<f32>,
        epsilon: f64,
    ) -> FloatTensor<Self> {
        let layer = norm_mish([bias, scale, shift], epsilon);
        let mut y = product(&x, &weight);
        layer.apply(&mask, &mut y);
        rows(y, layer.bias.len())
    }
}

impl<C: CheckpointStrategy> Layers for Autodiff<Flex, C> {
    fn linear(x: FloatTensor<Self>, weight: FloatTensor<Self>, bias: FloatTensor<Self>) -> FloatTensor<Self> {
        let ((x, of_x), (weight, of_weight), (bias, of_bias)) =
            (x.into_parts(), weight.into_parts(), bias.into_parts());
        let (x, weight) = (x.to_contiguous(), weight.to_contiguous());
        let y = Flex::linear(x.clone(), weight.clone(), bias);
        match LinearGradient.prepare::<C>([of_x, of_weight, of_bias]).compute_bound().stateful() {
            OpsKind::UnTracked(prepared) => prepared.finish(y),
            OpsKind::Tracked(prepared) => prepared.finish([x, weight], y),
        }
    }

    fn hidden(
        x: FloatTensor<Self>,
        weight: FloatTensor<Self>,
        bias: FloatTensor<Self>,
        scale: FloatTensor<Self>,
        shift: FloatTensor<Self>,
        mask: Vec<f32>,
        epsilon: f64,
    ) -> FloatTensor<Self> {
        let ((x, of_x), (weight, of_weight), (bias, of_bias)) =
            (x.into_parts(), weight.into_parts(), bias.into_parts());
        let ((scale, of_scale), (shift, of_shift)) = (scale.into_parts(), shift.into_parts());
        let nodes = [of_x, of_weight, of_bias, of_scale, of_shift];
        match HiddenGradient.prepare::<C>(nodes).compute_bound().stateful() {
            OpsKind::UnTracked(prepared) => prepared.finish(Flex::hidden(x, weight, bias, scale, shift, mask, epsilon)),
            OpsKind::Tracked(prepared) => {
                let (x, weight) = (x.to_contiguous(), weight.to_contiguous());
                let layer = norm_mish([bias, scale, shift], epsilon);
                let (mut y, features) = (product(&x, &weight), layer.bias.len());
                let [mut standard, mut slopes] = [(); 2].map(|()| vec![0.0; y.len()]);
                let mut factors = vec![0.0; y.len() / features];
                let tape = NormMishTape { standard: &mut *standard, slopes: &mut *slopes, factors: &mut *factors };
                layer.apply_recorded(&mask, &mut y, tape);
                let tape = NormMishTape { standard, slopes, factors };
                prepared.finish(Arc::new(HiddenTape { x, weight, layer, mask, tape }), rows(y, features))
            }
        }
    }
}

/// The backward pass of [`linear`]: gradients of inputs, weights and bias.
#[derive(Debug)]
struct LinearGradient;

impl Backward<Flex, 3> for LinearGradient {
    /// Inputs and weights.
    type State = [FloatTensor<Flex>; 2];

    fn backward(self, ops: Ops<Self::State, 3>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let [x, weight] = ops.state;
        let d = values(gradients.consume::<Flex>(&ops.node));
        let [of_x, of_weight, of_bias] = ops.parents;
        if let Some(parent) = of_bias {
            let [features, _] = weight.shape().dims();
            let mut sum = vec![0.0; features];
            functions::add_rows(&mut sum, &d);
            gradients.register::<Flex>(parent.id, vector(sum));
        }
        register_product(gradients, [of_x, of_weight].map(|parent| parent.map(|parent| parent.id)), &d, &x, &weight);
    }
}

/// What the backward pass of [`hidden`] needs of the forward pass.
#[derive(Debug)]
struct HiddenTape {
    x: FloatTensor<Flex>,
    weight: FloatTensor<Flex>,
    layer: NormMish,
    mask: Vec<f32>,
    tape: NormMishTape<Vec<f32>>,
}

/// The backward pass of [`hidden`]: gradients of inputs, weights, bias, scale and shift.
#[derive(Debug)]
struct HiddenGradient;

impl Backward<Flex, 5> for HiddenGradient {
    type State = Arc<HiddenTape>;

    fn backward(self, ops: Ops<Self::State, 5>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let HiddenTape { x, weight, layer, mask, tape } = &*ops.state;
        let mut d = values(gradients.consume::<Flex>(&ops.node));
        let tape = NormMishTape { standard: &*tape.standard, slopes: &*tape.slopes, factors: &*tape.factors };
        let of_vectors = layer.backward(mask, &tape, &mut d);
        let [of_x, of_weight, parents @ ..] = ops.parents;
        for (parent, gradient) in parents.into_iter().zip(of_vectors) {
            if let Some(parent) = parent {
                gradients.register::<Flex>(parent.id, vector(gradient));
            }
        }
        register_product(gradients, [of_x, of_weight].map(|parent| parent.map(|parent| parent.id)), &d, x, weight);
    }
}

/// Registers the gradients of `x` and `weight`, whose product `x Wᵀ` has the gradient `d`.
fn register_product(
    gradients: &mut Gradients,
    [of_x, of_weight]: [Option<burn::backend::autodiff::NodeId>; 2],
    d: &[f32],
    x: &FloatTensor<Flex>,
    weight: &FloatTensor<Flex>,
) {
    let [outputs, inputs] = weight.shape().dims();
    let d = Matrix::new(d, outputs);
    if let Some(id) = of_weight {
        let gradient = multiply(d.transposed(), Matrix::new(elements(x), inputs));
        gradients.register::<Flex>(id, rows(gradient, inputs));
    }
    if let Some(id) = of_x {
        gradients.register::<Flex>(id, rows(multiply(d, Matrix::new(elements(weight), inputs)), inputs));
    }
}

/// Computes `x Wᵀ`.
fn product(x: &FloatTensor<Flex>, weight: &FloatTensor<Flex>) -> Vec<f32> {
    let (x, weight) = (x.to_contiguous(), weight.to_contiguous());
    let [_, inputs] = weight.shape().dims();
    multiply(Matrix::new(elements(&x), inputs), Matrix::new(elements(&weight), inputs).transposed())
}

fn norm_mish(parameters: [FloatTensor<Flex>; 3], epsilon: f64) -> NormMish {
    let [bias, scale, shift] = parameters.map(|parameter| elements(&parameter.to_contiguous()).to_vec());
    NormMish { bias, scale, shift, epsilon: epsilon as f32 }
}

/// The elements of a contiguous tensor.
fn elements(tensor: &FloatTensor<Flex>) -> &[f32] {
    tensor.as_slice().expect("a contiguous tensor of single precision")
}

/// The elements of a tensor, without a copy if a kernel made them and nothing else uses them.
fn values(tensor: FloatTensor<Flex>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("a tensor of single precision")
}

/// A tensor `[rows, features]`.
fn rows(values: Vec<f32>, features: usize) -> FloatTensor<Flex> {
    let shape = [values.len() / features, features];
    Flex::float_from_data(TensorData::new(values, shape), &Default::default())
}

/// A tensor of one axis.
fn vector(values: Vec<f32>) -> FloatTensor<Flex> {
    let shape = [values.len()];
    Flex::float_from_data(TensorData::new(values, shape), &Default::default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::norm::standardize;
    use crate::nn::parameters::host;
    use burn::tensor::Device;

    fn tensor(seed: usize, shape: [usize; 2]) -> Tensor<2> {
        let value = |i: usize| ((i + seed) * 7919 % 1009) as f32 / 504.5 - 1.0;
        let values: Vec<f32> = (0..shape[0] * shape[1]).map(value).collect();
        Tensor::from_data(TensorData::new(values, shape), &Device::flex().autodiff()).require_grad()
    }

    /// The values of `y` and the gradients of a weighted sum of them.
    fn derivatives(y: Tensor<2>, inputs: &[&Tensor<2>]) -> Vec<Vec<f32>> {
        let weights = tensor(9, y.dims()).inner().autodiff();
        let all = (y.clone() * weights).sum().backward();
        let gradients = inputs.iter().map(|input| host(input.grad(&all).expect("a gradient")));
        [host(y.inner())].into_iter().chain(gradients).collect()
    }

    fn assert_close(found: &[Vec<f32>], expected: &[Vec<f32>]) {
        for (part, (found, expected)) in found.iter().zip(expected).enumerate() {
            assert_eq!(found.len(), expected.len(), "part {part}");
            for (i, (found, expected)) in found.iter().zip(expected).enumerate() {
                assert!((found - expected).abs() < 5e-5, "part {part}, element {i}: {found}, expected {expected}");
            }
        }
    }

    #[test]
    fn linear_layers_have_the_values_and_gradients_of_their_definition() {
        let (x, weight, bias) = (tensor(1, [9, 5]), tensor(2, [21, 5]), tensor(3, [1, 21]));
        let inputs = [&x, &weight, &bias];
        let found = linear(x.clone(), weight.clone(), bias.clone().squeeze_dim(0));
        let found = derivatives(found, &inputs);
        let y = x.clone().matmul(weight.clone().transpose()) + bias.clone();
        assert_close(&found, &derivatives(y, &inputs));
        // The same outside a graph, and of a part of the rows.
        let bias = bias.clone().inner().squeeze_dim(0);
        let part = linear(x.clone().inner().narrow(0, 3, 2), weight.clone().inner(), bias);
        assert_eq!(host(part), found[0][3 * 21..5 * 21]);
    }

    #[test]
    fn hidden_layers_have_the_values_and_gradients_of_their_definition() {
        let (x, weight) = (tensor(1, [11, 6]), tensor(2, [37, 6]));
        let vectors = [3, 4, 5].map(|seed| tensor(seed, [1, 37]));
        let dropped: Vec<f32> = (0..11 * 37).map(|i| if i % 5 == 0 { 0.0 } else { 1.25 }).collect();
        for mask in [vec![], dropped] {
            let inputs = [&x, &weight, &vectors[0], &vectors[1], &vectors[2]];
            let parameters = |change: fn(Tensor<2>) -> Tensor<2>| {
                let [bias, scale, shift] = vectors.clone().map(|vector| change(vector).squeeze_dim(0));
                HiddenParameters { weight: change(weight.clone()), bias, scale, shift, epsilon: 1e-5 }
            };
            let found = derivatives(hidden(x.clone(), parameters(|tensor| tensor), mask.clone()), &inputs);
            let factors = if mask.is_empty() { vec![1.0; 11 * 37] } else { mask.clone() };
            let factors = Tensor::<2>::from_data(TensorData::new(factors, [11, 37]), &x.device());
            let [bias, scale, shift] = vectors.clone();
            let z = (x.clone().matmul(weight.clone().transpose()) + bias) * factors;
            let z = standardize(z, 1e-5) * scale + shift;
            assert_close(&found, &derivatives(z.clone() * (z.exp() + 1.0).log().tanh(), &inputs));
            // The same outside a graph, and with parameters that need no gradient.
            let constants = parameters(|tensor| tensor.inner());
            assert_eq!(host(hidden(x.clone().inner(), constants, mask.clone())), found[0]);
            let of_x = hidden(x.clone(), parameters(|tensor| tensor.inner().autodiff()), mask);
            assert_eq!(derivatives(of_x, &[&x])[1], found[1]);
        }
    }
}
