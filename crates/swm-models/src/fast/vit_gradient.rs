//! [`VitGradient`]: training a [`Vit`] on the CPU, one picture after the other.
//!
//! On the way back, matrix products of the way there are looked up, and what lies between them (normalisations, attention,
//! GELU) is computed again. In the last layer only the class token asks, so nothing else goes back through its
//! feed-forward part.

use super::functions::{add_rows, gelu, gelu_tangent, multiply, multiply_add, softmax, softmax_backward};
use super::norm::{add, backward};
use super::vit::FastVit;
use super::{Panels, grown, numbers};
use crate::nn::parameters::Named;
use crate::nn::{Linear, Vit};

/// A vision transformer, laid out for both ways.
pub struct VitGradient {
    there: FastVit,
    back: Vec<Back>,
}

/// The matrices of a layer on the way back, `[outputs, inputs]`.
struct Back {
    qkv: Panels,
    out: Panels,
    into: Panels,
    output: Panels,
}

/// What is kept of a picture.
pub struct Tape {
    layers: Vec<LayerTape>,
    /// The class token behind the last layer, `[dim]`.
    last: Vec<f32>,
}

struct LayerTape {
    /// What went in, `[tokens, dim]`.
    x: Vec<f32>,
    /// Queries (scaled), keys and values, `[tokens, 3 * dim]`.
    qkv: Vec<f32>,
    /// Behind the attention, `[asked, dim]`.
    middle: Vec<f32>,
    /// Before GELU, `[asked, mlp]`.
    hidden: Vec<f32>,
}

/// Sums of gradients: the matrix of a linear layer and its bias, or the scale and shift of a normalisation.
struct Pair {
    weight: Vec<f32>,
    bias: Vec<f32>,
}

impl Pair {
    fn new(inputs: usize, outputs: usize) -> Self {
        Self { weight: vec![0.0; inputs * outputs], bias: vec![0.0; outputs] }
    }

    fn norm(&mut self) -> [&mut [f32]; 2] {
        [&mut self.weight, &mut self.bias]
    }

    /// A linear layer saw rows `x`, held by `panels`, and its result has the gradient `dy`.
    fn linear(&mut self, panels: &mut Panels, x: &[f32], dy: &[f32]) {
        let (inputs, outputs) = (panels.outputs(), self.bias.len());
        panels.fill_rows(x.len() / inputs, (x, inputs));
        panels.add_transposed(outputs, (dy, outputs), (&mut self.weight, inputs));
        add_rows(&mut self.bias, dy);
    }
}

/// Sums of the gradients of pictures.
pub struct Sums {
    layers: Vec<LayerSums>,
    norm: Pair,
    /// `[tokens, dim]`.
    positions: Vec<f32>,
    patches: Pair,
}

struct LayerSums {
    before: Pair,
    qkv: Pair,
    out: Pair,
    after: Pair,
    into: Pair,
    output: Pair,
}

/// Memory that pictures share.
pub struct Scratch {
    narrow: Vec<f32>,
    mixed: Vec<f32>,
    dmixed: Vec<f32>,
    wide: Vec<f32>,
    slopes: Vec<f32>,
    dwide: Vec<f32>,
    scores: Vec<f32>,
    dscores: Vec<f32>,
    dqkv: Vec<f32>,
    /// Of as many columns as a head, a picture's tokens, a token, a hidden layer and a patch have numbers.
    head: Panels,
    tokens: Panels,
    dim: Panels,
    hidden: Panels,
    patch: Panels,
}

impl VitGradient {
    /// The weights of a transformer for pictures of so many patches; none where positions are resampled.
    pub fn new(vit: &Vit, patches: usize) -> Option<Self> {
        let [_, learnt, dim] = vit.embeddings.position_embeddings.dims();
        let heads = vit.encoder.layer.first()?.attention.heads();
        if learnt != 1 + patches {
            return None;
        }
        let weight = |linear: &Linear| numbers(linear.weight.val());
        let back = (vit.encoder.layer.iter())
            .map(|layer| {
                let parts = &layer.attention.attention;
                let mut query = weight(&parts.query);
                query.iter_mut().for_each(|weight| *weight *= scale(dim, heads));
                let mlp = layer.output.dense.weight.dims()[1];
                Back {
                    qkv: rows(&[query, weight(&parts.key), weight(&parts.value)].concat(), dim),
                    out: rows(&weight(&layer.attention.output.dense), dim),
                    into: rows(&weight(&layer.intermediate.dense), dim),
                    output: rows(&weight(&layer.output.dense), mlp),
                }
            })
            .collect();
        Some(Self { there: FastVit::new(vit, heads, patches), back })
    }

    /// Numbers of a class token.
    pub fn dim(&self) -> usize {
        self.there.dim
    }

    fn tokens(&self) -> usize {
        self.there.positions.len() / self.there.dim
    }

    /// Memory for pictures that are computed one after the other.
    pub fn scratch(&self) -> Scratch {
        let (dim, heads) = (self.there.dim, self.there.heads);
        let mlp = self.back.first().map_or(0, |back| back.output.outputs());
        Scratch {
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
            patch: rows(&[], self.there.embed.inputs()),
        }
    }

