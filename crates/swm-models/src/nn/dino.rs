//! DINOv2 (Oquab et al. 2023), with or without registers (Darcet et al. 2023): a vision transformer whose parts are
//! scaled channel by channel before they are added, named as the published checkpoints name it.

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
    /// Features of a token.
    pub dim: usize,
    /// Layers.
    pub depth: usize,
    /// Attention heads.
    pub heads: usize,
    /// Hidden features of the feed-forward part.
    pub mlp: usize,
    /// Side of the grid of patches that positions were learnt for.
    pub grid: usize,
    /// Tokens that stand for nothing.
    #[serde(default)]
    pub registers: usize,
}

/// A DINOv2 encoder.
#[derive(Module, Debug)]
pub struct Dino {
    /// Patches, tokens of their own, positions.
    pub embeddings: Embeddings,
    /// The layers.
    pub encoder: Layers,
    /// The last normalisation.
    pub layernorm: LayerNorm,
}

/// Patches, tokens of their own, positions.
#[derive(Module, Debug)]
pub struct Embeddings {
    /// `[1, 1, dim]`.
    pub cls_token: Param<Tensor<3>>,
    /// `[1, dim]`: in place of hidden patches while it was trained; not used here.
    pub mask_token: Param<Tensor<2>>,
    /// `[1, 1 + grid * grid, dim]`.
    pub position_embeddings: Param<Tensor<3>>,
    /// `[1, registers, dim]`.
    pub register_tokens: Option<Param<Tensor<3>>>,
    /// From pixels to tokens.
    pub patch_embeddings: Patches,
}

/// The layers of a [`Dino`].
#[derive(Module, Debug)]
pub struct Layers {
    /// In order.
    pub layer: Vec<Layer>,
}

/// One layer: attention, then feed-forward, each on normalised tokens, scaled and added to them.
#[derive(Module, Debug)]
pub struct Layer {
    /// Before the attention.
    pub norm1: LayerNorm,
    /// Self-attention.
    pub attention: Attention,
    /// Scales what it returns.
    pub layer_scale1: Scale,
    /// Before the feed-forward part.
    pub norm2: LayerNorm,
    /// The feed-forward part.
    pub mlp: FeedForward,
    /// Scales what it returns.
    pub layer_scale2: Scale,
}

/// A factor a channel.
#[derive(Module, Debug)]
pub struct Scale {
    /// `[dim]`.
    pub lambda1: Param<Tensor<1>>,
}

/// Linear, GELU, linear.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// Into the hidden features.
    pub fc1: Linear,
    /// Out of them.
    pub fc2: Linear,
}

/// What the layer normalisations add to the variance.
const EPSILON: f64 = 1e-6;

impl DinoConfig {
    /// The published sizes: patches of 14 pixels, trained on pictures of 518.
    const fn sized(dim: usize, heads: usize) -> Self {
        Self { patch: 14, dim, depth: 12, heads, mlp: 4 * dim, grid: 37, registers: 0 }
    }

    /// `facebook/dinov2-small`.
    pub const fn small() -> Self {
        Self::sized(384, 6)
    }

    /// `facebook/dinov2-base`.
    pub const fn base() -> Self {
        Self::sized(768, 12)
    }

    /// The encoder.
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
    /// The class token.
    ///
    /// # Shapes
    /// `[frames, patches, 3 * patch * patch]` to `[frames, dim]`.
    pub fn forward(&self, patches: Tensor<3>) -> Tensor<2> {
        let class = self.run(patches, Some(1));
        let [frames, _, dim] = class.dims();
        class.reshape([frames, dim])
    }

    /// All tokens: the class token, the registers, one a patch.
    ///
    /// # Shapes
    /// `[frames, patches, 3 * patch * patch]` to `[frames, 1 + registers + patches, dim]`.
    pub fn tokens(&self, patches: Tensor<3>) -> Tensor<3> {
        self.run(patches, None)
    }

    /// One token a patch.
    ///
    /// # Shapes
    /// `[frames, patches, 3 * patch * patch]` to `[frames, patches, dim]`.
    pub fn patches(&self, patches: Tensor<3>) -> Tensor<3> {
        let [frames, count, _] = patches.dims();
        let tokens = self.tokens(patches);
        let [_, all, dim] = tokens.dims();
        tokens.slice([0..frames, all - count..all, 0..dim])
    }

    /// The first `asked` tokens, or all.
    fn run(&self, patches: Tensor<3>, asked: Option<usize>) -> Tensor<3> {
        let parts = &self.embeddings;
        let resampling = match parts.register_tokens {
            Some(_) => Resampling::Antialiased,
            None => Resampling::Bicubic,
        };
        let [frames, count, _] = patches.dims();
        let projection = &parts.patch_embeddings.projection;
        let mut tokens = embed(patches, projection, &parts.cls_token, &parts.position_embeddings, resampling);
        if let Some(registers) = &parts.register_tokens {
            let [_, more, dim] = registers.dims();
            let rest = tokens.clone().slice([0..frames, 1..1 + count, 0..dim]);
            tokens = Tensor::cat(vec![leading(tokens, 1), registers.val().expand([frames, more, dim]), rest], 1);
        }
        for (index, layer) in self.encoder.layer.iter().enumerate() {
            tokens = layer.forward(tokens, asked.filter(|_| index + 1 == self.encoder.layer.len()));
        }
        self.layernorm.forward(match asked {
            Some(asked) => leading(tokens, asked),
            None => tokens,
        })
    }
}

impl Layer {
    /// All tokens, or the first `asked`.
    fn forward(&self, x: Tensor<3>, asked: Option<usize>) -> Tensor<3> {
        let mixed = self.attention.forward(self.norm1.forward(x.clone()), asked);
        let x = match asked {
            Some(asked) => leading(x, asked),
            None => x,
        } + self.layer_scale1.forward(mixed);
        let hidden = Activation::Gelu.forward(self.mlp.fc1.forward(self.norm2.forward(x.clone())));
        x + self.layer_scale2.forward(self.mlp.fc2.forward(hidden))
    }
}

impl Scale {
    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        x * self.lambda1.val().unsqueeze()
    }
}
