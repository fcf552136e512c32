//! [`Transformer`]: a transformer over the patches of a few frames and of a goal image, with one output per frame.
//!
//! Layers alternate between causal attention among the patches of the frames and attention to the patches of the goal.
//! The output of a frame is pooled from patches: either one learnt token per frame attends, in the last layer, to the
//! patches of that frame and of earlier frames, or the output is the mean of the frame's patches.

use crate::nn::attention::{AttentionOutput, attend, causal_mask};
use crate::nn::{DropoutRng, FeedForward, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The configuration of a [`Transformer`] and of the heads that contain it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerConfig {
    /// Number of layers.
    pub depth: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Features of an attention head.
    pub dim_head: usize,
    /// Hidden features of the feed-forward blocks.
    pub mlp: usize,
    /// Dropout inside the layers.
    pub dropout: f32,
    /// Dropout of the input patches.
    pub emb_dropout: f32,
}

/// The method that pools the patches of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pool {
    /// In the last layer, a learnt token per frame attends to the patches, as published for policies.
    Attention,
    /// The mean of the patches, as published for values.
    Mean,
    /// As `Attention`, in a transformer that does not attend to a goal: all other layers are among the frames.
    SelfAttention,
}

/// The sizes of a transformer's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PatchGrid {
    /// Maximum number of frames.
    pub frames: usize,
    /// Patches of a frame.
    pub patches: usize,
    /// Features of a patch.
    pub dim: usize,
}

/// A transformer over the patches of frames and of a goal.
#[derive(Module, Debug)]
pub struct Transformer {
    /// The normalisation after the last layer.
    pub norm: LayerNorm,
    /// The layers, first to last.
    pub layers: Vec<Layer>,
    #[module(skip)]
    pool: Pool,
    #[module(skip)]
    patches: usize,
}

/// Attention, then a feed-forward block. The parameters of field `_0` are stored under the name `0`.
#[derive(Module, Debug)]
pub struct Layer {
    /// The attention block.
    pub _0: Attention,
    /// The feed-forward block.
    pub _1: FeedForward,
}

/// The queries and keys of an [`Attention`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    /// Patches attend to the patches of their own frame and of earlier frames.
    Frames,
    /// Patches attend to the patches of the goal.
    Goal,
    /// A learnt token per frame attends to the patches of that frame and of earlier frames.
    Pool,
}

/// Attention with normalised inputs.
#[derive(Module, Debug)]
pub struct Attention {
    /// The normalisation of the patches.
    pub norm: LayerNorm,
    /// The normalisation of the goal's patches, in a layer that attends to the goal.
    pub norm_c: Option<LayerNorm>,
    /// The projection to queries.
    pub to_q: Linear,
    /// The projection to keys, then values.
    pub to_kv: Linear,
    /// The output projection; absent for a single head with as many features as a patch.
    pub to_out: Option<AttentionOutput>,
    /// The learnt tokens of a pooling layer, `[1, frames, dim]`.
    pub frame_tokens: Option<Param<Tensor<3>>>,
    #[module(skip)]
    role: Role,
    #[module(skip)]
    patches: usize,
    #[module(skip)]
    config: TransformerConfig,
}

/// The value that the normalisations add to the variance.
const EPSILON: f64 = 1e-5;
/// The standard deviation of the learnt tokens' initial values.
const TOKEN_STD: f32 = 0.02;

impl TransformerConfig {
    /// Creates a transformer for inputs of the given sizes.
    pub fn init(&self, init: &Init, grid: PatchGrid, pool: Pool) -> Transformer {
        let layer = |index| {
            let init = init.of("layer").at(index);
            let role = match pool {
                Pool::Attention | Pool::SelfAttention if index + 1 == self.depth => Role::Pool,
                Pool::SelfAttention => Role::Frames,
                _ if index % 2 == 0 => Role::Frames,
                _ => Role::Goal,
            };
            Layer {
                _0: self.attention(&init, grid, role),
                _1: FeedForward::new(&init, grid.dim, self.mlp, self.dropout),
            }
        };
        Transformer {
            norm: LayerNorm::new(init, grid.dim, EPSILON),
            layers: (0..self.depth).map(layer).collect(),
            pool,
            patches: grid.patches,
        }
    }