    /// Sums of no pictures.
    pub fn sums(&self) -> Sums {
        let dim = self.there.dim;
        let layer = |back: &Back| LayerSums {
            before: Pair::new(1, dim),
            qkv: Pair::new(dim, 3 * dim),
            out: Pair::new(dim, dim),
            after: Pair::new(1, dim),
            into: Pair::new(dim, back.output.outputs()),
            output: Pair::new(back.output.outputs(), dim),
        };
        Sums {
            layers: self.back.iter().map(layer).collect(),
            norm: Pair::new(1, dim),
            positions: vec![0.0; self.there.positions.len()],
            patches: Pair::new(self.there.embed.inputs(), dim),
        }
    }

    /// The class token of a picture, `[dim]`, and what its way back needs.
    ///
    /// # Shapes
    /// `patches` is `[patches, 3 * patch * patch]`.
    pub fn forward(&self, patches: &[f32], scratch: &mut Scratch) -> (Vec<f32>, Tape) {
        let (there, dim, tokens) = (&self.there, self.there.dim, self.tokens());
        let mut x = there.positions.clone();
        let embedded = grown(&mut scratch.narrow, (tokens - 1) * dim);
        there.embed.apply(patches, embedded);
        add(&mut x[dim..], embedded);
        let mut tape = Tape { layers: Vec::with_capacity(there.layers.len()), last: vec![] };
        for (index, layer) in there.layers.iter().enumerate() {
            let asked = if index + 1 == there.layers.len() { 1 } else { tokens };
            let mut qkv = vec![0.0; tokens * 3 * dim];
            let narrow = grown(&mut scratch.narrow, tokens * dim);
            layer.before.apply(&x, narrow);
            layer.qkv.apply(narrow, &mut qkv);
            for head in 0..there.heads {
                self.shares(&qkv, asked, head, scratch);
                self.mix(&qkv, asked, head, scratch);
            }
            let mut middle = vec![0.0; asked * dim];
            layer.out.apply(&scratch.mixed[..asked * dim], &mut middle);
            add(&mut middle, &x[..asked * dim]);
            let narrow = grown(&mut scratch.narrow, asked * dim);
            layer.after.apply(&middle, narrow);
            let [into, out] = &layer.mlp;
            let mut hidden = vec![0.0; asked * into.outputs()];
            into.apply(narrow, &mut hidden);
            let wide = grown(&mut scratch.wide, hidden.len());
            wide.copy_from_slice(&hidden);
            gelu(wide);
            let mut next = vec![0.0; asked * dim];
            out.apply(wide, &mut next);
            add(&mut next, &middle);
            tape.layers.push(LayerTape { x, qkv, middle, hidden });
            x = next;
        }
        let mut class = vec![0.0; dim];
        there.norm.apply(&x[..dim], &mut class);
        tape.last = x;
        (class, tape)
    }

    /// What the tokens asked see of the others in one head, `[asked, tokens]`, into the scores.
    fn shares(&self, qkv: &[f32], asked: usize, head: usize, scratch: &mut Scratch) {
        let (dim, tokens) = (self.there.dim, self.tokens());
        let width = dim / self.there.heads;
        let keys = &qkv[dim + head * width..];
        scratch.tokens.fill(width, |i, token| keys[token * 3 * dim + i]);
        let scores = grown(&mut scratch.scores, asked * tokens);
        scratch.tokens.apply_strided(asked, (&qkv[head * width..], 3 * dim), (scores, tokens));
        softmax(scores, tokens);
    }

    /// The values so seen, into their columns of what is mixed.
    fn mix(&self, qkv: &[f32], asked: usize, head: usize, scratch: &mut Scratch) {
        let (dim, tokens) = (self.there.dim, self.tokens());
        let width = dim / self.there.heads;
        scratch.head.fill_rows(tokens, (&qkv[2 * dim + head * width..], 3 * dim));
        let mixed = grown(&mut scratch.mixed, asked * dim);
        scratch.head.apply_strided(asked, (&scratch.scores, tokens), (&mut mixed[head * width..], dim));
    }

