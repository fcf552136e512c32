//! [`Rollout`]: rollouts of many action sequences from one start state, with the CPU kernels of `swm-kernels`.
//!
//! The result equals [`Lewm::rollout`] up to rounding, with less work:
//!
//! - actions are embedded and converted to modulations once for the whole sequence;
//! - the normalised tokens of a layer are cached while the window of latents grows, and recomputed only when the window
//!   slides, because sliding changes the positions of the tokens;
//! - the last layer and all later modules compute only the last token;
//! - keys and values are never computed. A window holds a few tokens of `dim` features, and the heads together have
//!   many more features. So a query is multiplied by the transposed key matrix, `(W_k y)ᵀq = yᵀ(W_kᵀ q)`, and compared
//!   with the tokens themselves; the weighted mean of the tokens is multiplied by the value matrix,
//!   `Σ a_j W_v y_j = W_v Σ a_j y_j`. A query costs as much in this form as the key and value of a token cost in the
//!   usual form, and there are fewer queries than tokens. The first token attends to itself alone, so one matrix
//!   replaces the value and output projections of that token;
//! - batch normalisation is folded into the linear layer before it.
//!
//! Rows are ordered by token, then by sample, so that tokens are contiguous. Every row is computed separately, so costs
//! do not depend on the other candidates.

use super::model::Lewm;
use crate::nn::Linear;
use crate::nn::kernels::{norm, output_panels, panels, projector_panels};
use crate::nn::parameters::host;
use crate::nn::predictor::{Block, MODULATED_EPSILON};
use burn::module::Param;
use swm_kernels::functions::{gelu, silu};
use swm_kernels::{Modulation, Norm, Panels, ScratchPool, add_gated, causal_attention, grown};

/// The number of rows that a layer processes together: few enough that the activations fit into a core's cache, and as
/// many as possible, because each block reads all weights.
const BLOCK: usize = 80;
/// Parts of a modulation: shift, scale and gate of the attention, then of the feed-forward block.
const PARTS: usize = 6;

/// The weights of a model, laid out for rollouts.
pub struct Rollout {
    history: usize,
    latent: usize,
    dim: usize,
    action: [Panels; 3],
    positions: Vec<f32>,
    input: Option<Panels>,
    condition: Option<Panels>,
    output: Option<Panels>,
    layers: Vec<Layer>,
    norm: Norm,
    project: [Panels; 2],
    scratch: ScratchPool<Scratch>,
}

struct Layer {
    modulation: Panels,
    norm: Norm,
    /// Value and output projection of a token that attends to itself alone, `[dim, dim]`.
    alone: Panels,
    /// The map from tokens to queries, `[dim, heads * width]`.
    query: Panels,
    /// For each head, the scaled map from queries to the space of tokens, `[width, dim]`.
    key: Vec<Panels>,
    /// For each head, the map from the weighted mean of the tokens to values, `[dim, width]`.
    value: Vec<Panels>,
    /// The output projection, `[heads * width, dim]`; absent for a single head with as many features as a token.
    out: Option<Panels>,
    mlp_norm: Norm,
    mlp: [Panels; 2],
}

/// Memory that is reused between calls.
#[derive(Default)]
struct Scratch {
    /// The actions, later the embeddings of the actions, `[steps, samples, …]`.
    actions: Vec<f32>,
    hidden: Vec<f32>,
    /// The modulations of each layer, `[steps, samples, 6 * dim]`.
    modulations: Vec<Vec<f32>>,
    /// For each layer, the cached normalised tokens of the window, `[tokens, samples, dim]`.
    cached: Vec<Vec<f32>>,
    x: Vec<f32>,
    block: BlockScratch,
}

/// Memory of one block of rows.
#[derive(Default)]
struct BlockScratch {
    narrow: Vec<f32>,
    mixed: Vec<f32>,
    wide: Vec<f32>,
    scores: Vec<f32>,
}

