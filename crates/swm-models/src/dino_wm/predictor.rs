//! [`FramePredictor`]: a transformer over the patches of a window of frames, in which a patch attends to all patches of
//! its own frame and of earlier frames.

use crate::nn::attention::causal_mask;
use crate::nn::{DropoutRng, FeedForward, Init, LayerNorm, SelfAttention};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The configuration of a [`FramePredictor`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FramePredictorConfig {
    /// Number of input frames, including the current frame.
    pub history: usize,
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

/// A transformer that predicts, for each frame of a window, the patches of the following frame.
#[derive(Module, Debug)]
pub struct FramePredictor {
    /// Position embeddings of the patches, `[1, history * patches, dim]`.
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
    /// The normalisation after the last layer.
    pub norm: LayerNorm,
    /// The layers, first to last.
    pub layers: Vec<Layer>,
}

/// One layer: attention, then a feed-forward block, each with a residual connection. The parameters of field `_0` are
/// stored under the name `0`.
#[derive(Module, Debug)]
pub struct Layer {
    /// Self-attention.
    pub _0: SelfAttention,
    /// The feed-forward block.
    pub _1: FeedForward,
}

/// The value that the last normalisation adds to the variance.
const EPSILON: f64 = 1e-5;

impl FramePredictorConfig {
    /// Creates a predictor of frames with `patches` patches of `dim` features.
    pub fn init(&self, init: &Init, patches: usize, dim: usize) -> FramePredictor {
        let layer = |index| {
            let init = init.of("layer").at(index);
            Layer {
                _0: SelfAttention::new(&init, dim, [self.heads, self.dim_head], self.dropout),
                _1: FeedForward::new(&init, dim, self.mlp, self.dropout),
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
    /// Returns the configuration.
    pub fn config(&self) -> &FramePredictorConfig {
        &self.config
    }

    /// Returns the number of patches of a frame.
    pub fn patches(&self) -> usize {
        self.patches
    }

    /// Predicts the patches of the frame after each frame of a window.
    ///
    /// # Shapes
    /// Maps `[windows, frames * patches, dim]`, with `frames` at most the history, to the same shape.
    pub fn forward(&self, x: Tensor<3>, rng: &mut DropoutRng<'_>) -> Tensor<3> {
        let [_, tokens, dim] = x.dims();
        let x = x + self.pos_embedding.val().slice([0..1, 0..tokens, 0..dim]);
        let mut x = rng.dropout(x, self.config.emb_dropout);
        let frames = tokens / self.patches;
        let mask = (frames > 1).then(|| causal_mask([tokens, tokens], frames, &x.device()));
        for Layer { _0: attention, _1: feed_forward } in &self.transformer.layers {
            x = x.clone() + attention.forward(x, mask.clone(), rng);
            x = x.clone() + feed_forward.forward(x, rng);
        }
        self.transformer.norm.forward(x)
    }
}
