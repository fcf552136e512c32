//! A transformer over the patches of a few frames that looks at the patches of a goal, and says one thing a frame.
//!
//! Layers take turns: patches attend to the patches of their own and earlier frames, then to those of the goal. What a
//! frame amounts to is gathered at the end, by a last layer in which one learnt token a frame attends to the patches up to
//! that frame, or by the mean of its patches.

use crate::nn::{Activation, DropoutRng, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};

/// The size of a transformer, and so of a head that stands on one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TransformerConfig {
    /// Layers.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// Features of an attention head.
    pub dim_head: usize,
    /// Hidden features of the feed-forward part.
    pub mlp: usize,
    /// Dropout inside the layers.
    pub dropout: f32,
    /// Dropout of the patches that go in.
    pub emb_dropout: f32,
}

/// How the patches of a frame become one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pool {
    /// The last layer's tokens attend to them: as published for policies.
    Attention,
    /// Their mean: as published for values.
    Mean,
}

/// What one transformer looks at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sight {
    /// Frames, at most.
    pub frames: usize,
    /// Patches of a frame.
    pub patches: usize,
    /// Features of a patch.
    pub dim: usize,
}

/// The layers.
#[derive(Module, Debug)]
pub struct Transformer {
    /// The last normalisation.
    pub norm: LayerNorm,
    /// In order.
    pub layers: Vec<Layer>,
    #[module(skip)]
    pool: Pool,
    #[module(skip)]
    patches: usize,
}

/// Attention, then feed-forward. A field `_0` is number 0 of a sequence.
#[derive(Module, Debug)]
pub struct Layer {
    /// The attention.
    pub _0: Attention,
    /// The feed-forward part.
    pub _1: FeedForward,
}

/// What the queries and the keys of an [`Attention`] are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Role {
    /// Patches look at patches of their own and earlier frames.
    Past,
    /// Patches look at the goal.
    Goal,
    /// A token a frame looks at patches of that and earlier frames.
    Gather,
}

/// Attention with its normalisations in front.
#[derive(Module, Debug)]
pub struct Attention {
    /// Of the patches.
    pub norm: LayerNorm,
    /// Of the goal's patches, where they are looked at.
    pub norm_c: Option<LayerNorm>,
    /// Queries.
    pub to_q: Linear,
    /// Keys, then values, in one layer.
    pub to_kv: Linear,
    /// What comes out; absent for a single head of the patches' size.
    pub to_out: Option<AttentionOut>,
    /// `[1, frames, dim]`, the queries of a layer that gathers.
    pub frame_tokens: Option<Param<Tensor<3>>>,
    #[module(skip)]
    role: Role,
    #[module(skip)]
    patches: usize,
    #[module(skip)]
    size: TransformerConfig,
}

/// What comes out of an [`Attention`].
#[derive(Module, Debug)]
pub struct AttentionOut {
    /// The layer.
    pub _0: Linear,
}

/// Normalisation, linear, GELU, linear.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// The sequence.
    pub net: FeedForwardNet,
    dropout: f32,
}

/// The sequence of a [`FeedForward`].
#[derive(Module, Debug)]
pub struct FeedForwardNet {
    /// Normalises.
    pub _0: LayerNorm,
    /// Into the hidden features.
    pub _1: Linear,
    /// Out of them.
    pub _4: Linear,
}

/// What the normalisations add to the variance.
const EPSILON: f64 = 1e-5;
/// The spread of the tokens that gather.
const TOKEN_STD: f32 = 0.02;

impl TransformerConfig {
    /// A transformer.
    pub fn init(&self, init: &Init, sight: Sight, pool: Pool) -> Transformer {
        let layer = |index| {
            let init = init.of("layer").at(index);
            let role = match pool {
                Pool::Attention if index + 1 == self.depth => Role::Gather,
                _ if index % 2 == 0 => Role::Past,
                _ => Role::Goal,
            };
            Layer { _0: self.attention(&init, sight, role), _1: self.feed_forward(&init, sight.dim) }
        };
        Transformer {
            norm: LayerNorm::new(init, sight.dim, EPSILON),
            layers: (0..self.depth).map(layer).collect(),
            pool,
            patches: sight.patches,
        }
    }

