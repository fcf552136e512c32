//! [`VitGradient`]: gradients of a vision transformer's parameters, one image after the other.
//!
//! The backward pass reads the matrix products that the forward pass stored, and recomputes the operations between the
//! products (normalisations, attention, GELU). The last layer computes only the class token, so no gradient of another
//! token passes through the last feed-forward block.

use crate::functions::{add, gelu, gelu_tangent, multiply, multiply_add, softmax, softmax_backward};
use crate::norm::backward;
use crate::vit::query_scale;
use crate::{Affine, Panels, VitEncoder, VitLayerParameters, VitParameters, grown};

/// A vision transformer laid out for forward and backward passes.
pub struct VitGradient {
    encoder: VitEncoder,
    transposed: Vec<TransposedLayer>,
}

/// The matrices of a layer for the backward pass, `[outputs, inputs]`.
struct TransposedLayer {
    qkv: Panels,
    out: Panels,
    into: Panels,
    output: Panels,
}

/// Activations of one image that the backward pass reads.
pub struct Tape {
    layers: Vec<LayerTape>,
    /// The tokens after the last layer, `[1, dim]`.
    last: Vec<f32>,
}

struct LayerTape {
    /// Input of the layer, `[tokens, dim]`.
    x: Vec<f32>,
    /// Scaled queries, keys and values, `[tokens, 3 * dim]`.
    qkv: Vec<f32>,
    /// Tokens after the attention, `[queries, dim]`.
    middle: Vec<f32>,
    /// Inputs of GELU, `[queries, mlp]`.
    hidden: Vec<f32>,
}

/// Sums of the gradients of several images.
pub struct VitGradientSums {
    layers: Vec<LayerSums>,
    norm: Affine,
    /// The gradients of the class token and the position embeddings, `[tokens, dim]`.
    positions: Vec<f32>,
    patches: Affine,
}

struct LayerSums {
    before: Affine,
    qkv: Affine,
    out: Affine,
    after: Affine,
    into: Affine,
    output: Affine,
}

/// Memory that is reused from image to image.
pub struct VitGradientScratch {
    narrow: Vec<f32>,
    mixed: Vec<f32>,
    dmixed: Vec<f32>,
    wide: Vec<f32>,
    slopes: Vec<f32>,
    dwide: Vec<f32>,
    scores: Vec<f32>,
    dscores: Vec<f32>,
    dqkv: Vec<f32>,
    /// Panels with as many columns as the dimension of a head.
    head: Panels,
    /// Panels with as many columns as an image has tokens.
    tokens: Panels,
    /// Panels with as many columns as the dimension of a token.
    dim: Panels,
    /// Panels with as many columns as the hidden layer of the feed-forward block.
    hidden: Panels,
    /// Panels with as many columns as a patch has elements.
    patch: Panels,
}

impl VitGradient {
    /// Lays out the parameters of a transformer with `heads` attention heads, whose normalisations add `epsilon` to the
    /// variance.
    pub fn new(parameters: &VitParameters, heads: usize, epsilon: f32) -> Self {
        let dim = parameters.norm.bias.len();
        let transposed = (parameters.layers.iter())
            .map(|layer| {
                let mut query = layer.query.weight.clone();
                query.iter_mut().for_each(|weight| *weight *= query_scale(dim, heads));
                TransposedLayer {
                    qkv: rows(&[&query[..], &layer.key.weight, &layer.value.weight].concat(), dim),
                    out: rows(&layer.attention_output.weight, dim),
                    into: rows(&layer.intermediate.weight, dim),
                    output: rows(&layer.output.weight, layer.intermediate.bias.len()),
                }
            })
            .collect();
        Self { encoder: VitEncoder::new(parameters, heads, epsilon), transposed }
    }

    /// Returns the dimension of the class token.
    pub fn dim(&self) -> usize {
        self.encoder.dim
    }

    fn tokens(&self) -> usize {
        self.encoder.positions.len() / self.encoder.dim
    }

    /// Returns memory for images that are computed one after the other.
    pub fn scratch(&self) -> VitGradientScratch {
        let (dim, heads) = (self.encoder.dim, self.encoder.heads);
        let mlp = self.transposed.first().map_or(0, |layer| layer.output.outputs());
        VitGradientScratch {
            narrow: vec![],
            mixed: vec![],
            dmixed: vec![],
            wide: vec![],
            slopes: vec![],
            dwide: vec![],
            scores: vec![],
            dscores: vec![],
            dqkv: vec![],
            head: rows(&[], dim / heads),
            tokens: rows(&[], self.tokens()),
            dim: rows(&[], dim),
            hidden: rows(&[], mlp),
            patch: rows(&[], self.encoder.embed.inputs()),
        }
    }