    fn attention(&self, init: &Init, grid: PatchGrid, role: Role) -> Attention {
        let (PatchGrid { frames, patches, dim }, inner) = (grid, self.heads * self.dim_head);
        Attention {
            norm: LayerNorm::new(init, dim, EPSILON),
            norm_c: (role == Role::Goal).then(|| LayerNorm::new(init, dim, EPSILON)),
            to_q: Linear::without_bias(&init.of("to_q"), dim, inner),
            to_kv: Linear::without_bias(&init.of("to_kv"), dim, 2 * inner),
            to_out: AttentionOutput::new(init, [self.heads, self.dim_head], dim),
            frame_tokens: (role == Role::Pool).then(|| init.normal("frame_tokens", [1, frames, dim], TOKEN_STD)),
            role,
            patches,
            config: self.clone(),
        }
    }
}

impl Transformer {
    /// Computes one output per frame.
    ///
    /// # Shapes
    /// `frames` is `[rows, frames * patches, dim]`, `goal` is `[rows, patches, dim]`; returns `[rows, frames, dim]`.
    pub fn forward(&self, frames: Tensor<3>, goal: &Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let mut x = frames;
        for layer in &self.layers {
            let mixed = layer._0.forward(x.clone(), goal, rng);
            // A pooling layer has no residual connection: the output has another shape than the input.
            if layer._0.role == Role::Pool {
                x = layer._1.forward(mixed, rng);
            } else {
                x = mixed + x;
                x = layer._1.forward(x.clone(), rng) + x;
            }
        }
        if self.pool == Pool::Mean {
            let [rows, tokens, dim] = x.dims();
            let patches = x.reshape([rows, tokens / self.patches, self.patches, dim]);
            x = patches.mean_dim(2).squeeze_dim(2);
        }
        self.norm.forward(x)
    }
}

impl Attention {
    /// Applies the attention; a pooling layer returns one token per frame.
    ///
    /// # Shapes
    /// `x` is `[rows, frames * patches, dim]`, `goal` is `[rows, patches, dim]`; returns the shape of `x`, or
    /// `[rows, frames, dim]` from a pooling layer.
    fn forward(&self, x: Tensor<3>, goal: &Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let [rows, tokens, dim] = x.dims();
        let x = self.norm.forward(x);
        let (queries, context) = match (&self.frame_tokens, &self.norm_c) {
            (Some(token), _) => {
                let frames = tokens / self.patches;
                (token.val().slice([0..1, 0..frames, 0..dim]).expand([rows, frames, dim]), x)
            }
            (None, Some(norm)) => (x, norm.forward(goal.clone())),
            (None, None) => (x.clone(), x),
        };
        let ([_, count, _], [_, keys, _]) = (queries.dims(), context.dims());
        let TransformerConfig { heads, dim_head, dropout, .. } = self.config;
        let inner = heads * dim_head;
        let key_value = self.to_kv.forward(context);
        let part = |i: usize| key_value.clone().slice([0..rows, 0..keys, i * inner..(i + 1) * inner]);
        let mixed = if keys == 1 {
            // All attention goes to the only key.
            part(1).expand([rows, count, inner])
        } else {
            let query = self.to_q.forward(queries);
            let mask = (self.role != Role::Goal && keys > self.patches)
                .then(|| causal_mask([count, keys], keys / self.patches, &query.device()));
            attend([query, part(0), part(1)], heads, mask, dropout, rng)
        };
        AttentionOutput::apply(self.to_out.as_ref(), mixed, dropout, rng)
    }
}