impl Layer {
    fn new(block: &Block, dim: usize, heads: usize, width: usize) -> Self {
        let inner = heads * width;
        let weights = host(block.attn.to_qkv.weight.val());
        let (key, value) = (&weights[inner * dim..2 * inner * dim], &weights[2 * inner * dim..]);
        let scale = 1.0 / (width as f32).sqrt();
        // A token that attends to itself alone is multiplied by the value matrix, `[dim, inner]`.
        let values: Vec<f32> = (0..dim * inner).map(|i| value[i % inner * dim + i / inner]).collect();
        let (alone, out) = match &block.attn.to_out {
            Some(out) => {
                let weight = host(out._0.weight.val());
                let bias = out._0.bias.as_ref().map_or_else(Vec::new, |bias| host(bias.val()));
                let projection = Panels::new(inner, dim, |i, o| weight[o * inner + i]);
                let mut product = vec![0.0; dim * dim];
                projection.apply(&values, &mut product);
                (Panels::new(dim, dim, |i, o| product[i * dim + o]).with_bias(&bias), Some(projection.with_bias(&bias)))
            }
            None => (Panels::new(dim, dim, |i, o| values[i * dim + o]), None),
        };
        Self {
            modulation: panels(&block.adaLN_modulation._1),
            norm: norm(&block.attn.norm),
            alone,
            query: output_panels(&block.attn.to_qkv, 0..inner),
            key: (0..heads)
                .map(|head| Panels::new(width, dim, |i, o| key[(head * width + i) * dim + o] * scale))
                .collect(),
            value: (0..heads).map(|head| Panels::new(dim, width, |i, o| value[(head * width + o) * dim + i])).collect(),
            out,
            mlp_norm: norm(&block.mlp.net._0),
            mlp: [panels(&block.mlp.net._1), panels(&block.mlp.net._4)],
        }
    }
}

impl Rollout {
    /// Lays out the weights of a model.
    pub fn new(model: &Lewm) -> Self {
        let predictor = &model.predictor;
        let config = predictor.config();
        let transformer = &predictor.transformer;
        let [_, _, latent] = predictor.pos_embedding.dims();
        let actions = &model.action_encoder;
        let convolution = Linear {
            weight: Param::from_tensor(actions.patch_embed.weight.val().squeeze_dim::<2>(2)),
            bias: Some(actions.patch_embed.bias.clone()),
        };
        Self {
            history: config.history,
            latent,
            dim: config.dim,
            action: [panels(&convolution), panels(&actions.embed._0), panels(&actions.embed._2)],
            positions: host(predictor.pos_embedding.val()),
            input: transformer.input_proj.as_ref().map(panels),
            condition: transformer.cond_proj.as_ref().map(panels),
            output: transformer.output_proj.as_ref().map(panels),
            layers: (transformer.layers.iter())
                .map(|block| Layer::new(block, config.dim, config.heads, config.dim_head))
                .collect(),
            norm: norm(&transformer.norm),
            project: projector_panels(&model.pred_proj),
            scratch: ScratchPool::default(),
        }
    }

    /// Returns the number of candidates that a thread rolls out at once: an equal fraction of `samples`, within limits
    /// that keep the matrix products efficient. The result of a candidate does not depend on the number.
    pub fn chunk_size(samples: usize) -> usize {
        samples.div_ceil(rayon::current_num_threads()).clamp(24, 160)
    }

    /// Returns the latents of a rollout from one start state: the given latents, then one predicted latent after each
    /// further action.
    ///
    /// # Shapes
    /// `start` is `[frames, latent]`, `actions` is `[samples, steps, action_dim]` with `steps >= frames`; returns
    /// `steps + 1` arrays `[samples, latent]`.
    pub fn run(&self, start: &[f32], actions: &[f32], samples: usize, steps: usize) -> Vec<Vec<f32>> {
        self.scratch.with(|scratch| self.run_with(scratch, start, actions, samples, steps))
    }

