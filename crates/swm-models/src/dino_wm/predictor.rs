//! The predictor: a transformer over the patches of a window of frames, in which a patch sees all patches of its own
//! frame and of those before it.

use crate::nn::{Activation, DropoutRng, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::{Device, Tensor, TensorData, activation};
use serde::{Deserialize, Serialize};

/// The size of a [`FramePredictor`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FramePredictorConfig {
    /// Frames it sees: the present one and those before it.
    pub history: usize,
    /// Layers.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// Features of a head.
    pub dim_head: usize,
    /// Hidden features of the feed-forward part.
    pub mlp: usize,
    /// Dropout inside the layers.
    pub dropout: f32,
    /// Dropout of the patches that go in.
    pub emb_dropout: f32,
}

/// Predicts the patches of the next frame after each of a window of frames.
#[derive(Module, Debug)]
pub struct FramePredictor {
    /// `[1, history * patches, dim]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// The layers.
    pub transformer: Transformer,
    #[module(skip)]
    config: FramePredictorConfig,
    patches: usize,
}

/// The layers of a [`FramePredictor`].
#[derive(Module, Debug)]
pub struct Transformer {
    /// The last normalisation.
    pub norm: LayerNorm,
    /// In order.
    pub layers: Vec<Layer>,
}

/// One layer: attention, then feed-forward, each added to what goes in.
#[derive(Module, Debug)]
pub struct Layer {
    /// Self-attention.
    pub _0: Attention,
    /// The feed-forward part.
    pub _1: FeedForward,
}

/// Self-attention on normalised tokens.
#[derive(Module, Debug)]
pub struct Attention {
    /// On what comes in.
    pub norm: LayerNorm,
    /// Queries, keys and values in one layer.
    pub to_qkv: Linear,
    /// What comes out; absent for a single head of the tokens' size.
    pub to_out: Option<AttentionOut>,
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

impl FramePredictorConfig {
    /// A predictor of frames of `patches` patches of `dim` features.
    pub fn init(&self, init: &Init, patches: usize, dim: usize) -> FramePredictor {
        let inner = self.heads * self.dim_head;
        let layer = |index| {
            let init = init.of("layer").at(index);
            Layer {
                _0: Attention {
                    norm: LayerNorm::new(&init, dim, EPSILON),
                    to_qkv: Linear::without_bias(&init.of("to_qkv"), dim, 3 * inner),
                    to_out: (self.heads != 1 || self.dim_head != dim)
                        .then(|| AttentionOut { _0: Linear::new(&init.of("to_out"), inner, dim) }),
                },
                _1: FeedForward {
                    net: FeedForwardNet {
                        _0: LayerNorm::new(&init, dim, EPSILON),
                        _1: Linear::new(&init.of("mlp.1"), dim, self.mlp),
                        _4: Linear::new(&init.of("mlp.4"), self.mlp, dim),
                    },
                },
            }
        };
        FramePredictor {
            pos_embedding: init.normal("pos_embedding", [1, self.history * patches, dim], 1.0),
            transformer: Transformer {
                norm: LayerNorm::new(init, dim, EPSILON),
                layers: (0..self.depth).map(layer).collect(),
            },
            config: self.clone(),
            patches,
        }
    }
}

impl FramePredictor {
    /// The size.
    pub fn config(&self) -> &FramePredictorConfig {
        &self.config
    }

    /// Patches of a frame.
    pub fn patches(&self) -> usize {
        self.patches
    }

    /// # Shapes
    /// `[windows, frames * patches, dim]`, `frames` at most the history, to the same.
    pub fn forward(&self, x: Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let [_, tokens, dim] = x.dims();
        let x = x + self.pos_embedding.val().slice([0..1, 0..tokens, 0..dim]);
        let mut x = noise.dropout(x, self.config.emb_dropout);
        let mask = (tokens > self.patches).then(|| mask(tokens, self.patches, &x.device()));
        for Layer { _0: attention, _1: feed } in &self.transformer.layers {
            x = x.clone() + attention.forward(x, mask.clone(), &self.config, noise);
            x = x.clone() + feed.forward(x, &self.config, noise);
        }
        self.transformer.norm.forward(x)
    }
}

/// Minus infinity where a token is of a later frame than the one that looks, else 0: `[1, 1, tokens, tokens]`.
fn mask(tokens: usize, patches: usize, device: &Device) -> Tensor<4> {
    let unseen = |place: usize| (place % tokens) / patches > (place / tokens) / patches;
    let mask: Vec<f32> = (0..tokens * tokens).map(|i| if unseen(i) { f32::NEG_INFINITY } else { 0.0 }).collect();
    Tensor::from_data(TensorData::new(mask, [1, 1, tokens, tokens]), device)
}

impl Attention {
    #[allow(clippy::cast_precision_loss)]
    fn forward(
        &self,
        x: Tensor<3>,
        mask: Option<Tensor<4>>,
        config: &FramePredictorConfig,
        noise: &mut DropoutRng<'_>,
    ) -> Tensor<3> {
        let [windows, tokens, _] = x.dims();
        let (heads, width) = (config.heads, config.dim_head);
        let inner = heads * width;
        let qkv = self.to_qkv.forward(self.norm.forward(x));
        let split = |i: usize| {
            let part = qkv.clone().slice([0..windows, 0..tokens, i * inner..(i + 1) * inner]);
            part.reshape([windows, tokens, heads, width]).swap_dims(1, 2)
        };
        let mut scores = split(0).matmul(split(1).transpose()) / (width as f64).sqrt();
        if let Some(mask) = mask {
            scores = scores + mask;
        }
        let weights = noise.dropout(activation::softmax(scores, 3), config.dropout);
        let mixed = weights.matmul(split(2)).swap_dims(1, 2).reshape([windows, tokens, inner]);
        match &self.to_out {
            Some(out) => noise.dropout(out._0.forward(mixed), config.dropout),
            None => mixed,
        }
    }
}

impl FeedForward {
    fn forward(&self, x: Tensor<3>, config: &FramePredictorConfig, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let hidden = Activation::Gelu.forward(self.net._1.forward(self.net._0.forward(x)));
        let hidden = noise.dropout(hidden, config.dropout);
        noise.dropout(self.net._4.forward(hidden), config.dropout)
    }
}