    /// Returns zero-initialised gradient sums.
    pub fn sums(&self) -> VitGradientSums {
        let dim = self.encoder.dim;
        let layer = |layer: &TransposedLayer| LayerSums {
            before: Affine::zeros(1, dim),
            qkv: Affine::zeros(dim, 3 * dim),
            out: Affine::zeros(dim, dim),
            after: Affine::zeros(1, dim),
            into: Affine::zeros(dim, layer.output.outputs()),
            output: Affine::zeros(layer.output.outputs(), dim),
        };
        VitGradientSums {
            layers: self.transposed.iter().map(layer).collect(),
            norm: Affine::zeros(1, dim),
            positions: vec![0.0; self.encoder.positions.len()],
            patches: Affine::zeros(self.encoder.embed.inputs(), dim),
        }
    }

    /// Returns the class token of an image and the activations that [`VitGradient::backward`] reads.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`; the class token is `[dim]`.
    pub fn forward(&self, patches: &[f32], scratch: &mut VitGradientScratch) -> (Vec<f32>, Tape) {
        let (encoder, dim, tokens) = (&self.encoder, self.encoder.dim, self.tokens());
        let mut x = encoder.positions.clone();
        let embedded = grown(&mut scratch.narrow, (tokens - 1) * dim);
        encoder.embed.apply(patches, embedded);
        add(&mut x[dim..], embedded);
        let mut tape = Tape { layers: Vec::with_capacity(encoder.layers.len()), last: vec![] };
        for (index, layer) in encoder.layers.iter().enumerate() {
            let queries = if index + 1 == encoder.layers.len() { 1 } else { tokens };
            let mut qkv = vec![0.0; tokens * 3 * dim];
            let narrow = grown(&mut scratch.narrow, tokens * dim);
            layer.before.apply(&x, narrow);
            layer.qkv.apply(narrow, &mut qkv);
            for head in 0..encoder.heads {
                self.attention_weights(&qkv, queries, head, scratch);
                self.mix_values(&qkv, queries, head, scratch);
            }
            let mut middle = vec![0.0; queries * dim];
            layer.out.apply(&scratch.mixed[..queries * dim], &mut middle);
            add(&mut middle, &x[..queries * dim]);
            let narrow = grown(&mut scratch.narrow, queries * dim);
            layer.after.apply(&middle, narrow);
            let [into, out] = &layer.mlp;
            let mut hidden = vec![0.0; queries * into.outputs()];
            into.apply(narrow, &mut hidden);
            let wide = grown(&mut scratch.wide, hidden.len());
            wide.copy_from_slice(&hidden);
            gelu(wide);
            let mut next = vec![0.0; queries * dim];
            out.apply(wide, &mut next);
            add(&mut next, &middle);
            tape.layers.push(LayerTape { x, qkv, middle, hidden });
            x = next;
        }
        let mut class = vec![0.0; dim];
        encoder.norm.apply(&x[..dim], &mut class);
        tape.last = x;
        (class, tape)
    }

    /// Writes the attention weights of one head, `[queries, tokens]`, to `scratch.scores`.
    fn attention_weights(&self, qkv: &[f32], queries: usize, head: usize, scratch: &mut VitGradientScratch) {
        let (dim, tokens) = (self.encoder.dim, self.tokens());
        let width = dim / self.encoder.heads;
        let keys = &qkv[dim + head * width..];
        scratch.tokens.fill(width, |i, token| keys[token * 3 * dim + i]);
        let scores = grown(&mut scratch.scores, queries * tokens);
        scratch.tokens.apply_strided(queries, (&qkv[head * width..], 3 * dim), (scores, tokens));
        softmax(scores, tokens);
    }

    /// Writes the values of one head, weighted by `scratch.scores`, to the head's columns of `scratch.mixed`.
    fn mix_values(&self, qkv: &[f32], queries: usize, head: usize, scratch: &mut VitGradientScratch) {
        let (dim, tokens) = (self.encoder.dim, self.tokens());
        let width = dim / self.encoder.heads;
        scratch.head.fill_rows(tokens, (&qkv[2 * dim + head * width..], 3 * dim));
        let mixed = grown(&mut scratch.mixed, queries * dim);
        scratch.head.apply_strided(queries, (&scratch.scores, tokens), (&mut mixed[head * width..], dim));
    }

