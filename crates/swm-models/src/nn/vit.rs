//! A vision transformer (Dosovitskiy et al. 2021: pre-norm, class token, trained position embeddings). Parameters have
//! the names of the published checkpoints. Position embeddings are interpolated for images of another size than that of
//! [`VitConfig::init`].

use super::attention::attend;
use super::positions::{Resampling, positions};
use super::{Activation, DropoutRng, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The size of a [`Vit`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VitConfig {
    /// Side of a patch, in pixels.
    pub patch: usize,
    /// The number of features of a token.
    pub dim: usize,
    /// The number of layers.
    pub depth: usize,
    /// The number of attention heads.
    pub heads: usize,
    /// The number of hidden features of the feed-forward block.
    pub mlp: usize,
}

/// A vision transformer.
#[derive(Module, Debug)]
pub struct Vit {
    /// Patch, class and position embeddings.
    pub embeddings: Embeddings,
    /// The layers.
    pub encoder: Layers,
    /// The last normalisation.
    pub layernorm: LayerNorm,
}

/// Patch, class and position embeddings.
#[derive(Module, Debug)]
pub struct Embeddings {
    /// The class token, `[1, 1, dim]`.
    pub cls_token: Param<Tensor<3>>,
    /// The position embeddings, `[1, 1 + patches, dim]`.
    pub position_embeddings: Param<Tensor<3>>,
    /// The projection of patches to tokens.
    pub patch_embeddings: Patches,
}

/// The projection of patches to tokens.
#[derive(Module, Debug)]
pub struct Patches {
    /// A convolution whose stride equals its kernel size.
    pub projection: Projection,
}

/// A convolution whose stride equals its kernel size: one matrix product over patches.
#[derive(Module, Debug)]
pub struct Projection {
    /// The weights, `[dim, channels, patch, patch]`.
    pub weight: Param<Tensor<4>>,
    /// The bias, `[dim]`.
    pub bias: Param<Tensor<1>>,
}

impl Projection {
    /// Creates a projection with normally distributed weights (standard deviation `std`) and bias 0.
    pub fn new(init: &Init, channels: usize, patch: usize, dim: usize, std: f32) -> Self {
        Self { weight: init.normal("weight", [dim, channels, patch, patch], std), bias: init.constant([dim], 0.0) }
    }

    /// Projects patches.
    ///
    /// # Shapes
    /// Maps `[rows, channels * patch * patch]` (channel, then row, then column) to `[rows, dim]`.
    pub fn forward(&self, patches: Tensor<2>) -> Tensor<2> {
        let [dim, channels, height, width] = self.weight.dims();
        let weight = self.weight.val().reshape([dim, channels * height * width]);
        patches.matmul(weight.transpose()) + self.bias.val().unsqueeze()
    }
}

/// The layers of a [`Vit`].
#[derive(Module, Debug)]
pub struct Layers {
    /// The layers, first to last.
    pub layer: Vec<Layer>,
}

/// One layer: attention, then feed-forward, each computed from normalised tokens and added to the tokens.
#[derive(Module, Debug)]
pub struct Layer {
    /// The normalisation before the attention.
    pub layernorm_before: LayerNorm,
    /// Self-attention.
    pub attention: Attention,
    /// The normalisation before the feed-forward block.
    pub layernorm_after: LayerNorm,
    /// The layer to the hidden features.
    pub intermediate: Dense,
    /// The layer from the hidden features.
    pub output: Dense,
}

/// Self-attention of a [`Layer`].
#[derive(Module, Debug)]
pub struct Attention {
    /// Queries, keys and values.
    pub attention: Qkv,
    /// The output projection.
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

/// The standard deviation of initial weights.
pub(super) const STD: f32 = 0.02;
/// The value that the layer normalisations add to the variance.
const EPSILON: f64 = 1e-12;

impl VitConfig {
    /// The config of a published size; the feed-forward block has four times the features of a token.
    const fn sized(patch: usize, dim: usize, depth: usize, heads: usize) -> Self {
        Self { patch, dim, depth, heads, mlp: 4 * dim }
    }

    /// The size of ViT-tiny.
    pub const fn tiny(patch: usize) -> Self {
        Self::sized(patch, 192, 12, 3)
    }

    /// The size of ViT-small.
    pub const fn small(patch: usize) -> Self {
        Self::sized(patch, 384, 12, 6)
    }

    /// The size of ViT-base.
    pub const fn base(patch: usize) -> Self {
        Self::sized(patch, 768, 12, 12)
    }

    /// The size of ViT-large.
    pub const fn large(patch: usize) -> Self {
        Self::sized(patch, 1024, 24, 16)
    }

    /// The size of ViT-huge.
    pub const fn huge(patch: usize) -> Self {
        Self::sized(patch, 1280, 32, 16)
    }

    /// Creates a transformer for images with a side of `image` pixels.
    pub fn init(&self, init: &Init, image: usize) -> Vit {
        let (dim, tokens) = (self.dim, (image / self.patch).pow(2));
        let dense =
            |init: &Init, inputs, outputs| Dense { dense: Linear::normal(&init.of("dense"), inputs, outputs, STD) };
        let layer = |index| {
            let init = init.of("layer").at(index);
            Layer {
                layernorm_before: LayerNorm::new(&init, dim, EPSILON),
                attention: Attention::new(&init, dim, self.heads),
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
    /// Computes the class token.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let class = self.run(patches, Some(1));
        let [frames, _, dim] = class.dims();
        class.reshape([frames, dim])
    }

    /// Computes all tokens: the class token, then one token for every patch.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, 1 + patches, dim]`.
    pub fn tokens(&self, patches: Tensor<3>) -> Tensor<3> {
        self.run(patches, None)
    }

    /// Computes the first `outputs` tokens, or all tokens for `None`. The last layer computes only the returned tokens.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, outputs, dim]`.
    fn run(&self, patches: Tensor<3>, outputs: Option<usize>) -> Tensor<3> {
        let Embeddings { cls_token, position_embeddings, patch_embeddings } = &self.embeddings;
        let projection = &patch_embeddings.projection;
        let mut tokens = embed(patches, projection, cls_token, position_embeddings, Resampling::Bicubic);
        for (index, layer) in self.encoder.layer.iter().enumerate() {
            tokens = layer.forward(tokens, outputs.filter(|_| index + 1 == self.encoder.layer.len()));
        }
        self.layernorm.forward(match outputs {
            Some(outputs) => leading(tokens, outputs),
            None => tokens,
        })
    }
}

/// Returns the first `count` tokens.
///
/// # Shapes
/// Maps `[frames, tokens, dim]` to `[frames, count, dim]`.
pub(super) fn leading(tokens: Tensor<3>, count: usize) -> Tensor<3> {
    let [frames, _, dim] = tokens.dims();
    tokens.slice([0..frames, 0..count, 0..dim])
}

/// Computes the input tokens: the class token and the projected patches, plus position embeddings, which are resampled
/// to the grid of the patches.
///
/// # Shapes
/// Maps `[frames, patches, 3 * patch * patch]` to `[frames, 1 + patches, dim]`.
pub(super) fn embed(
    patches: Tensor<3>,
    projection: &Projection,
    class: &Param<Tensor<3>>,
    trained: &Param<Tensor<3>>,
    resampling: Resampling,
) -> Tensor<3> {
    let [frames, count, width] = patches.dims();
    let [_, _, dim] = class.dims();
    let tokens = projection.forward(patches.reshape([frames * count, width])).reshape([frames, count, dim]);
    Tensor::cat(vec![class.val().expand([frames, 1, dim]), tokens], 1) + positions(trained.val(), count, resampling)
}

impl Layer {
    /// Computes all tokens, or the first `outputs`.
    ///
    /// # Shapes
    /// Maps `[frames, tokens, dim]` to `[frames, outputs, dim]`.
    fn forward(&self, x: Tensor<3>, outputs: Option<usize>) -> Tensor<3> {
        let mixed = self.attention.forward(self.layernorm_before.forward(x.clone()), outputs);
        let x = match outputs {
            Some(outputs) => leading(x, outputs),
            None => x,
        } + mixed;
        let hidden = self.intermediate.dense.forward(self.layernorm_after.forward(x.clone()));
        x + self.output.dense.forward(Activation::Gelu.forward(hidden))
    }
}

impl Attention {
    /// Creates an attention block with `heads` heads.
    pub(super) fn new(init: &Init, dim: usize, heads: usize) -> Self {
        let part = |name| Linear::normal(&init.of(name), dim, dim, STD);
        Self {
            attention: Qkv { query: part("query"), key: part("key"), value: part("value") },
            output: Dense { dense: Linear::normal(&init.of("attention").of("dense"), dim, dim, STD) },
            heads,
        }
    }

    /// The number of heads.
    pub(crate) fn heads(&self) -> usize {
        self.heads
    }

    /// Computes the attention of all tokens, or of the first `outputs`, to all tokens.
    ///
    /// # Shapes
    /// Maps `[frames, tokens, dim]` to `[frames, outputs, dim]`.
    pub(super) fn forward(&self, x: Tensor<3>, outputs: Option<usize>) -> Tensor<3> {
        let [_, tokens, _] = x.dims();
        let parts = &self.attention;
        let query = parts.query.forward(leading(x.clone(), outputs.unwrap_or(tokens)));
        let (key, value) = (parts.key.forward(x.clone()), parts.value.forward(x));
        self.output.dense.forward(attend([query, key, value], self.heads, None, 0.0, &mut DropoutRng::disabled()))
    }
}
