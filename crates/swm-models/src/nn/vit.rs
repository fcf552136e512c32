//! A vision transformer (Dosovitskiy et al. 2021, pre-norm, class token, learned positions), named as the
//! published checkpoints name it.

use super::{Activation, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::{Tensor, activation};
use serde::{Deserialize, Serialize};

/// The size of a [`Vit`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VitConfig {
    /// Side of a patch, in pixels.
    pub patch: usize,
    /// Features of a token.
    pub dim: usize,
    /// Layers.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// Hidden features of the feed-forward part.
    pub mlp: usize,
}

/// A vision transformer that returns its class token.
#[derive(Module, Debug)]
pub struct Vit {
    /// Patches, class token and positions.
    pub embeddings: Embeddings,
    /// The layers.
    pub encoder: Layers,
    /// The last normalisation.
    pub layernorm: LayerNorm,
}

/// Patches, class token and positions.
#[derive(Module, Debug)]
pub struct Embeddings {
    /// `[1, 1, dim]`.
    pub cls_token: Param<Tensor<3>>,
    /// `[1, 1 + patches, dim]`.
    pub position_embeddings: Param<Tensor<3>>,
    /// From pixels to tokens.
    pub patch_embeddings: Patches,
}

/// From pixels to tokens.
#[derive(Module, Debug)]
pub struct Patches {
    /// A convolution whose stride is its kernel.
    pub projection: Projection,
}

/// A convolution whose stride is its kernel: one matrix product over patches.
#[derive(Module, Debug)]
pub struct Projection {
    /// `[dim, 3, patch, patch]`.
    pub weight: Param<Tensor<4>>,
    /// `[dim]`.
    pub bias: Param<Tensor<1>>,
}

impl Projection {
    /// A projection drawn from a normal distribution.
    pub fn new(init: &Init, channels: usize, patch: usize, dim: usize, std: f32) -> Self {
        Self { weight: init.normal("weight", [dim, channels, patch, patch], std), bias: init.constant([dim], 0.0) }
    }

    /// # Shapes
    /// `[rows, channels * patch * patch]` (channel, then row, then column) to `[rows, dim]`.
    pub fn forward(&self, patches: Tensor<2>) -> Tensor<2> {
        let [dim, channels, height, width] = self.weight.dims();
        let weight = self.weight.val().reshape([dim, channels * height * width]);
        patches.matmul(weight.transpose()) + self.bias.val().unsqueeze()
    }
}

/// The layers of a [`Vit`].
#[derive(Module, Debug)]
pub struct Layers {
    /// In order.
    pub layer: Vec<Layer>,
}

/// One layer: attention, then feed-forward, each on normalised tokens and added to them.
#[derive(Module, Debug)]
pub struct Layer {
    /// Before the attention.
    pub layernorm_before: LayerNorm,
    /// Self-attention.
    pub attention: Attention,
    /// Before the feed-forward part.
    pub layernorm_after: LayerNorm,
    /// Into the hidden features.
    pub intermediate: Dense,
    /// Out of them.
    pub output: Dense,
}

/// Self-attention of a [`Layer`].
#[derive(Module, Debug)]
pub struct Attention {
    /// Queries, keys and values.
    pub attention: Qkv,
    /// What comes out.
    pub output: Dense,
    heads: usize,
}

/// Queries, keys and values.
#[derive(Module, Debug)]
pub struct Qkv {
    /// Queries.
    pub query: Linear,
    /// Keys.
    pub key: Linear,
    /// Values.
    pub value: Linear,
}

/// A linear layer under the name `dense`.
#[derive(Module, Debug)]
pub struct Dense {
    /// The layer.
    pub dense: Linear,
}

/// The spread of initial weights.
const STD: f32 = 0.02;
/// What the layer normalisations add to the variance.
const EPSILON: f64 = 1e-12;

impl VitConfig {
    /// A transformer for square pictures of `image` pixels.
    pub fn init(&self, init: &Init, image: usize) -> Vit {
        let (dim, tokens) = (self.dim, (image / self.patch).pow(2));
        let dense =
            |init: &Init, inputs, outputs| Dense { dense: Linear::normal(&init.of("dense"), inputs, outputs, STD) };
        let layer = |index| {
            let init = init.of("layer").at(index);
            let part = |name| Linear::normal(&init.of(name), dim, dim, STD);
            Layer {
                layernorm_before: LayerNorm::new(&init, dim, EPSILON),
                attention: Attention {
                    attention: Qkv { query: part("query"), key: part("key"), value: part("value") },
                    output: dense(&init.of("attention"), dim, dim),
                    heads: self.heads,
                },
                layernorm_after: LayerNorm::new(&init, dim, EPSILON),
                intermediate: dense(&init.of("intermediate"), dim, self.mlp),
                output: dense(&init.of("output"), self.mlp, dim),
            }
        };
        Vit {
            embeddings: Embeddings {
                cls_token: init.normal("cls_token", [1, 1, dim], STD),
                position_embeddings: init.normal("position_embeddings", [1, 1 + tokens, dim], STD),
                patch_embeddings: Patches { projection: Projection::new(&init.of("patch"), 3, self.patch, dim, STD) },
            },
            encoder: Layers { layer: (0..self.depth).map(layer).collect() },
            layernorm: LayerNorm::new(init, dim, EPSILON),
        }
    }
}

impl Vit {
    /// # Shapes
    /// `[frames, patches, 3 * patch * patch]` to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let [frames, count, numbers] = patches.dims();
        let [_, _, dim] = self.embeddings.cls_token.dims();
        let tokens = self.embeddings.patch_embeddings.projection.forward(patches.reshape([frames * count, numbers]));
        let class = self.embeddings.cls_token.val().expand([frames, 1, dim]);
        let mut tokens = Tensor::cat(vec![class, tokens.reshape([frames, count, dim])], 1)
            + self.embeddings.position_embeddings.val();
        for layer in &self.encoder.layer {
            tokens = layer.forward(tokens);
        }
        self.layernorm.forward(tokens.slice([0..frames, 0..1, 0..dim])).reshape([frames, dim])
    }
}

impl Layer {
    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let x = x.clone() + self.attention.forward(self.layernorm_before.forward(x));
        let hidden = self.intermediate.dense.forward(self.layernorm_after.forward(x.clone()));
        x + self.output.dense.forward(Activation::Gelu.forward(hidden))
    }
}

impl Attention {
    #[allow(clippy::cast_precision_loss)]
    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let [frames, tokens, dim] = x.dims();
        let width = dim / self.heads;
        let split =
            |layer: &Linear| layer.forward(x.clone()).reshape([frames, tokens, self.heads, width]).swap_dims(1, 2);
        let (query, key, value) =
            (split(&self.attention.query), split(&self.attention.key), split(&self.attention.value));
        let scores = query.matmul(key.transpose()) / (width as f64).sqrt();
        let mixed = activation::softmax(scores, 3).matmul(value);
        self.output.dense.forward(mixed.swap_dims(1, 2).reshape([frames, tokens, dim]))
    }
}