    fn run_with(
        &self,
        scratch: &mut Scratch,
        start: &[f32],
        actions: &[f32],
        samples: usize,
        steps: usize,
    ) -> Vec<Vec<f32>> {
        let frames = start.len() / self.latent;
        self.modulate(scratch, actions, samples, steps);
        let Scratch { modulations, cached, x, hidden, block, .. } = scratch;
        let mut latents: Vec<Vec<f32>> = start.chunks_exact(self.latent).map(|latent| latent.repeat(samples)).collect();
        cached.resize_with(self.layers.len(), Vec::new);
        cached.iter_mut().for_each(Vec::clear);
        let mut tokens = 0;
        for end in frames..=steps {
            let first = end.saturating_sub(self.history);
            if first > 0 {
                cached.iter_mut().for_each(Vec::clear);
                tokens = 0;
            }
            let new_tokens = tokens..end - first;
            tokens = new_tokens.end;
            x.clear();
            for token in new_tokens.clone() {
                let position = &self.positions[token * self.latent..][..self.latent];
                for row in latents[first + token].chunks_exact(self.latent) {
                    x.extend(row.iter().zip(position).map(|(x, p)| x + p));
                }
            }
            through(self.input.as_ref(), x, hidden);
            for (index, layer) in self.layers.iter().enumerate() {
                let per_step = samples * PARTS * self.dim;
                let modulation = &modulations[index][(first + new_tokens.start) * per_step..end * per_step];
                let last = index + 1 == self.layers.len();
                self.layer(layer, x, modulation, &mut cached[index], [samples, tokens], last, block);
            }
            let mut next = vec![0.0; samples * self.latent];
            for (x, next) in x.chunks_mut(BLOCK * self.dim).zip(next.chunks_mut(BLOCK * self.latent)) {
                self.finish(x, next, block);
            }
            latents.push(next);
        }
        latents
    }

    /// Computes latents from the tokens after the last layer.
    fn finish(&self, x: &[f32], next: &mut [f32], scratch: &mut BlockScratch) {
        let rows = x.len() / self.dim;
        let narrow = grown(&mut scratch.narrow, x.len());
        self.norm.apply(x, narrow);
        let narrow = match &self.output {
            Some(output) => {
                let out = grown(&mut scratch.mixed, rows * self.latent);
                output.apply(narrow, out);
                out
            }
            None => narrow,
        };
        let [into, out] = &self.project;
        let hidden = grown(&mut scratch.wide, rows * into.outputs());
        into.apply(narrow, hidden);
        gelu(hidden);
        out.apply(hidden, next);
    }

    /// Computes the modulations of all layers for all actions.
    fn modulate(&self, scratch: &mut Scratch, actions: &[f32], samples: usize, steps: usize) {
        let Scratch { actions: x, hidden, modulations, .. } = scratch;
        let width = actions.len() / (samples * steps);
        x.clear();
        for step in 0..steps {
            for sample in 0..samples {
                x.extend_from_slice(&actions[(sample * steps + step) * width..][..width]);
            }
        }
        let [convolution, into, out] = &self.action;
        through(Some(convolution), x, hidden);
        through(Some(into), x, hidden);
        silu(x);
        through(Some(out), x, hidden);
        through(self.condition.as_ref(), x, hidden);
        silu(x);
        modulations.resize_with(self.layers.len(), Vec::new);
        for (layer, modulations) in self.layers.iter().zip(modulations) {
            modulations.resize(samples * steps * PARTS * self.dim, 0.0);
            layer.modulation.apply(x, modulations);
        }
    }

