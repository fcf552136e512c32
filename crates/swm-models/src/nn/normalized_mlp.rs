//! The networks of TD-MPC2 (Hansen, Su and Wang 2024, arXiv 2310.16828): every hidden layer is linear, normalised, and goes
//! through Mish; latents are simplices.

use super::norm::standardize;
use super::{DropoutRng, Init, LayerNorm, Linear, with_derivative};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, activation};

/// The number added to the variance.
const EPSILON: f64 = 1e-5;
/// The standard deviation of initial weights, cut off at two of them.
const STD: f32 = 0.02;

/// A linear layer and the normalisation behind it.
#[derive(Module, Debug)]
pub struct NormalizedLinear {
    /// `[outputs, inputs]`.
    pub weight: Param<Tensor<2>>,
    /// `[outputs]`.
    pub bias: Param<Tensor<1>>,
    /// The normalisation.
    pub ln: LayerNorm,
}

impl NormalizedLinear {
    /// A layer.
    pub fn new(init: &Init, inputs: usize, outputs: usize) -> Self {
        Self {
            weight: init.normal("weight", [outputs, inputs], STD),
            bias: init.constant([outputs], 0.0),
            ln: LayerNorm::new(&init.of("ln"), outputs, EPSILON),
        }
    }

    /// What goes into the nonlinearity: `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self.ln.forward(x.matmul(self.weight.val().transpose()) + self.bias.val().unsqueeze())
    }
}

/// Two hidden layers and a linear read-out. A field `_2` is number 2 of a sequence, as in PyTorch.
#[derive(Module, Debug)]
pub struct Head {
    /// Into hidden features.
    pub _0: NormalizedLinear,
    /// From hidden features to hidden features.
    pub _1: NormalizedLinear,
    /// Out of them.
    pub _2: Linear,
}

impl Head {
    /// A head.
    pub fn new(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        Self {
            _0: NormalizedLinear::new(&init.of("0"), inputs, hidden),
            _1: NormalizedLinear::new(&init.of("1"), hidden, hidden),
            _2: Linear::normal(&init.of("2"), hidden, outputs, STD),
        }
    }

    /// A head whose read-out is 0 until trained.
    pub fn zero_initialized(init: &Init, inputs: usize, hidden: usize, outputs: usize) -> Self {
        let mut head = Self::new(init, inputs, hidden, outputs);
        head._2 = Linear::zeros(init, hidden, outputs);
        head
    }

    /// `[rows, inputs]` to `[rows, outputs]`.
    pub fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        self._2.forward(mish(self._1.forward(mish(self._0.forward(x)))))
    }
}

/// Two hidden layers and a third that ends in a latent.
#[derive(Module, Debug)]
pub struct Dynamics {
    /// Into hidden features.
    pub _0: NormalizedLinear,
    /// From hidden features to hidden features.
    pub _1: NormalizedLinear,
    /// To what becomes a latent.
    pub _2: NormalizedLinear,
}

impl Dynamics {
    /// Dynamics.
    pub fn new(init: &Init, inputs: usize, hidden: usize, latent: usize) -> Self {
        Self {
            _0: NormalizedLinear::new(&init.of("0"), inputs, hidden),
            _1: NormalizedLinear::new(&init.of("1"), hidden, hidden),
            _2: NormalizedLinear::new(&init.of("2"), hidden, latent),
        }
    }

    /// `[rows, inputs]` to `[rows, latent]`; `simplex` numbers of a latent add up to 1.
    pub fn forward(&self, x: Tensor<2>, simplex: usize) -> Tensor<2> {
        let hidden = mish(self._1.forward(mish(self._0.forward(x))));
        sim_norm(self._2.forward(hidden), simplex)
    }
}

/// Several heads of equal sizes side by side: a matrix product is one for all of them.
pub struct Ensemble {
    layers: [Layer; 3],
}

/// The same layer of every head: `[heads, inputs, outputs]` and rows of `[heads, 1, outputs]`.
struct Layer {
    weight: Tensor<3>,
    bias: Option<Tensor<3>>,
    norm: Option<[Tensor<3>; 2]>,
}

impl Ensemble {
    /// These heads; gradients flow back to them.
    pub fn of(heads: &[&Head]) -> Self {
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
        Self { layers: [hidden(|head| &head._0), hidden(|head| &head._1), last] }
    }

    /// The same heads as constants of a graph: gradients flow through them, not to them.
    #[must_use]
    pub fn frozen(mut self) -> Self {
        let still = |tensor: &mut Tensor<3>| *tensor = tensor.clone().inner().autodiff();
        for Layer { weight, bias, norm } in &mut self.layers {
            still(weight);
            bias.iter_mut().chain(norm.iter_mut().flatten()).for_each(still);
        }
        self
    }

    /// `[rows, inputs]` to `[heads, rows, outputs]`; `dropout` is the rate behind the first product.
    pub fn forward(&self, x: Tensor<2>, dropout: f32, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let [first, second, last] = &self.layers;
        let [heads, _, _] = first.weight.dims();
        let [rows, inputs] = x.dims();
        let x = x.unsqueeze_dim::<3>(0).expand([heads, rows, inputs]);
        let x = noise.dropout(first.product(x), dropout);
        let x = mish(first.normalise(x));
        let x = mish(second.normalise(second.product(x)));
        last.product(x)
    }
}

/// The matrices of several heads, `[heads, inputs, outputs]`.
fn matrices<'a>(parameters: impl Iterator<Item = &'a Param<Tensor<2>>>) -> Tensor<3> {
    Tensor::stack::<3>(parameters.map(Param::val).collect(), 0).swap_dims(1, 2)
}

/// The vectors of several heads, `[heads, 1, outputs]`, where they have them.
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

/// `x tanh(ln(1 + exp x))`, by one exponential: with `n = exp x (exp x + 2)` it is `x n / (n + 2)`. Its derivative is written
/// down, so that a graph holds one product and not six functions.
pub fn mish<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    let inner = x.clone().inner();
    // Above 20 it is x in single precision, and the square of the exponential still a number.
    let exponential = inner.clone().clamp_max(20.0).exp();
    let n = exponential.clone() * (exponential.clone() + 2.0);
    let tanh = n.clone() / (n + 2.0);
    let value = inner.clone() * tanh.clone();
    if !x.is_autodiff() {
        return value;
    }
    let sigmoid = exponential.clone() / (exponential + 1.0);
    let slope = tanh.clone() + inner * sigmoid * (tanh.square().neg() + 1.0);
    with_derivative(x, value, slope)
}

/// Every `simplex` numbers of a row become weights that add up to 1 (SimNorm).
pub fn sim_norm(x: Tensor<2>, simplex: usize) -> Tensor<2> {
    let [rows, width] = x.dims();
    activation::softmax(x.reshape([rows, width / simplex, simplex]), 2).reshape([rows, width])
}
