//! [`Predictor`]: a causal transformer over latents whose layers are modulated by the actions (AdaLN-Zero, Peebles and
//! Xie 2023, section 3.2).

#![allow(non_snake_case, reason = "parameters have their published names")]

use super::attention::{FeedForward, SelfAttention, causal_mask};
use super::norm::standardize;
use super::{Activation, DropoutRng, Init, LayerNorm, Linear};
use burn::module::{Module, Param};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

/// The size of a [`Predictor`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictorConfig {
    /// The number of latents in a window, including the current one.
    pub history: usize,
    /// The number of features of a token.
    pub dim: usize,
    /// The number of layers.
    pub depth: usize,
    /// The number of attention heads.
    pub heads: usize,
    /// The number of features of a head.
    pub dim_head: usize,
    /// The number of hidden features of the feed-forward block.
    pub mlp: usize,
    /// The dropout rate inside the layers.
    pub dropout: f32,
    /// The dropout rate of the input latents.
    pub emb_dropout: f32,
}

/// Predicts the latent that follows each latent of a window, given the action between the two latents.
#[derive(Module, Debug)]
pub struct Predictor {
    /// The position embeddings, `[1, history, latent]`.
    pub pos_embedding: Param<Tensor<3>>,
    /// The layers.
    pub transformer: Transformer,
    #[module(skip)]
    config: PredictorConfig,
}

/// The layers of a [`Predictor`]. A projection is absent if its input and output sizes are equal.
#[derive(Module, Debug)]
pub struct Transformer {
    /// The last normalisation.
    pub norm: LayerNorm,
    /// The projection of latents to tokens.
    pub input_proj: Option<Linear>,
    /// The projection of embedded actions to conditions.
    pub cond_proj: Option<Linear>,
    /// The projection of tokens to latents.
    pub output_proj: Option<Linear>,
    /// The layers, first to last.
    pub layers: Vec<Block>,
}

/// One modulated layer.
#[derive(Module, Debug)]
pub struct Block {
    /// Self-attention.
    pub attn: SelfAttention,
    /// The feed-forward block.
    pub mlp: FeedForward,
    /// The map of the condition to shifts, scales and gates.
    pub adaLN_modulation: Modulation,
}

/// The zero-initialised map of conditions, `[…, dim]`, to `[…, 6 * dim]`: shift, scale and gate of the attention, then
/// shift, scale and gate of the feed-forward block. The field `_1` is element 1 of a `torch.nn.Sequential`.
#[derive(Module, Debug)]
pub struct Modulation {
    /// The layer.
    pub _1: Linear,
}

/// The value that the normalisations before a modulation add to the variance.
pub(crate) const MODULATED_EPSILON: f64 = 1e-6;
/// The value that the normalisation after the last layer adds to the variance.
const EPSILON: f64 = 1e-5;

impl PredictorConfig {
    /// Creates a predictor of latents with `latent` elements.
    pub fn init(&self, init: &Init, latent: usize) -> Predictor {
        let dim = self.dim;
        let projection =
            |name: &str, inputs, outputs| (inputs != outputs).then(|| Linear::new(&init.of(name), inputs, outputs));
        let layer = |index| {
            let init = init.of("layer").at(index);
            Block {
                attn: SelfAttention::new(&init, dim, [self.heads, self.dim_head], self.dropout),
                mlp: FeedForward::new(&init, dim, self.mlp, self.dropout),
                adaLN_modulation: Modulation { _1: Linear::zeros(&init, dim, 6 * dim) },
            }
        };
        Predictor {
            pos_embedding: init.normal("pos_embedding", [1, self.history, latent], 1.0),
            transformer: Transformer {
                norm: LayerNorm::new(init, dim, EPSILON),
                input_proj: projection("input_proj", latent, dim),
                cond_proj: projection("cond_proj", latent, dim),
                output_proj: projection("output_proj", dim, latent),
                layers: (0..self.depth).map(layer).collect(),
            },
            config: self.clone(),
        }
    }
}

impl Predictor {
    /// The sizes of the predictor.
    pub fn config(&self) -> &PredictorConfig {
        &self.config
    }

    /// Predicts the next latents.
    ///
    /// # Shapes
    /// `latents` and the embedded `actions` are `[windows, steps, latent]` with at most `history` steps; returns the
    /// same shape.
    pub fn forward(&self, latents: Tensor<3>, actions: Tensor<3>, noise: &mut DropoutRng<'_>) -> Tensor<3> {
        let [_, steps, latent] = latents.dims();
        let x = latents + self.pos_embedding.val().slice([0..1, 0..steps, 0..latent]);
        let mut x = noise.dropout(x, self.config.emb_dropout);
        let parts = &self.transformer;
        let through = |layer: &Option<Linear>, x: Tensor<3>| match layer {
            Some(layer) => layer.forward(x),
            None => x,
        };
        x = through(&parts.input_proj, x);
        let condition = Activation::Silu.forward(through(&parts.cond_proj, actions));
        let mask = (steps > 1).then(|| causal_mask([steps, steps], steps, &x.device()));
        for layer in &parts.layers {
            x = layer.forward(x, condition.clone(), mask.clone(), noise);
        }
        through(&parts.output_proj, parts.norm.forward(x))
    }
}

impl Block {
    fn forward(
        &self,
        x: Tensor<3>,
        condition: Tensor<3>,
        mask: Option<Tensor<4>>,
        noise: &mut DropoutRng<'_>,
    ) -> Tensor<3> {
        let modulation = self.adaLN_modulation._1.forward(condition).chunk(6, 2);
        let [shift_attn, scale_attn, gate_attn, shift_mlp, scale_mlp, gate_mlp] =
            <[Tensor<3>; 6]>::try_from(modulation).expect("a modulation has six equal parts");
        let modulate = |x: Tensor<3>, shift: Tensor<3>, scale: Tensor<3>| {
            standardize(x, MODULATED_EPSILON) * (scale + 1.0) + shift
        };
        let modulated = modulate(x.clone(), shift_attn, scale_attn);
        let mixed = match mask {
            Some(mask) => self.attn.forward(modulated, Some(mask), noise),
            None => self.attn.forward_single(modulated, noise),
        };
        let x = x + gate_attn * mixed;
        let fed = self.mlp.forward(modulate(x.clone(), shift_mlp, scale_mlp), noise);
        x + gate_mlp * fed
    }
}
