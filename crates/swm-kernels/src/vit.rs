//! [`VitEncoder`]: a vision transformer (Dosovitskiy et al. 2021) that returns the class token of one image at a time.
//!
//! The tokens of an image are split into blocks of rows, which threads compute in parallel; every row is computed
//! independently, so the result has the same bytes on any number of threads. The last layer computes only the class
//! token.

use crate::functions::{add, gelu, softmax};
use crate::{Affine, Norm, Panels, ScratchPool, grown};
use rayon::prelude::*;

/// The maximum number of rows of a block.
const BLOCK: usize = 36;

/// The parameters of a vision transformer, or the gradients of the parameters.
#[derive(Clone, Debug)]
pub struct VitParameters {
    /// The layer from patches to tokens, with a weight of `[dim, 3 * patch * patch]` and a bias of `[dim]`.
    pub patches: Affine,
    /// The class token plus its position embedding, then the position embeddings of the patches: `[1 + patches, dim]`.
    pub positions: Vec<f32>,
    /// The layers, first to last.
    pub layers: Vec<VitLayerParameters>,
    /// The normalisation after the last layer.
    pub norm: Affine,
}

/// The parameters of one layer of a vision transformer, or the gradients of the parameters.
#[derive(Clone, Debug)]
pub struct VitLayerParameters {
    /// The normalisation before the attention.
    pub norm_before: Affine,
    /// The projection to queries, `[dim, dim]`.
    pub query: Affine,
    /// The projection to keys, `[dim, dim]`.
    pub key: Affine,
    /// The projection to values, `[dim, dim]`.
    pub value: Affine,
    /// The output projection of the attention, `[dim, dim]`.
    pub attention_output: Affine,
    /// The normalisation before the feed-forward block.
    pub norm_after: Affine,
    /// The first layer of the feed-forward block, `[mlp, dim]`.
    pub intermediate: Affine,
    /// The second layer of the feed-forward block, `[dim, mlp]`.
    pub output: Affine,
}

/// A vision transformer laid out for encoding.
pub struct VitEncoder {
    pub(crate) dim: usize,
    pub(crate) heads: usize,
    /// The layer from patches to tokens.
    pub(crate) embed: Panels,
    /// The position embeddings, `[tokens, dim]`, as [`VitParameters::positions`].
    pub(crate) positions: Vec<f32>,
    pub(crate) layers: Vec<Layer>,
    pub(crate) norm: Norm,
    scratch: ScratchPool<Scratch>,
    blocks: ScratchPool<BlockScratch>,
}

pub(crate) struct Layer {
    pub before: Norm,
    /// The projections to scaled queries, keys and values.
    pub qkv: Panels,
    pub out: Panels,
    pub after: Norm,
    pub mlp: [Panels; 2],
}

/// Scratch memory for one image.
#[derive(Default)]
struct Scratch {
    x: Vec<f32>,
    /// Scaled queries, keys and values, `[tokens, 3 * dim]`.
    qkv: Vec<f32>,
    /// The keys of each head as columns, then the values of each head as rows.
    keys_values: Vec<Panels>,
}

/// Scratch memory for one block of rows.
#[derive(Default)]
struct BlockScratch {
    narrow: Vec<f32>,
    mixed: Vec<f32>,
    wide: Vec<f32>,
}

impl VitEncoder {
    /// Lays out the parameters of a transformer with `heads` attention heads, whose normalisations add `epsilon` to the
    /// variance.
    pub fn new(parameters: &VitParameters, heads: usize, epsilon: f32) -> Self {
        let dim = parameters.norm.bias.len();
        Self {
            dim,
            heads,
            embed: Panels::linear(&parameters.patches),
            positions: parameters.positions.clone(),
            layers: parameters.layers.iter().map(|layer| Layer::new(layer, heads, epsilon)).collect(),
            norm: Norm::new(parameters.norm.clone(), epsilon),
            scratch: ScratchPool::default(),
            blocks: ScratchPool::default(),
        }
    }

    /// Returns the class token of one image.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`; returns `[dim]`.
    pub fn encode(&self, patches: &[f32]) -> Vec<f32> {
        self.scratch.with(|scratch| self.encode_with(scratch, patches))
    }

