//! [`Rollout`]: predicting many action sequences from one present, as fast as a CPU does it.
//!
//! The same numbers as [`Lewm::rollout`], computed once where that computes them again:
//!
//! - actions are embedded, and turned into modulations, once for the whole sequence;
//! - keys and values are kept while the window of latents grows; it is computed anew only when it slides, as the
//!   positions of its tokens change then;
//! - in the last layer, and behind it, only the last token is computed;
//! - batch normalisation is folded into the linear layer before it.
//!
//! Rows are ordered by token, then by sample, so that tokens are contiguous. Matrix products are Burn's; what lies
//! between them are plain loops that compilers vectorise.

use super::model::Lewm;
use crate::nn::norm::BatchNorm;
use crate::nn::predictor::MODULATED_EPSILON;
use crate::nn::{LayerNorm, Linear, Projector};
use burn::module::Param;
use burn::tensor::{Tensor, TensorData};

/// The weights a rollout needs.
pub struct Rollout {
    history: usize,
    latent: usize,
    dim: usize,
    heads: usize,
    head: usize,
    action: [Dense; 3],
    positions: Vec<f32>,
    input: Option<Dense>,
    condition: Option<Dense>,
    output: Option<Dense>,
    layers: Vec<Layer>,
    norm: Norm,
    project: [Dense; 2],
}

struct Layer {
    modulation: Dense,
    norm: Norm,
    query: Dense,
    key_value: Dense,
    value: Dense,
    out: Option<Dense>,
    mlp_norm: Norm,
    mlp: [Dense; 2],
}

/// A linear layer: weight `[inputs, outputs]`, and a bias or nothing.
struct Dense {
    weight: Tensor<2>,
    bias: Vec<f32>,
}

impl Dense {
    /// A layer of these weights, laid out in the order of their axes.
    fn of(weight: Tensor<2>, bias: Vec<f32>) -> Self {
        let (shape, device) = (weight.dims(), weight.device());
        Self { weight: Tensor::from_data(TensorData::new(numbers(weight), shape), &device), bias }
    }

    fn new(layer: &Linear) -> Self {
        Self::of(layer.weight.val().transpose(), layer.bias.as_ref().map_or_else(Vec::new, host))
    }

    /// Outputs `from..to` of a layer without bias.
    fn part(layer: &Linear, from: usize, to: usize) -> Self {
        let [_, inputs] = layer.weight.dims();
        Self::of(layer.weight.val().slice([from..to, 0..inputs]).transpose(), vec![])
    }

    /// Rows of inputs to rows of outputs.
    fn forward(&self, x: Vec<f32>) -> Vec<f32> {
        let [inputs, outputs] = self.weight.dims();
        let rows = x.len() / inputs;
        let x = Tensor::<2>::from_data(TensorData::new(x, [rows, inputs]), &self.weight.device());
        let mut y = numbers(x.matmul(self.weight.clone()));
        if !self.bias.is_empty() {
            for row in y.chunks_exact_mut(outputs) {
                for (y, bias) in row.iter_mut().zip(&self.bias) {
                    *y += bias;
                }
            }
        }
        y
    }
}

struct Norm {
    weight: Vec<f32>,
    bias: Vec<f32>,
    epsilon: f32,
}

impl Norm {
    #[allow(clippy::cast_possible_truncation)]
    fn new(layer: &LayerNorm) -> Self {
        Self { weight: host(&layer.weight), bias: host(&layer.bias), epsilon: layer.epsilon() as f32 }
    }

    fn apply(&self, row: &mut [f32]) {
        standardize(row, self.epsilon);
        for ((x, weight), bias) in row.iter_mut().zip(&self.weight).zip(&self.bias) {
            *x = *x * weight + bias;
        }
    }
}

/// Keys and values of the tokens of a window, `[tokens, samples, 2 * inner]`, for one layer.
type Cache = Vec<f32>;