    fn attention(&self, init: &Init, sight: Sight, role: Role) -> Attention {
        let (Sight { frames, patches, dim }, inner) = (sight, self.heads * self.dim_head);
        Attention {
            norm: LayerNorm::new(init, dim, EPSILON),
            norm_c: (role == Role::Goal).then(|| LayerNorm::new(init, dim, EPSILON)),
            to_q: Linear::without_bias(&init.of("to_q"), dim, inner),
            to_kv: Linear::without_bias(&init.of("to_kv"), dim, 2 * inner),
            to_out: (self.heads != 1 || self.dim_head != dim)
                .then(|| AttentionOut { _0: Linear::new(&init.of("to_out"), inner, dim) }),
            frame_tokens: (role == Role::Gather).then(|| init.normal("frame_tokens", [1, frames, dim], TOKEN_STD)),
            role,
            patches,
            size: self.clone(),
        }
    }

    fn feed_forward(&self, init: &Init, dim: usize) -> FeedForward {
        let net = FeedForwardNet {
            _0: LayerNorm::new(init, dim, EPSILON),
            _1: Linear::new(&init.of("mlp.1"), dim, self.mlp),
            _4: Linear::new(&init.of("mlp.4"), self.mlp, dim),
        };
        FeedForward { net, dropout: self.dropout }
    }
}

impl Transformer {
    /// # Shapes
    /// Frames `[rows, frames * patches, dim]` and a goal `[rows, patches, dim]` to `[rows, frames, dim]`.
    pub fn forward(&self, frames: Tensor<3>, goal: &Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let mut x = frames;
        for layer in &self.layers {
            let mixed = layer._0.forward(x.clone(), goal, noise);
            // What is gathered has another shape than what it was gathered from.
            if layer._0.role == Role::Gather {
                x = layer._1.forward(mixed, noise);
            } else {
                x = mixed + x;
                x = layer._1.forward(x.clone(), noise) + x;
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
    #[allow(clippy::cast_precision_loss)]
    fn forward(&self, x: Tensor<3>, goal: &Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let [rows, tokens, dim] = x.dims();
        let x = self.norm.forward(x);
        let (asking, asked) = match (&self.frame_tokens, &self.norm_c) {
            (Some(token), _) => {
                let frames = tokens / self.patches;
                (token.val().slice([0..1, 0..frames, 0..dim]).expand([rows, frames, dim]), x)
            }
            (None, Some(norm)) => (x, norm.forward(goal.clone())),
            (None, None) => (x.clone(), x),
        };
        let ([_, queries, _], [_, keys, _]) = (asking.dims(), asked.dims());
        let TransformerConfig { heads, dim_head, dropout, .. } = self.size;
        let inner = heads * dim_head;
        let both = self.to_kv.forward(asked);
        let part = |i: usize| both.clone().slice([0..rows, 0..keys, i * inner..(i + 1) * inner]);
        let mixed = if keys == 1 {
            // All attention goes to what alone is there.
            part(1).expand([rows, queries, inner])
        } else {
            let split = |x: Tensor<3>, count| x.reshape([rows, count, heads, dim_head]).swap_dims(1, 2);
            let query = split(self.to_q.forward(asking), queries);
            let mut scores = query.matmul(split(part(0), keys).transpose()) / (dim_head as f64).sqrt();
            if self.role != Role::Goal && keys > self.patches {
                scores = scores.clone() + self.future(queries, keys, &scores);
            }
            let weights = noise.dropout(activation::softmax(scores, 3), dropout);
            weights.matmul(split(part(1), keys)).swap_dims(1, 2).reshape([rows, queries, inner])
        };
        match &self.to_out {
            Some(out) => noise.dropout(out._0.forward(mixed), dropout),
            None => mixed,
        }
    }

    /// Minus infinity where a query would look at a later frame, `[1, 1, queries, keys]`.
    fn future(&self, queries: usize, keys: usize, like: &Tensor<4>) -> Tensor<4> {
        // Queries are as many a frame as patches, or one a frame.
        let frames = keys / self.patches;
        let frame = |query: usize| query * frames / queries;
        let mask: Vec<f32> = (0..queries * keys)
            .map(|i| if i % keys / self.patches > frame(i / keys) { f32::NEG_INFINITY } else { 0.0 })
            .collect();
        Tensor::from_data(TensorData::new(mask, [1, 1, queries, keys]), &like.device())
    }
}

impl FeedForward {
    fn forward(&self, x: Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let hidden = Activation::Gelu.forward(self.net._1.forward(self.net._0.forward(x)));
        let hidden = noise.dropout(hidden, self.dropout);
        noise.dropout(self.net._4.forward(hidden), self.dropout)
    }
}