    /// Adds the gradients of a picture, whose class token has the gradient `d`.
    pub fn backward(&self, patches: &[f32], tape: &Tape, d: &[f32], sums: &mut Sums, scratch: &mut Scratch) {
        let (there, dim, tokens) = (&self.there, self.there.dim, self.tokens());
        let width = dim / there.heads;
        let mut dx = vec![0.0; tape.last.len()];
        backward(&there.norm, &tape.last, d, &mut dx, sums.norm.norm());
        let layers = there.layers.iter().zip(&self.back).zip(&tape.layers).zip(&mut sums.layers);
        for (((layer, back), tape), sums) in layers.rev() {
            let asked = tape.middle.len() / dim;
            // The feed-forward part.
            let activated = grown(&mut scratch.wide, tape.hidden.len());
            let slopes = grown(&mut scratch.slopes, tape.hidden.len());
            activated.copy_from_slice(&tape.hidden);
            gelu_tangent(activated, slopes);
            multiply_add(activated, &tape.hidden, slopes);
            sums.output.linear(&mut scratch.hidden, activated, &dx);
            let dhidden = grown(&mut scratch.dwide, tape.hidden.len());
            back.output.apply(&dx, dhidden);
            multiply(dhidden, slopes);
            let narrow = grown(&mut scratch.narrow, asked * dim);
            layer.after.apply(&tape.middle, narrow);
            sums.into.linear(&mut scratch.dim, narrow, dhidden);
            back.into.apply(dhidden, narrow);
            backward(&layer.after, &tape.middle, narrow, &mut dx, sums.after.norm());
            // The attention.
            let dmixed = grown(&mut scratch.dmixed, asked * dim);
            back.out.apply(&dx, dmixed);
            let dqkv = grown(&mut scratch.dqkv, tokens * 3 * dim);
            dqkv.fill(0.0);
            for head in 0..there.heads {
                self.shares(&tape.qkv, asked, head, scratch);
                self.mix(&tape.qkv, asked, head, scratch);
                let (query, key, value) = (head * width, dim + head * width, 2 * dim + head * width);
                let (shares, dqkv) = (&scratch.scores[..asked * tokens], &mut scratch.dqkv[..]);
                let dmixed = &scratch.dmixed[query..];
                scratch.head.fill_rows(asked, (dmixed, dim));
                scratch.head.add_transposed(tokens, (shares, tokens), (&mut dqkv[value..], 3 * dim));
                let values = &tape.qkv[value..];
                scratch.tokens.fill(width, |i, token| values[token * 3 * dim + i]);
                let dscores = grown(&mut scratch.dscores, asked * tokens);
                scratch.tokens.apply_strided(asked, (dmixed, dim), (dscores, tokens));
                softmax_backward(shares, dscores, tokens);
                scratch.head.fill_rows(tokens, (&tape.qkv[key..], 3 * dim));
                scratch.head.apply_strided(asked, (dscores, tokens), (&mut dqkv[query..], 3 * dim));
                scratch.head.fill_rows(asked, (&tape.qkv[query..], 3 * dim));
                scratch.head.add_transposed(tokens, (dscores, tokens), (&mut dqkv[key..], 3 * dim));
            }
            sums.out.linear(&mut scratch.dim, &scratch.mixed[..asked * dim], &dx);
            let narrow = grown(&mut scratch.narrow, tokens * dim);
            layer.before.apply(&tape.x, narrow);
            let dqkv = &scratch.dqkv[..tokens * 3 * dim];
            sums.qkv.linear(&mut scratch.dim, narrow, dqkv);
            back.qkv.apply(dqkv, narrow);
            dx.resize(tokens * dim, 0.0);
            backward(&layer.before, &tape.x, narrow, &mut dx, sums.before.norm());
        }
        add(&mut sums.positions, &dx);
        sums.patches.linear(&mut scratch.patch, patches, &dx[dim..]);
    }

    /// The sums by published names.
    pub fn named(&self, sums: Sums) -> Named<Vec<f32>> {
        let dim = self.there.dim;
        let mut named = Named::new();
        named.insert("embeddings.cls_token".to_owned(), sums.positions[..dim].to_vec());
        named.insert("embeddings.position_embeddings".to_owned(), sums.positions);
        let mut put = |name: String, pair: Pair| {
            named.insert(format!("{name}.weight"), pair.weight);
            named.insert(format!("{name}.bias"), pair.bias);
        };
        put("embeddings.patch_embeddings.projection".to_owned(), sums.patches);
        put("layernorm".to_owned(), sums.norm);
        for (index, layer) in sums.layers.into_iter().enumerate() {
            let name = |part: &str| format!("encoder.layer.{index}.{part}");
            for (part, of) in ["query", "key", "value"].into_iter().enumerate() {
                // Queries were scaled together with their weights.
                let scale = if part == 0 { scale(dim, self.there.heads) } else { 1.0 };
                let cut = |all: &[f32], one: usize| -> Vec<f32> {
                    all[part * one..][..one].iter().map(|gradient| gradient * scale).collect()
                };
                let pair = Pair { weight: cut(&layer.qkv.weight, dim * dim), bias: cut(&layer.qkv.bias, dim) };
                put(name(&format!("attention.attention.{of}")), pair);
            }
            put(name("layernorm_before"), layer.before);
            put(name("attention.output.dense"), layer.out);
            put(name("layernorm_after"), layer.after);
            put(name("intermediate.dense"), layer.into);
            put(name("output.dense"), layer.output);
        }
        named
    }
}

/// What queries are scaled by.
#[allow(clippy::cast_precision_loss)]
pub(super) fn scale(dim: usize, heads: usize) -> f32 {
    1.0 / ((dim / heads) as f32).sqrt()
}

/// Rows of `columns` numbers as a matrix.
fn rows(matrix: &[f32], columns: usize) -> Panels {
    let mut panels = Panels::new(0, columns, |_, _| 0.0);
    panels.fill_rows(matrix.len() / columns, (matrix, columns));
    panels
}