impl Rollout {
    /// The weights of a model.
    pub fn new(model: &Lewm) -> Self {
        let predictor = &model.predictor;
        let config = predictor.config();
        let inner = config.heads * config.dim_head;
        let dense = |layer: &Option<Linear>| layer.as_ref().map(Dense::new);
        let layer = |block: &crate::nn::predictor::Block| Layer {
            modulation: Dense::new(&block.adaLN_modulation._1),
            norm: Norm::new(&block.attn.norm),
            query: Dense::part(&block.attn.to_qkv, 0, inner),
            key_value: Dense::part(&block.attn.to_qkv, inner, 3 * inner),
            value: Dense::part(&block.attn.to_qkv, 2 * inner, 3 * inner),
            out: block.attn.to_out.as_ref().map(|out| Dense::new(&out._0)),
            mlp_norm: Norm::new(&block.mlp.net._0),
            mlp: [Dense::new(&block.mlp.net._1), Dense::new(&block.mlp.net._4)],
        };
        let [_, _, latent] = predictor.pos_embedding.dims();
        let actions = &model.action_encoder;
        let tap = Dense {
            weight: actions.patch_embed.weight.val().squeeze_dim::<2>(2).transpose(),
            bias: host(&actions.patch_embed.bias),
        };
        Self {
            history: config.history,
            latent,
            dim: config.dim,
            heads: config.heads,
            head: config.dim_head,
            action: [tap, Dense::new(&actions.embed._0), Dense::new(&actions.embed._2)],
            positions: numbers(predictor.pos_embedding.val()),
            input: dense(&predictor.transformer.input_proj),
            condition: dense(&predictor.transformer.cond_proj),
            output: dense(&predictor.transformer.output_proj),
            layers: predictor.transformer.layers.iter().map(layer).collect(),
            norm: Norm::new(&predictor.transformer.norm),
            project: fold(&model.pred_proj),
        }
    }

    /// How many of `samples` candidates to run at once: equal parts of at most 80, which fit a core's cache and keep
    /// the matrix products efficient.
    pub fn part(samples: usize) -> usize {
        samples.div_ceil(samples.div_ceil(80).max(1)).max(1)
    }

    /// The latents of a rollout from one present: those given, then one predicted after each further action.
    ///
    /// # Shapes
    /// `start` is `[seen, latent]`, `actions` is `[samples, steps, numbers]` with `steps >= seen`; returns `steps +
    /// 1` times `[samples, latent]`.
    pub fn run(&self, start: &[f32], actions: &[f32], samples: usize, steps: usize) -> Vec<Vec<f32>> {
        let seen = start.len() / self.latent;
        let modulations = self.modulations(actions, samples, steps);
        let mut latents: Vec<Vec<f32>> = start.chunks_exact(self.latent).map(|one| one.repeat(samples)).collect();
        let mut caches: Vec<Cache> = vec![vec![]; self.layers.len()];
        let mut cached = 0;
        for end in seen..=steps {
            let first = end.saturating_sub(self.history);
            if first > 0 {
                caches.iter_mut().for_each(Vec::clear);
                cached = 0;
            }
            let tokens = end - first;
            let fresh = cached..tokens;
            let mut x = Vec::with_capacity(fresh.len() * samples * self.latent);
            for token in fresh.clone() {
                let position = &self.positions[token * self.latent..][..self.latent];
                for row in latents[first + token].chunks_exact(self.latent) {
                    x.extend(row.iter().zip(position).map(|(x, p)| x + p));
                }
            }
            if let Some(input) = &self.input {
                x = input.forward(x);
            }
            for (index, layer) in self.layers.iter().enumerate() {
                let last = index + 1 == self.layers.len();
                let modulation =
                    &modulations[index][(first + fresh.start) * samples * 6 * self.dim..end * samples * 6 * self.dim];
                x = self.layer(layer, x, modulation, &mut caches[index], tokens, samples, last);
            }
            cached = tokens;
            for row in x.chunks_exact_mut(self.dim) {
                self.norm.apply(row);
            }
            if let Some(output) = &self.output {
                x = output.forward(x);
            }
            let [hidden, out] = &self.project;
            let mut hidden = hidden.forward(x);
            gelu(&mut hidden);
            latents.push(out.forward(hidden));
        }
        latents
    }

    /// The modulations of all layers for all actions, each `[steps, samples, 6 * dim]`.
    fn modulations(&self, actions: &[f32], samples: usize, steps: usize) -> Vec<Vec<f32>> {
        let numbers = actions.len() / (samples * steps);
        let mut by_step = Vec::with_capacity(actions.len());
        for step in 0..steps {
            for sample in 0..samples {
                by_step.extend_from_slice(&actions[(sample * steps + step) * numbers..][..numbers]);
            }
        }
        let [tap, hidden, out] = &self.action;
        let mut x = hidden.forward(tap.forward(by_step));
        silu(&mut x);
        x = out.forward(x);
        if let Some(condition) = &self.condition {
            x = condition.forward(x);
        }
        silu(&mut x);
        self.layers.iter().map(|layer| layer.modulation.forward(x.clone())).collect()
    }

