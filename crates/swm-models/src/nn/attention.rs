//! Multi-head attention and the feed-forward block of transformers. Parameters have the names of the published
//! predictors.

use super::{Activation, DropoutRng, Init, LayerNorm, Linear};
use crate::device::matmul;
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData, activation};

/// The value that the layer normalisations add to the variance.
const EPSILON: f64 = 1e-5;

/// Computes scaled dot-product attention with `heads` heads, `softmax(Q Kᵀ / √d + mask) V` (Vaswani et al. 2017,
/// equation 1), with dropout of the attention weights.
///
/// # Shapes
/// `query` is `[rows, queries, heads * d]`, `key` and `value` are `[rows, keys, heads * d]`, `mask` is
/// `[1, 1, queries, keys]`; returns `[rows, queries, heads * d]`.
pub fn attend(
    [query, key, value]: [Tensor<3>; 3],
    heads: usize,
    mask: Option<Tensor<4>>,
    dropout: f32,
    rng: &mut DropoutRng<'_>,
) -> Tensor<3> {
    let ([rows, queries, inner], [_, keys, _]) = (query.dims(), key.dims());
    let width = inner / heads;
    let split = |x: Tensor<3>, tokens| x.reshape([rows, tokens, heads, width]).swap_dims(1, 2);
    let mut scores = matmul(split(query, queries), split(key, keys).transpose()) / (width as f64).sqrt();
    if let Some(mask) = mask {
        scores = scores + mask;
    }
    let weights = rng.dropout(activation::softmax(scores, 3), dropout);
    matmul(weights, split(value, keys)).swap_dims(1, 2).reshape([rows, queries, inner])
}

/// Returns the additive mask of causal attention over `frames` frames: minus infinity if the key belongs to a later
/// frame than the query, otherwise 0. The numbers of queries and of keys are multiples of `frames`.
///
/// # Shapes
/// Returns `[1, 1, queries, keys]`.
pub fn causal_mask([queries, keys]: [usize; 2], frames: usize, device: &Device) -> Tensor<4> {
    let is_later = |i: usize| (i % keys) * frames / keys > (i / keys) * frames / queries;
    let mask: Vec<f32> = (0..queries * keys).map(|i| if is_later(i) { f32::NEG_INFINITY } else { 0.0 }).collect();
    Tensor::from_data(TensorData::new(mask, [1, 1, queries, keys]), device)
}

/// Self-attention of normalised tokens.
#[derive(Module, Debug)]
pub struct SelfAttention {
    /// The normalisation before the attention.
    pub norm: LayerNorm,
    /// The projection to queries, keys and values.
    pub to_qkv: Linear,
    /// The output projection; `None` for a single head whose dimension equals the token dimension.
    pub to_out: Option<AttentionOutput>,
    heads: usize,
    dropout: f32,
}

/// The output projection of an attention block. The field `_0` is element 0 of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct AttentionOutput {
    /// The linear layer.
    pub _0: Linear,
}

impl AttentionOutput {
    /// Creates a projection from `heads` heads of `dim_head` features to `dim` features; returns `None` for a single
    /// head with `dim_head == dim`.
    pub(crate) fn new(init: &Init, [heads, dim_head]: [usize; 2], dim: usize) -> Option<Self> {
        (heads != 1 || dim_head != dim).then(|| Self { _0: Linear::new(&init.of("to_out"), heads * dim_head, dim) })
    }

    /// Applies the projection and dropout if `output` is present; otherwise returns `x`.
    ///
    /// # Shapes
    /// Maps `[rows, tokens, heads * dim_head]` to `[rows, tokens, dim]`.
    pub(crate) fn apply(output: Option<&Self>, x: Tensor<3>, dropout: f32, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        match output {
            Some(output) => rng.dropout(output._0.forward(x), dropout),
            None => x,
        }
    }
}

impl SelfAttention {
    /// Creates self-attention for tokens with `dim` features.
    pub(crate) fn new(init: &Init, dim: usize, [heads, dim_head]: [usize; 2], dropout: f32) -> Self {
        Self {
            norm: LayerNorm::new(init, dim, EPSILON),
            to_qkv: Linear::without_bias(&init.of("to_qkv"), dim, 3 * heads * dim_head),
            to_out: AttentionOutput::new(init, [heads, dim_head], dim),
            heads,
            dropout,
        }
    }

    /// Computes attention between the tokens of each window.
    ///
    /// # Shapes
    /// `x` is `[windows, tokens, dim]`, `mask` is `[1, 1, tokens, tokens]`; returns `[windows, tokens, dim]`.
    pub(crate) fn forward(&self, x: Tensor<3>, mask: Option<Tensor<4>>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let qkv = self.to_qkv.forward(self.norm.forward(x));
        let mixed = attend([0, 1, 2].map(|part| third(&qkv, part)), self.heads, mask, self.dropout, rng);
        AttentionOutput::apply(self.to_out.as_ref(), mixed, self.dropout, rng)
    }

    /// Computes attention in windows of one token, where the output is the projected value. Applies no dropout to the
    /// attention weights.
    ///
    /// # Shapes
    /// Maps `[windows, 1, dim]` to the same shape.
    pub(crate) fn forward_single(&self, x: Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let qkv = self.to_qkv.forward(self.norm.forward(x));
        AttentionOutput::apply(self.to_out.as_ref(), third(&qkv, 2), self.dropout, rng)
    }
}

/// Returns the queries (`part` 0), keys (1) or values (2) of a joint projection.
///
/// # Shapes
/// Maps `[windows, tokens, 3 * inner]` to `[windows, tokens, inner]`.
fn third(qkv: &Tensor<3>, part: usize) -> Tensor<3> {
    let [windows, tokens, features] = qkv.dims();
    let inner = features / 3;
    qkv.clone().slice([0..windows, 0..tokens, part * inner..(part + 1) * inner])
}

/// A feed-forward block: normalisation, linear, GELU, linear, with dropout after GELU and after the last layer.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// The layers.
    pub net: FeedForwardNet,
    dropout: f32,
}

/// The layers of a [`FeedForward`] block. A field `_i` is element i of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct FeedForwardNet {
    /// The layer normalisation.
    pub _0: LayerNorm,
    /// The linear layer to the hidden features.
    pub _1: Linear,
    /// The linear layer from the hidden features.
    pub _4: Linear,
}

impl FeedForward {
    /// Creates a block for tokens with `dim` features and `hidden` hidden features.
    pub(crate) fn new(init: &Init, dim: usize, hidden: usize, dropout: f32) -> Self {
        Self {
            net: FeedForwardNet {
                _0: LayerNorm::new(init, dim, EPSILON),
                _1: Linear::new(&init.of("mlp.1"), dim, hidden),
                _4: Linear::new(&init.of("mlp.4"), hidden, dim),
            },
            dropout,
        }
    }

    /// Applies the block.
    ///
    /// # Shapes
    /// Maps `[rows, tokens, dim]` to the same shape.
    pub(crate) fn forward(&self, x: Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let hidden = Activation::Gelu.forward(self.net._1.forward(self.net._0.forward(x)));
        let hidden = rng.dropout(hidden, self.dropout);
        rng.dropout(self.net._4.forward(hidden), self.dropout)
    }
}