    /// Computes one layer for the new tokens of a window of `tokens`; after the last layer, `x` holds the last token
    /// only.
    #[allow(clippy::too_many_arguments, reason = "the scratch buffers are borrowed separately")]
    fn layer(
        &self,
        layer: &Layer,
        x: &mut Vec<f32>,
        mut modulation: &[f32],
        cached: &mut Vec<f32>,
        [samples, tokens]: [usize; 2],
        last: bool,
        scratch: &mut BlockScratch,
    ) {
        let (dim, token) = (self.dim, samples * self.dim);
        let cached_length = cached.len();
        cached.resize(cached_length + x.len(), 0.0);
        layer.norm.apply_modulated(shifted(modulation, 0), x, &mut cached[cached_length..]);
        if last {
            // Only the last token is needed from here on.
            let unused = x.len() - token;
            x.drain(..unused);
            modulation = &modulation[unused * PARTS..];
        }
        let first = tokens * samples - x.len() / dim;
        for (index, x) in x.chunks_mut(BLOCK * dim).enumerate() {
            let rows = first + index * BLOCK..first + index * BLOCK + x.len() / dim;
            let modulation = &modulation[index * BLOCK * PARTS * dim..][..x.len() * PARTS];
            // The first token attends to itself alone.
            let alone = rows.start.min(samples)..rows.end.min(samples);
            let mixed = grown(&mut scratch.mixed, x.len());
            let (first_token, later_tokens) = mixed.split_at_mut(alone.len() * dim);
            if !alone.is_empty() {
                layer.alone.apply(&cached[alone.start * dim..alone.end * dim], first_token);
            }
            if !later_tokens.is_empty() {
                let rows = rows.end - later_tokens.len() / dim..rows.end;
                layer.attend(
                    cached,
                    rows,
                    samples,
                    later_tokens,
                    &mut scratch.narrow,
                    &mut scratch.wide,
                    &mut scratch.scores,
                );
            }
            add_gated(x, mixed, modulation, [dim, PARTS, 2]);
            let narrow = grown(&mut scratch.narrow, x.len());
            layer.mlp_norm.apply_modulated(shifted(modulation, 3), x, narrow);
            let [into, out] = &layer.mlp;
            let hidden = grown(&mut scratch.wide, x.len() / dim * into.outputs());
            into.apply(narrow, hidden);
            gelu(hidden);
            out.apply(hidden, narrow);
            add_gated(x, narrow, modulation, [dim, PARTS, 5]);
        }
    }
}

impl Layer {
    /// Computes the attention output of a range of rows of a window; each row attends to its own token and earlier
    /// tokens.
    #[allow(clippy::too_many_arguments, reason = "the scratch buffers are borrowed separately")]
    fn attend(
        &self,
        cached: &[f32],
        rows: std::ops::Range<usize>,
        samples: usize,
        mixed: &mut [f32],
        inner: &mut Vec<f32>,
        wide: &mut Vec<f32>,
        scores: &mut Vec<f32>,
    ) {
        let (dim, heads) = (self.query.inputs(), self.key.len());
        let (count, width) = (rows.len(), self.query.outputs() / heads);
        let inner = grown(inner, count * heads * width);
        let wide = grown(wide, count * heads * dim);
        self.query.apply(&cached[rows.start * dim..rows.end * dim], inner);
        for (head, key) in self.key.iter().enumerate() {
            let (from, to) = (&inner[head * width..], &mut wide[head * dim..]);
            key.apply_strided(count, (from, heads * width), (to, heads * dim));
        }
        causal_attention(wide, cached, rows.start, [samples, dim, heads], scores);
        for (head, value) in self.value.iter().enumerate() {
            let (from, to) = (&wide[head * dim..], &mut inner[head * width..]);
            value.apply_strided(count, (from, heads * dim), (to, heads * width));
        }
        match &self.out {
            Some(out) => out.apply(inner, mixed),
            None => mixed.copy_from_slice(inner),
        }
    }
}

/// Returns the modulation whose shift is part `shift` and whose scale is the next part.
fn shifted(values: &[f32], shift: usize) -> Modulation<'_> {
    Modulation { values, parts: PARTS, shift, epsilon: MODULATED_EPSILON as f32 }
}

/// Applies a layer to rows if the layer is present; `spare` is scratch memory.
fn through(layer: Option<&Panels>, x: &mut Vec<f32>, spare: &mut Vec<f32>) {
    if let Some(layer) = layer {
        spare.resize(x.len() / layer.inputs() * layer.outputs(), 0.0);
        layer.apply(x, spare);
        std::mem::swap(x, spare);
    }
}