    /// Adds the gradients of an image, whose class token has the gradient `d`, to `sums`.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`, `d` is `[dim]`.
    pub fn backward(
        &self,
        patches: &[f32],
        tape: &Tape,
        d: &[f32],
        sums: &mut VitGradientSums,
        scratch: &mut VitGradientScratch,
    ) {
        let (encoder, dim, tokens) = (&self.encoder, self.encoder.dim, self.tokens());
        let mut dx = vec![0.0; tape.last.len()];
        backward(&encoder.norm, &tape.last, d, &mut dx, sums.norm.as_mut());
        let layers = encoder.layers.iter().zip(&self.transposed).zip(&tape.layers).zip(&mut sums.layers);
        for (((layer, transposed), tape), sums) in layers.rev() {
            let queries = tape.middle.len() / dim;
            // Backward pass of the feed-forward block.
            let activated = grown(&mut scratch.wide, tape.hidden.len());
            let slopes = grown(&mut scratch.slopes, tape.hidden.len());
            activated.copy_from_slice(&tape.hidden);
            gelu_tangent(activated, slopes);
            multiply_add(activated, &tape.hidden, slopes);
            sums.output.add_linear_gradient(&mut scratch.hidden, activated, &dx);
            let dhidden = grown(&mut scratch.dwide, tape.hidden.len());
            transposed.output.apply(&dx, dhidden);
            multiply(dhidden, slopes);
            let narrow = grown(&mut scratch.narrow, queries * dim);
            layer.after.apply(&tape.middle, narrow);
            sums.into.add_linear_gradient(&mut scratch.dim, narrow, dhidden);
            transposed.into.apply(dhidden, narrow);
            backward(&layer.after, &tape.middle, narrow, &mut dx, sums.after.as_mut());
            // Backward pass of the attention.
            let dmixed = grown(&mut scratch.dmixed, queries * dim);
            transposed.out.apply(&dx, dmixed);
            grown(&mut scratch.dqkv, tokens * 3 * dim).fill(0.0);
            for head in 0..encoder.heads {
                self.attention_weights(&tape.qkv, queries, head, scratch);
                self.mix_values(&tape.qkv, queries, head, scratch);
                self.head_backward(&tape.qkv, queries, head, scratch);
            }
            sums.out.add_linear_gradient(&mut scratch.dim, &scratch.mixed[..queries * dim], &dx);
            let narrow = grown(&mut scratch.narrow, tokens * dim);
            layer.before.apply(&tape.x, narrow);
            let dqkv = &scratch.dqkv[..tokens * 3 * dim];
            sums.qkv.add_linear_gradient(&mut scratch.dim, narrow, dqkv);
            transposed.qkv.apply(dqkv, narrow);
            dx.resize(tokens * dim, 0.0);
            backward(&layer.before, &tape.x, narrow, &mut dx, sums.before.as_mut());
        }
        add(&mut sums.positions, &dx);
        sums.patches.add_linear_gradient(&mut scratch.patch, patches, &dx[dim..]);
    }

    /// Adds the gradients of one head's queries, keys and values, `[tokens, 3 * dim]`, to `scratch.dqkv`, from
    /// `scratch.dmixed` and the attention weights in `scratch.scores`.
    fn head_backward(&self, qkv: &[f32], queries: usize, head: usize, scratch: &mut VitGradientScratch) {
        let (dim, tokens) = (self.encoder.dim, self.tokens());
        let width = dim / self.encoder.heads;
        let (query, key, value) = (head * width, dim + head * width, 2 * dim + head * width);
        let (weights, dqkv) = (&scratch.scores[..queries * tokens], &mut scratch.dqkv[..]);
        let dmixed = &scratch.dmixed[query..];
        scratch.head.fill_rows(queries, (dmixed, dim));
        scratch.head.add_transposed(tokens, (weights, tokens), (&mut dqkv[value..], 3 * dim));
        let values = &qkv[value..];
        scratch.tokens.fill(width, |i, token| values[token * 3 * dim + i]);
        let dscores = grown(&mut scratch.dscores, queries * tokens);
        scratch.tokens.apply_strided(queries, (dmixed, dim), (dscores, tokens));
        softmax_backward(weights, dscores, tokens);
        scratch.head.fill_rows(tokens, (&qkv[key..], 3 * dim));
        scratch.head.apply_strided(queries, (dscores, tokens), (&mut dqkv[query..], 3 * dim));
        scratch.head.fill_rows(queries, (&qkv[query..], 3 * dim));
        scratch.head.add_transposed(tokens, (dscores, tokens), (&mut dqkv[key..], 3 * dim));
    }

    /// Returns the summed gradients in the form of the parameters.
    pub fn gradients(&self, sums: VitGradientSums) -> VitParameters {
        VitParameters {
            patches: sums.patches,
            positions: sums.positions,
            layers: sums.layers.into_iter().map(|layer| self.layer_gradients(layer)).collect(),
            norm: sums.norm,
        }
    }

    fn layer_gradients(&self, sums: LayerSums) -> VitLayerParameters {
        let dim = self.encoder.dim;
        let projection = |index: usize, factor: f32| {
            let cut = |all: &[f32], length: usize| -> Vec<f32> {
                all[index * length..][..length].iter().map(|gradient| gradient * factor).collect()
            };
            Affine { weight: cut(&sums.qkv.weight, dim * dim), bias: cut(&sums.qkv.bias, dim) }
        };
        VitLayerParameters {
            // The forward pass scales the weights of the queries, so the gradients are scaled too.
            query: projection(0, query_scale(dim, self.encoder.heads)),
            key: projection(1, 1.0),
            value: projection(2, 1.0),
            norm_before: sums.before,
            attention_output: sums.out,
            norm_after: sums.after,
            intermediate: sums.into,
            output: sums.output,
        }
    }
}

/// Lays out a matrix with rows of `columns` elements.
fn rows(matrix: &[f32], columns: usize) -> Panels {
    let mut panels = Panels::new(0, columns, |_, _| 0.0);
    panels.fill_rows(matrix.len() / columns, (matrix, columns));
    panels
}
