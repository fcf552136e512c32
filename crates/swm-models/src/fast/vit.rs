//! [`FastVit`]: the class token of a [`Vit`], one picture at a time.
//!
//! The tokens of a picture are split into blocks of rows, which threads work on side by side; every row is computed on its
//! own, so that the latent is the same bytes on any number of them. In the last layer only the class token asks.

use super::dense::dense;
use super::functions::{gelu, softmax};
use super::norm::add;
use super::vit_gradient::scale;
use super::{Norm, Panels, Pool, grown, numbers};
use crate::nn::positions::{Resampling, positions};
use crate::nn::vit::Layer;
use crate::nn::{Linear, Vit};
use rayon::prelude::*;

/// The most rows of a block.
const BLOCK: usize = 36;

/// The weights of a vision transformer.
pub struct FastVit {
    pub(super) dim: usize,
    pub(super) heads: usize,
    /// From patches to tokens.
    pub(super) embed: Panels,
    /// `[tokens, dim]`, that of the class token with the class token itself.
    pub(super) positions: Vec<f32>,
    pub(super) layers: Vec<FastLayer>,
    pub(super) norm: Norm,
    scratch: Pool<Scratch>,
    blocks: Pool<BlockScratch>,
}

pub(super) struct FastLayer {
    pub before: Norm,
    /// Queries (scaled), keys and values.
    pub qkv: Panels,
    pub out: Panels,
    pub after: Norm,
    pub mlp: [Panels; 2],
}

/// Memory of one picture.
#[derive(Default)]
struct Scratch {
    x: Vec<f32>,
    /// `[tokens, 3 * dim]`.
    qkv: Vec<f32>,
    /// For each head, the keys as columns, then the values as rows.
    seen: Vec<Panels>,
}

/// Memory of one block of rows.
#[derive(Default)]
struct BlockScratch {
    narrow: Vec<f32>,
    mixed: Vec<f32>,
    wide: Vec<f32>,
}

impl FastVit {
    /// The weights of a transformer of so many heads, for pictures of so many patches.
    pub fn new(vit: &Vit, heads: usize, patches: usize) -> Self {
        let embeddings = &vit.embeddings;
        let projection = &embeddings.patch_embeddings.projection;
        let [dim, channels, height, width] = projection.weight.dims();
        let (inputs, weight) = (channels * height * width, numbers(projection.weight.val()));
        let mut learnt = numbers(positions(embeddings.position_embeddings.val(), patches, Resampling::Bicubic));
        add(&mut learnt[..dim], &numbers(embeddings.cls_token.val()));
        Self {
            dim,
            heads,
            embed: Panels::new(inputs, dim, |i, o| weight[o * inputs + i]).with_bias(&numbers(projection.bias.val())),
            positions: learnt,
            layers: vit.encoder.layer.iter().map(|layer| FastLayer::new(layer, dim, heads)).collect(),
            norm: Norm::new(&vit.layernorm),
            scratch: Pool::default(),
            blocks: Pool::default(),
        }
    }

    /// # Shapes
    /// The patches of one picture, `[patches, 3 * patch * patch]`, to `[dim]`.
    pub fn encode(&self, patches: &[f32]) -> Vec<f32> {
        self.scratch.with(|scratch| self.encode_with(scratch, patches))
    }