    /// One layer on the fresh tokens of a window of `tokens`; the last layer returns the last token only.
    #[allow(clippy::too_many_arguments)]
    fn layer(
        &self,
        layer: &Layer,
        mut x: Vec<f32>,
        mut modulation: &[f32],
        cache: &mut Cache,
        tokens: usize,
        samples: usize,
        last: bool,
    ) -> Vec<f32> {
        let (dim, inner) = (self.dim, self.heads * self.head);
        let y = normal(&x, modulation, 0, &layer.norm);
        let fresh = x.len() / (samples * dim);
        let mut asked = fresh;
        if last && fresh > 1 {
            // From here on, only the last token matters.
            x.drain(..(fresh - 1) * samples * dim);
            modulation = &modulation[(fresh - 1) * samples * 6 * dim..];
            asked = 1;
        }
        // A single token attends to itself alone; its keys are needed only where others will look at it.
        let mut mixed = if self.history == 1 {
            layer.value.forward(y)
        } else {
            let queries = y[(fresh - asked) * samples * dim..].to_vec();
            cache.extend(layer.key_value.forward(y));
            let mut mixed = layer.query.forward(queries);
            for (row, query) in mixed.chunks_exact_mut(inner).enumerate() {
                let (token, sample) = (tokens - asked + row / samples, row % samples);
                self.attend(query, cache, token, sample, samples);
            }
            mixed
        };
        if let Some(out) = &layer.out {
            mixed = out.forward(mixed);
        }
        add_gated(&mut x, &mixed, modulation, dim, 2);
        let [into, out] = &layer.mlp;
        let mut hidden = into.forward(normal(&x, modulation, 3, &layer.mlp_norm));
        gelu(&mut hidden);
        add_gated(&mut x, &out.forward(hidden), modulation, dim, 5);
        x
    }

    /// Replaces the query of one token of one sample by what it attends to among itself and the tokens before it.
    #[allow(clippy::cast_precision_loss)]
    fn attend(&self, query: &mut [f32], cache: &Cache, token: usize, sample: usize, samples: usize) {
        let inner = self.heads * self.head;
        let scale = 1.0 / (self.head as f32).sqrt();
        let row = |other: usize| &cache[(other * samples + sample) * 2 * inner..][..2 * inner];
        let mut weights = vec![0.0f32; token + 1];
        for (head, query) in query.chunks_exact_mut(self.head).enumerate() {
            let columns = head * self.head..(head + 1) * self.head;
            for (other, weight) in weights.iter_mut().enumerate() {
                *weight = dot(query, &row(other)[columns.clone()]) * scale;
            }
            let most = weights.iter().copied().fold(f32::NEG_INFINITY, f32::max);
            weights.iter_mut().for_each(|weight| *weight = (*weight - most).exp());
            let sum: f32 = weights.iter().sum();
            query.fill(0.0);
            for (other, weight) in weights.iter().enumerate() {
                let values = &row(other)[inner..][columns.clone()];
                for (to, value) in query.iter_mut().zip(values) {
                    *to += weight / sum * value;
                }
            }
        }
    }
}

/// Rows standardised, modulated with parts `part` (shift) and `part + 1` (scale) of their modulations, and normalised
/// once more.
#[allow(clippy::cast_possible_truncation)]
fn normal(x: &[f32], modulation: &[f32], part: usize, norm: &Norm) -> Vec<f32> {
    let dim = norm.weight.len();
    let mut y = x.to_vec();
    for (row, modulation) in y.chunks_exact_mut(dim).zip(modulation.chunks_exact(6 * dim)) {
        standardize(row, MODULATED_EPSILON as f32);
        let (shift, scale) = (&modulation[part * dim..][..dim], &modulation[(part + 1) * dim..][..dim]);
        for ((y, shift), scale) in row.iter_mut().zip(shift).zip(scale) {
            *y = *y * (1.0 + scale) + shift;
        }
        norm.apply(row);
    }
    y
}

/// Adds `y`, gated by part `part` of the modulations.
fn add_gated(x: &mut [f32], y: &[f32], modulation: &[f32], dim: usize, part: usize) {
    let rows = x.chunks_exact_mut(dim).zip(y.chunks_exact(dim)).zip(modulation.chunks_exact(6 * dim));
    for ((x, y), modulation) in rows {
        let gate = &modulation[part * dim..][..dim];
        for ((x, y), gate) in x.iter_mut().zip(y).zip(gate) {
            *x += gate * y;
        }
    }
}

