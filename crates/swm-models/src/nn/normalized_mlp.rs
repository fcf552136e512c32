//! Multi-layer perceptrons with normalised hidden layers (Hansen, Su and Wang 2024, arXiv 2310.16828): every hidden
//! layer is linear, normalised, and goes through Mish; a latent is a concatenation of simplices.

use super::activation::{has_kernels, with_kernels};
use super::fused_layers::{self, HiddenParameters};
use super::norm::standardize;
use super::{DropoutRng, Init, LayerNorm, Linear, with_derivative};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, activation};
use swm_kernels::functions;

/// The value that the normalisations add to the variance.
const EPSILON: f64 = 1e-5;
/// The standard deviation of initial weights, which are truncated at twice the standard deviation.
const STD: f32 = 0.02;

/// A linear layer followed by layer normalisation.
#[derive(Module, Debug)]
pub struct NormalizedLinear {
    /// The weights, `[outputs, inputs]`.
    pub weight: Param<Tensor<2>>,
    /// The bias, `[outputs]`.
    pub bias: Param<Tensor<1>>,
    /// The normalisation.
    pub ln: LayerNorm,
}

impl NormalizedLinear {
    /// Creates a layer.
    pub fn new(init: &Init, inputs: usize, outputs: usize) -> Self {
        Self {
            weight: init.normal("weight", [outputs, inputs], STD),
            bias: init.constant([outputs], 0.0),
            ln: LayerNorm::new(&init.of("ln"), outputs, EPSILON),
        }
    }

    /// Computes the input of the activation function.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self.ln.forward(x.matmul(self.weight.val().transpose()) + self.bias.val().unsqueeze())
    }

    /// Computes the output of a hidden layer: [`NormalizedLinear::forward`] and Mish.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn hidden(&self, x: Tensor<2>) -> Tensor<2> {
        self.hidden_with_dropout(x, 0.0, &mut DropoutRng::disabled())
    }

    /// As [`NormalizedLinear::hidden`], with dropout after the matrix product.
    fn hidden_with_dropout(&self, x: Tensor<2>, rate: f32, noise: &mut DropoutRng<'_>) -> Tensor<2> {
        let (weight, bias, norm) = (self.weight.val(), self.bias.val(), &self.ln);
        if has_kernels(&x) {
            let mask = noise.mask(x.dims()[0] * bias.dims()[0], rate).unwrap_or_default();
            let (scale, shift, epsilon) = (norm.weight.val(), norm.bias.val(), norm.epsilon());
            return fused_layers::hidden(x, HiddenParameters { weight, bias, scale, shift, epsilon }, mask);
        }
        mish(norm.forward(noise.dropout(x.matmul(weight.transpose()) + bias.unsqueeze(), rate)))
    }
}

/// A network of two hidden layers and a linear output layer. A field `_2` is element 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct Head {
    /// The layer to the hidden features.
    pub _0: NormalizedLinear,
    /// The layer between the hidden features.
    pub _1: NormalizedLinear,
    /// The output layer.
    pub _2: Linear,
}

impl Head {
    /// Creates a head.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            _0: NormalizedLinear::new(&init.of("0"), inputs, hidden),
            _1: NormalizedLinear::new(&init.of("1"), hidden, hidden),
            _2: Linear::normal(&init.of("2"), hidden, outputs, STD),
        }
    }

    /// Creates a head with a zero-initialised output layer.
    pub fn zero_initialized(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        let mut head = Self::new(init, inputs, hidden, outputs);
        head._2 = Linear::zeros(init, hidden, outputs);
        head
    }

    /// Applies the network.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self._2.forward(self._1.hidden(self._0.hidden(x)))
    }
}

/// A network of two hidden layers and an output layer whose output is a latent of simplices.
#[derive(Module, Debug)]
pub struct Dynamics {
    /// The layer to the hidden features.
    pub _0: NormalizedLinear,
    /// The layer between the hidden features.
    pub _1: NormalizedLinear,
    /// The output layer.
    pub _2: NormalizedLinear,
}

impl Dynamics {
    /// Creates the network.
    pub fn new(init: &Init, inputs: usize, hidden: usize, latent: usize) -> Self {
        Self {
            _0: NormalizedLinear::new(&init.of("0"), inputs, hidden),
            _1: NormalizedLinear::new(&init.of("1"), hidden, hidden),
            _2: NormalizedLinear::new(&init.of("2"), hidden, latent),
        }
    }

    /// Computes latents, every `simplex` elements of which add up to 1.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[rows, latent]`.
    pub fn forward(&self, x: Tensor<2>, simplex: usize) -> Tensor<2> {
        sim_norm(self._2.forward(self._1.hidden(self._0.hidden(x))), simplex)
    }
}

/// Several heads of equal sizes. A GPU computes them together, with one batched matrix product per layer; the CPU computes one after
/// another, without copying weights.
pub struct Ensemble {
    heads: Vec<Head>,
    /// The layers of all heads; `None` on the CPU.
    layers: Option<[Layer; 3]>,
}

/// One layer of all heads: weights `[heads, inputs, outputs]`; bias, scale and shift `[heads, 1, outputs]`.
struct Layer {
    weight: Tensor<3>,
    bias: Option<Tensor<3>>,
    norm: Option<[Tensor<3>; 2]>,
}