    fn encode_with(&self, scratch: &mut Scratch, patches: &[f32]) -> Vec<f32> {
        let (dim, inputs) = (self.dim, self.embed.inputs());
        let tokens = self.positions.len() / dim;
        let block = tokens.div_ceil(tokens.div_ceil(BLOCK));
        let x = grown(&mut scratch.x, tokens * dim);
        let (class, others) = x.split_at_mut(dim);
        class.copy_from_slice(&self.positions[..dim]);
        let rows = others.par_chunks_mut(block * dim).zip(patches.par_chunks(block * inputs));
        rows.zip(self.positions[dim..].par_chunks(block * dim)).for_each(|((x, patches), positions)| {
            self.embed.apply(patches, x);
            add(x, positions);
        });
        let qkv = grown(&mut scratch.qkv, tokens * 3 * dim);
        let width = dim / self.heads;
        if scratch.seen.is_empty() {
            let key = |_| Panels::new(width, tokens, |_, _| 0.0);
            let value = |_| Panels::new(tokens, width, |_, _| 0.0);
            scratch.seen = (0..self.heads).map(key).chain((0..self.heads).map(value)).collect();
        }
        for (index, layer) in self.layers.iter().enumerate() {
            x.par_chunks(block * dim).zip(qkv.par_chunks_mut(block * 3 * dim)).for_each(|(x, qkv)| {
                self.blocks.with(|scratch| {
                    let narrow = grown(&mut scratch.narrow, x.len());
                    layer.before.apply(x, narrow);
                    layer.qkv.apply(narrow, qkv);
                });
            });
            scratch.seen.par_iter_mut().enumerate().for_each(|(part, panels)| {
                let from = &qkv[dim + part * width..];
                if part < self.heads {
                    panels.fill(width, |i, token| from[token * 3 * dim + i]);
                } else {
                    panels.fill_rows(tokens, (from, 3 * dim));
                }
            });
            let asked = if index + 1 == self.layers.len() { 1 } else { tokens };
            let (seen, rows) = (&scratch.seen[..], x[..asked * dim].par_chunks_mut(block * dim));
            rows.zip(qkv.par_chunks(block * 3 * dim)).for_each(|(x, qkv)| {
                self.blocks.with(|scratch| layer.apply(x, qkv, seen, scratch));
            });
        }
        let mut class = vec![0.0; dim];
        self.norm.apply(&x[..dim], &mut class);
        class
    }
}

impl FastLayer {
    fn new(layer: &Layer, dim: usize, heads: usize) -> Self {
        let scale = scale(dim, heads);
        let parts = &layer.attention.attention;
        let of = |linear: &Linear, scale: f32| {
            let scaled = |values: Vec<f32>| -> Vec<f32> { values.into_iter().map(|value| value * scale).collect() };
            let bias = linear.bias.as_ref().map_or_else(|| vec![0.0; dim], |bias| scaled(numbers(bias.val())));
            (scaled(numbers(linear.weight.val())), bias)
        };
        let qkv = [of(&parts.query, scale), of(&parts.key, 1.0), of(&parts.value, 1.0)];
        let bias = qkv.each_ref().map(|(_, bias)| &bias[..]).concat();
        Self {
            before: Norm::new(&layer.layernorm_before),
            qkv: Panels::new(dim, 3 * dim, |i, o| qkv[o / dim].0[o % dim * dim + i]).with_bias(&bias),
            out: dense(&layer.attention.output.dense),
            after: Norm::new(&layer.layernorm_after),
            mlp: [dense(&layer.intermediate.dense), dense(&layer.output.dense)],
        }
    }

    /// A block of rows through the layer: `x` is `[rows, dim]`, their part of `qkv` is `[rows, 3 * dim]`.
    fn apply(&self, x: &mut [f32], qkv: &[f32], seen: &[Panels], scratch: &mut BlockScratch) {
        let dim = self.out.inputs();
        let (rows, heads) = (x.len() / dim, seen.len() / 2);
        let width = dim / heads;
        let narrow = grown(&mut scratch.narrow, x.len());
        let mixed = grown(&mut scratch.mixed, x.len());
        let (keys, values) = seen.split_at(heads);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Init, VitConfig};
    use burn::tensor::{Device, Tensor, TensorData};
    use swm_core::Key;

    #[test]
    fn it_is_the_transformer_on_any_number_of_threads() {
        let sizes = VitConfig { patch: 2, dim: 24, depth: 2, heads: 3, mlp: 40 };
        // 50 tokens, in two blocks; more positions than were learnt, so that they are resampled.
        let (patches, numbers) = (49, 12);
        let vit = sizes.init(&Init::new(Key::new(1), &Device::flex()), 12);
        let fast = FastVit::new(&vit, sizes.heads, patches);
        let picture: Vec<f32> = (0..patches * numbers).map(|i| (i * 37 % 101) as f32 / 50.0 - 1.0).collect();
        let on = |threads: usize| swm_core::pool::threads(threads).expect("threads").install(|| fast.encode(&picture));
        let class = on(1);
        assert_eq!(class, on(3));
        let given = Tensor::from_data(TensorData::new(picture.clone(), [1, patches, numbers]), &Device::flex());
        for (ours, wanted) in class.iter().zip(crate::fast::numbers(vit.forward(given))) {
            assert!((ours - wanted).abs() < 1e-4, "{ours} for {wanted}");
        }
    }
}