    fn encode_with(&self, scratch: &mut Scratch, patches: &[f32]) -> Vec<f32> {
        let dim = self.dim;
        let tokens = self.positions.len() / dim;
        let block = tokens.div_ceil(tokens.div_ceil(BLOCK));
        let x = grown(&mut scratch.x, tokens * dim);
        self.embed_patches(patches, block, x);
        let qkv = grown(&mut scratch.qkv, tokens * 3 * dim);
        let width = dim / self.heads;
        if scratch.keys_values.is_empty() {
            let key = |_| Panels::new(width, tokens, |_, _| 0.0);
            let value = |_| Panels::new(tokens, width, |_, _| 0.0);
            scratch.keys_values = (0..self.heads).map(key).chain((0..self.heads).map(value)).collect();
        }
        for (index, layer) in self.layers.iter().enumerate() {
            x.par_chunks(block * dim).zip(qkv.par_chunks_mut(block * 3 * dim)).for_each(|(x, qkv)| {
                self.blocks.with(|scratch| {
                    let narrow = grown(&mut scratch.narrow, x.len());
                    layer.before.apply(x, narrow);
                    layer.qkv.apply(narrow, qkv);
                });
            });
            scratch.keys_values.par_iter_mut().enumerate().for_each(|(part, panels)| {
                let from = &qkv[dim + part * width..];
                if part < self.heads {
                    panels.fill(width, |i, token| from[token * 3 * dim + i]);
                } else {
                    panels.fill_rows(tokens, (from, 3 * dim));
                }
            });
            let queries = if index + 1 == self.layers.len() { 1 } else { tokens };
            let (keys_values, rows) = (&scratch.keys_values[..], x[..queries * dim].par_chunks_mut(block * dim));
            rows.zip(qkv.par_chunks(block * 3 * dim)).for_each(|(x, qkv)| {
                self.blocks.with(|scratch| layer.apply(x, qkv, keys_values, scratch));
            });
        }
        let mut class = vec![0.0; dim];
        self.norm.apply(&x[..dim], &mut class);
        class
    }

    /// Writes the class token and the embedded patches, plus position embeddings, to `x`, `[tokens, dim]`.
    fn embed_patches(&self, patches: &[f32], block: usize, x: &mut [f32]) {
        let (dim, inputs) = (self.dim, self.embed.inputs());
        let (class, patch_tokens) = x.split_at_mut(dim);
        class.copy_from_slice(&self.positions[..dim]);
        let rows = patch_tokens.par_chunks_mut(block * dim).zip(patches.par_chunks(block * inputs));
        rows.zip(self.positions[dim..].par_chunks(block * dim)).for_each(|((x, patches), positions)| {
            self.embed.apply(patches, x);
            add(x, positions);
        });
    }
}

impl Layer {
    fn new(parameters: &VitLayerParameters, heads: usize, epsilon: f32) -> Self {
        let dim = parameters.norm_before.bias.len();
        let scale = query_scale(dim, heads);
        let scaled = |values: &[f32]| -> Vec<f32> { values.iter().map(|value| value * scale).collect() };
        let VitLayerParameters { query, key, value, .. } = parameters;
        let qkv = Affine {
            weight: [&scaled(&query.weight)[..], &key.weight, &value.weight].concat(),
            bias: [&scaled(&query.bias)[..], &key.bias, &value.bias].concat(),
        };
        Self {
            before: Norm::new(parameters.norm_before.clone(), epsilon),
            qkv: Panels::linear(&qkv),
            out: Panels::linear(&parameters.attention_output),
            after: Norm::new(parameters.norm_after.clone(), epsilon),
            mlp: [Panels::linear(&parameters.intermediate), Panels::linear(&parameters.output)],
        }
    }

    /// Computes the layer for a block of rows: `x` is `[rows, dim]`, and `qkv` of the same rows is `[rows, 3 * dim]`.
    fn apply(&self, x: &mut [f32], qkv: &[f32], keys_values: &[Panels], scratch: &mut BlockScratch) {
        let dim = self.out.inputs();
        let (rows, heads) = (x.len() / dim, keys_values.len() / 2);
        let width = dim / heads;
        let narrow = grown(&mut scratch.narrow, x.len());
        let mixed = grown(&mut scratch.mixed, x.len());
        let (keys, values) = keys_values.split_at(heads);
        for (head, (keys, values)) in keys.iter().zip(values).enumerate() {
            let scores = grown(&mut scratch.wide, rows * keys.outputs());
            keys.apply_strided(rows, (&qkv[head * width..], 3 * dim), (scores, keys.outputs()));
            softmax(scores, keys.outputs());
            values.apply_strided(rows, (scores, keys.outputs()), (&mut mixed[head * width..], dim));
        }
        self.out.apply(mixed, narrow);
        add(x, narrow);
        self.after.apply(x, narrow);
        let [into, out] = &self.mlp;
        let hidden = grown(&mut scratch.wide, rows * into.outputs());
        into.apply(narrow, hidden);
        gelu(hidden);
        out.apply(hidden, narrow);
        add(x, narrow);
    }
}

/// Returns the factor that scales the queries, `1 / sqrt(dim / heads)`.
pub(crate) fn query_scale(dim: usize, heads: usize) -> f32 {
    1.0 / ((dim / heads) as f32).sqrt()
}