impl Ensemble {
    /// Combines heads; gradients flow back to the heads.
    pub fn of(heads: &[&Head]) -> Self {
        let is_on_cpu = heads.first().is_none_or(|head| has_kernels(&head._2.weight.val()));
        let layers = (!is_on_cpu).then(|| {
            let hidden = |get: fn(&Head) -> &NormalizedLinear| Layer {
                weight: matrices(heads.iter().map(|head| &get(head).weight)),
                bias: rows(heads.iter().map(|head| Some(&get(head).bias))),
                norm: rows(heads.iter().map(|head| Some(&get(head).ln.weight)))
                    .zip(rows(heads.iter().map(|head| Some(&get(head).ln.bias))))
                    .map(<[_; 2]>::from),
            };
            let last = Layer {
                weight: matrices(heads.iter().map(|head| &head._2.weight)),
                bias: rows(heads.iter().map(|head| head._2.bias.as_ref())),
                norm: None,
            };
            [hidden(|head| &head._0), hidden(|head| &head._1), last]
        });
        Self { heads: heads.iter().map(|head| (*head).clone()).collect(), layers }
    }

    /// Returns heads that are outside a graph as constants of a graph: gradients flow through them to the input, but not to the heads.
    #[must_use]
    pub fn frozen(mut self) -> Self {
        self.heads = self.heads.into_iter().map(|head| head.train().no_grad()).collect();
        let freeze = |tensor: &mut Tensor<3>| *tensor = tensor.clone().inner().autodiff();
        for Layer { weight, bias, norm } in self.layers.iter_mut().flatten() {
            freeze(weight);
            bias.iter_mut().chain(norm.iter_mut().flatten()).for_each(freeze);
        }
        self
    }

    /// Applies all heads; `dropout` is the rate after the first matrix product.
    ///
    /// # Shapes
    /// Maps `[rows, inputs]` to `[heads, rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>, dropout: f32, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let Some([first, second, last]) = &self.layers else {
            let outputs = self
                .heads
                .iter()
                .map(|Head { _0, _1, _2 }| _2.forward(_1.hidden(_0.hidden_with_dropout(x.clone(), dropout, noise))));
            return Tensor::stack(outputs.collect(), 0);
        };
        let [heads, _, _] = first.weight.dims();
        let [rows, inputs] = x.dims();
        let x = x.unsqueeze_dim::<3>(0).expand([heads, rows, inputs]);
        let x = noise.dropout(first.product(x), dropout);
        let x = mish(first.normalise(x));
        let x = mish(second.normalise(second.product(x)));
        last.product(x)
    }
}

/// Stacks the matrices of several heads.
///
/// # Shapes
/// Maps matrices `[outputs, inputs]` to `[heads, inputs, outputs]`.
fn matrices<'a>(parameters: impl Iterator<Item = &'a Param<Tensor<2>>>) -> Tensor<3> {
    Tensor::stack::<3>(parameters.map(Param::val).collect(), 0).swap_dims(1, 2)
}

/// Stacks the vectors of several heads, or returns `None` if a vector is missing.
///
/// # Shapes
/// Maps vectors `[outputs]` to `[heads, 1, outputs]`.
fn rows<'a>(parameters: impl Iterator<Item = Option<&'a Param<Tensor<1>>>>) -> Option<Tensor<3>> {
    let all: Option<Vec<Tensor<1>>> = parameters.map(|parameter| parameter.map(Param::val)).collect();
    Some(Tensor::stack::<2>(all?, 0).unsqueeze_dim(1))
}

impl Layer {
    fn product(&self, x: Tensor<3>) -> Tensor<3> {
        let product = x.matmul(self.weight.clone());
        match &self.bias {
            Some(bias) => product + bias.clone(),
            None => product,
        }
    }

    fn normalise(&self, x: Tensor<3>) -> Tensor<3> {
        match &self.norm {
            Some([scale, shift]) => standardize(x, EPSILON) * scale.clone() + shift.clone(),
            None => x,
        }
    }
}

/// Mish (Misra 2019), `x tanh(ln(1 + exp x))`, with one exponential: for `n = exp x (exp x + 2)`, Mish is
/// `x n / (n + 2)`.
/// The derivative is computed explicitly, so that an autodiff graph holds one product instead of six functions.
///
/// # Shapes
/// Maps `[…]` to the same shape.
pub fn mish<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    if has_kernels(&x) {
        return with_kernels(x, functions::mish, functions::mish_tangent);
    }
    let inner = x.clone().inner();
    // Above 20 the function equals x in single precision; the bound keeps the square of the exponential finite.
    let exponential = inner.clone().clamp_max(20.0).exp();
    let n = exponential.clone() * (exponential.clone() + 2.0);
    let tanh = n.clone() / (n + 2.0);
    let value = inner.clone() * tanh.clone();
    if !x.is_autodiff() {
        return value;
    }
    let sigmoid = exponential.clone() / (exponential + 1.0);
    let derivative = tanh.clone() + inner * sigmoid * (tanh.square().neg() + 1.0);
    with_derivative(x, value, derivative)
}

/// SimNorm (Lavoie et al. 2023): a softmax over every `simplex` elements of a row.
///
/// # Shapes
/// Maps `[rows, width]` to the same shape.
pub fn sim_norm(x: Tensor<2>, simplex: usize) -> Tensor<2> {
    let [rows, width] = x.dims();
    activation::softmax(x.reshape([rows, width / simplex, simplex]), 2).reshape([rows, width])
}
