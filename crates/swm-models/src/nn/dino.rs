//! DINOv2 (Oquab et al. 2023), with or without registers (Darcet et al. 2023): a vision transformer whose branches are
//! scaled channel by channel before they are added (LayerScale, Touvron et al. 2021). Parameters have the names of the
//! published checkpoints.

use super::positions::Resampling;
use super::vit::{Attention, Patches, Projection, STD, embed, leading};
use super::{Activation, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The size of a [`Dino`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DinoConfig {
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
    /// Side of the grid of patches that the position embeddings were trained for.
    pub grid: usize,
    /// The number of register tokens, which represent no patch.
    #[serde(default)]
    pub registers: usize,
}

/// A DINOv2 encoder.
#[derive(Module, Debug)]
pub struct Dino {
    /// Patch, class, register and position embeddings.
    pub embeddings: Embeddings,
    /// The layers.
    pub encoder: Layers,
    /// The last normalisation.
    pub layernorm: LayerNorm,
}

/// Patch, class, register and position embeddings.
#[derive(Module, Debug)]
pub struct Embeddings {
    /// The class token, `[1, 1, dim]`.
    pub cls_token: Param<Tensor<3>>,
    /// The mask token, `[1, dim]`: replaces masked patches in pretraining; this encoder does not use it.
    pub mask_token: Param<Tensor<2>>,
    /// The position embeddings, `[1, 1 + grid * grid, dim]`.
    pub position_embeddings: Param<Tensor<3>>,
    /// The register tokens, `[1, registers, dim]`.
    pub register_tokens: Option<Param<Tensor<3>>>,
    /// The projection of patches to tokens.
    pub patch_embeddings: Patches,
}

/// The layers of a [`Dino`].
#[derive(Module, Debug)]
pub struct Layers {
    /// The layers, first to last.
    pub layer: Vec<Layer>,
}

/// One layer: attention, then feed-forward, each computed from normalised tokens, scaled and added to the tokens.
#[derive(Module, Debug)]
pub struct Layer {
    /// The normalisation before the attention.
    pub norm1: LayerNorm,
    /// Self-attention.
    pub attention: Attention,
    /// The scale of the attention branch.
    pub layer_scale1: Scale,
    /// The normalisation before the feed-forward block.
    pub norm2: LayerNorm,
    /// The feed-forward block.
    pub mlp: FeedForward,
    /// The scale of the feed-forward branch.
    pub layer_scale2: Scale,
}

/// The LayerScale: a factor for every channel.
#[derive(Module, Debug)]
pub struct Scale {
    /// The factors, `[dim]`.
    pub lambda1: Param<Tensor<1>>,
}

/// The feed-forward block of a [`Layer`]: linear, GELU, linear.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// The layer to the hidden features.
    pub fc1: Linear,
    /// The layer from the hidden features.
    pub fc2: Linear,
}

/// The value that the layer normalisations add to the variance.
const EPSILON: f64 = 1e-6;

impl DinoConfig {
    /// The config of a published size: patches of 14 pixels, trained on images with a side of 518 pixels.
    const fn sized(dim: usize, heads: usize) -> Self {
        Self { patch: 14, dim, depth: 12, heads, mlp: 4 * dim, grid: 37, registers: 0 }
    }

    /// The size of `facebook/dinov2-small`.
    pub const fn small() -> Self {
        Self::sized(384, 6)
    }

    /// The size of `facebook/dinov2-base`.
    pub const fn base() -> Self {
        Self::sized(768, 12)
    }

    /// Creates the encoder.
    pub fn init(&self, init: &Init) -> Dino {
        let dim = self.dim;
        let layer = |index| {
            let init = init.of("layer").at(index);
            Layer {
                norm1: LayerNorm::new(&init, dim, EPSILON),
                attention: Attention::new(&init, dim, self.heads),
                layer_scale1: Scale { lambda1: init.constant([dim], 1.0) },
                norm2: LayerNorm::new(&init, dim, EPSILON),
                mlp: FeedForward {
                    fc1: Linear::normal(&init.of("fc1"), dim, self.mlp, STD),
                    fc2: Linear::normal(&init.of("fc2"), self.mlp, dim, STD),
                },
                layer_scale2: Scale { lambda1: init.constant([dim], 1.0) },
            }
        };
        Dino {
            embeddings: Embeddings {
                cls_token: init.normal("cls_token", [1, 1, dim], STD),
                mask_token: init.constant([1, dim], 0.0),
                position_embeddings: init.normal("position_embeddings", [1, 1 + self.grid.pow(2), dim], STD),
                register_tokens: (self.registers > 0)
                    .then(|| init.normal("register_tokens", [1, self.registers, dim], STD)),
                patch_embeddings: Patches { projection: Projection::new(&init.of("patch"), 3, self.patch, dim, STD) },
            },
            encoder: Layers { layer: (0..self.depth).map(layer).collect() },
            layernorm: LayerNorm::new(init, dim, EPSILON),
        }
    }
}

impl Dino {
    /// Computes the class token.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let class = self.run(patches, Some(1));
        let [frames, _, dim] = class.dims();
        class.reshape([frames, dim])
    }

    /// Computes all tokens: the class token, the registers, then one token for every patch.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, 1 + registers + patches, dim]`.
    pub fn tokens(&self, patches: Tensor<3>) -> Tensor<3> {
        self.run(patches, None)
    }

    /// Computes one token for every patch.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, patches, dim]`.
    pub fn patches(&self, patches: Tensor<3>) -> Tensor<3> {
        let [frames, count, _] = patches.dims();
        let tokens = self.tokens(patches);
        let [_, all, dim] = tokens.dims();
        tokens.slice([0..frames, all - count..all, 0..dim])
    }

    /// Computes the first `outputs` tokens, or all tokens for `None`.
    ///
    /// # Shapes
    /// Maps `[frames, patches, 3 * patch * patch]` to `[frames, outputs, dim]`.
    fn run(&self, patches: Tensor<3>, outputs: Option<usize>) -> Tensor<3> {
        let parts = &self.embeddings;
        let resampling = match parts.register_tokens {
            Some(_) => Resampling::Antialiased,
            None => Resampling::Bicubic,
        };
        let [frames, count, _] = patches.dims();
        let projection = &parts.patch_embeddings.projection;
        let mut tokens = embed(patches, projection, &parts.cls_token, &parts.position_embeddings, resampling);
        if let Some(registers) = &parts.register_tokens {
            let [_, register_count, dim] = registers.dims();
            let patch_tokens = tokens.clone().slice([0..frames, 1..1 + count, 0..dim]);
            tokens = Tensor::cat(
                vec![leading(tokens, 1), registers.val().expand([frames, register_count, dim]), patch_tokens],
                1,
            );
        }
        for (index, layer) in self.encoder.layer.iter().enumerate() {
            tokens = layer.forward(tokens, outputs.filter(|_| index + 1 == self.encoder.layer.len()));
        }
        self.layernorm.forward(match outputs {
            Some(outputs) => leading(tokens, outputs),
            None => tokens,
        })
    }
}

impl Layer {
    /// Computes all tokens, or the first `outputs`.
    ///
    /// # Shapes
    /// Maps `[frames, tokens, dim]` to `[frames, outputs, dim]`.
    fn forward(&self, x: Tensor<3>, outputs: Option<usize>) -> Tensor<3> {
        let attended = self.attention.forward(self.norm1.forward(x.clone()), outputs);
        let x = match outputs {
            Some(outputs) => leading(x, outputs),
            None => x,
        } + self.layer_scale1.forward(attended);
        let hidden = Activation::Gelu.forward(self.mlp.fc1.forward(self.norm2.forward(x.clone())));
        x + self.layer_scale2.forward(self.mlp.fc2.forward(hidden))
    }
}

impl Scale {
    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        x * self.lambda1.val().unsqueeze()
    }
}