/// Mean 0 and variance 1, up to `epsilon`.
#[allow(clippy::cast_precision_loss)]
fn standardize(row: &mut [f32], epsilon: f32) {
    let n = row.len() as f32;
    let mean = sum(row) / n;
    row.iter_mut().for_each(|x| *x -= mean);
    let scale = 1.0 / (dot(row, row) / n + epsilon).sqrt();
    row.iter_mut().for_each(|x| *x *= scale);
}

/// The sum, in eight lanes.
fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 8];
    let chunks = x.chunks_exact(8);
    let rest: f32 = chunks.remainder().iter().sum();
    for chunk in chunks {
        for (lane, x) in lanes.iter_mut().zip(chunk) {
            *lane += x;
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// The scalar product, in eight lanes.
fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 8];
    let (left, right) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = left.remainder().iter().zip(right.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in left.zip(right) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane += a * b;
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// `x Φ(x)`, with the error function of Abramowitz and Stegun 7.1.26, which is off by 1.5e-7 at most.
fn gelu(x: &mut [f32]) {
    for x in x {
        let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
        let t = 1.0 / (1.0 + 0.327_591_1 * z);
        let series = t * (0.254_829_6 + t * (-0.284_496_72 + t * (1.421_413_8 + t * (-1.453_152 + t * 1.061_405_4))));
        let tail = 0.5 * series * exp(-z * z);
        *x *= if *x < 0.0 { tail } else { 1.0 - tail };
    }
}

/// `x / (1 + exp(-x))`.
fn silu(x: &mut [f32]) {
    for x in x {
        let e = exp(-x.abs());
        *x *= if *x < 0.0 { e } else { 1.0 } / (1.0 + e);
    }
}

/// The exponential of a number that is not positive, without branches or calls: a power of two and a polynomial.
fn exp(x: f32) -> f32 {
    /// 1.5 times 2²³: adding it leaves the nearest integer in the low bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.max(-87.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let power = shifted - ROUND;
    let r = (x - power * 0.693_359_4) + power * 2.121_944_4e-4;
    let series =
        1.0 + r * (1.0 + r * (0.5 + r * (0.166_666_57 + r * (0.041_665_796 + r * (8.333_45e-3 + r * 1.398_2e-3)))));
    let scale = f32::from_bits(shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23);
    series * scale
}

/// The two layers of a projection, the normalisation between them folded into the first.
fn fold(projector: &Projector) -> [Dense; 2] {
    let (first, norm) = (&projector.net._0, &projector.net._1);
    let scale = norm.weight.val() / (norm.running_var.val() + BatchNorm::EPSILON).sqrt();
    let bias = match &first.bias {
        Some(bias) => bias.val() - norm.running_mean.val(),
        None => -norm.running_mean.val(),
    };
    let bias = bias * scale.clone() + norm.bias.val();
    let weight = first.weight.val().transpose() * scale.unsqueeze();
    [Dense::of(weight, numbers(bias)), Dense::new(&projector.net._3)]
}

fn host<const D: usize>(param: &Param<Tensor<D>>) -> Vec<f32> {
    numbers(param.val())
}

/// The numbers of a tensor, which are single precision on the CPU.
fn numbers<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.try_into_vec_as::<f32>().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_functions_are_close() {
        for i in -4000..4000 {
            let x = i as f32 / 200.0;
            let mut values = [x];
            if x <= 0.0 {
                assert!((exp(x) - x.exp()).abs() <= 3e-7 * x.exp(), "exp({x}) = {}", exp(x));
            }
            silu(&mut values);
            assert!((values[0] - x / (1.0 + (-x).exp())).abs() < 2e-6, "silu({x})");
        }
        // Values of the normal distribution's table: Φ(1), Φ(-1), Φ(2).
        let mut values = [1.0, -1.0, 2.0, 0.0];
        gelu(&mut values);
        for (value, wanted) in values.into_iter().zip([0.841_344_8, -0.158_655_25, 1.954_499_7, 0.0f32]) {
            assert!((value - wanted).abs() < 4e-7, "{value} for {wanted}");
        }
        let numbers: Vec<f32> = (0..19).map(|i| i as f32).collect();
        assert_eq!((sum(&numbers), dot(&numbers, &numbers)), (171.0, 2109.0));
    }
}
