//! [`DeviceRollout`]: rollouts of many action sequences on a GPU.
//!
//! The result equals [`Lewm::rollout`] up to rounding, with less work and fewer kernels:
//!
//! - the modulations of all layers and steps are one matrix product;
//! - keys and values are cached while the window of latents grows, and recomputed only when the window slides;
//! - the last layer and all later modules compute only the last token;
//! - normalisations with fixed scales and shifts are folded into the linear layers after or before them;
//! - costs are computed on the device, so that a call returns one scalar per candidate.
//!
//! Rows are ordered by token, then by candidate. With half precision, matrix products read half-precision factors; everything
//! else is computed in single precision.

use super::model::Lewm;
use crate::device::Precision;
use crate::nn::norm::standardize;
use crate::nn::predictor::{Block, MODULATED_EPSILON};
use crate::nn::{Activation, BatchNorm, Embedder, LayerNorm, Linear, Projector};

use burn::tensor::{Device, Tensor, TensorData, activation};

/// Parts of a modulation: shift, scale and gate of the attention, then of the feed-forward block.
const PARTS: usize = 6;

/// The weights of a model, laid out for rollouts on its device.
pub(super) struct DeviceRollout {
    history: usize,
    latent: usize,
    dim: usize,
    heads: usize,
    action: Embedder,
    /// The position embeddings, `[1, latent]` each.
    positions: Vec<Tensor<2>>,
    input: Option<Dense>,
    condition: Option<Dense>,
    output: Option<Dense>,
    /// The modulations of all layers, `[dim, layers * 6 * dim]`.
    modulation: Dense,
    layers: Vec<Layer>,
    norm: LayerNorm,
    project: [Dense; 2],
    device: Device,
}

/// A linear layer whose weights are in the precision of the matrix product.
struct Dense {
    /// `[inputs, outputs]`
    weight: Tensor<2>,
    /// `[1, outputs]`
    bias: Option<Tensor<2>>,
    precision: Precision,
}

struct Layer {
    /// The joint projection to queries, keys and values, after the normalisation's scale and shift.
    qkv: Dense,
    out: Option<Dense>,
    mlp: [Dense; 2],
    /// What the two normalisations add to the variance.
    epsilons: [f64; 2],
}

/// The cached keys and values of a layer, `[tokens, rows, heads * width]` each.
type Cached = Option<(Tensor<3>, Tensor<3>)>;

impl Dense {
    fn new(weight: Tensor<2>, bias: Option<Tensor<1>>, precision: Precision) -> Self {
        Self { weight: precision.lower(weight.transpose()), bias: bias.map(Tensor::unsqueeze), precision }
    }

    fn of(layer: &Linear, precision: Precision) -> Self {
        Self::new(layer.weight.val(), layer.bias.as_ref().map(|bias| bias.val()), precision)
    }

    /// A layer after a normalisation, whose scale and shift become part of the layer.
    fn after(norm: &LayerNorm, layer: &Linear, precision: Precision) -> Self {
        let weight = layer.weight.val();
        let shift = weight.clone().matmul(norm.bias.val().unsqueeze_dim::<2>(1)).squeeze_dim::<1>(1);
        let bias = match &layer.bias {
            Some(bias) => bias.val() + shift,
            None => shift,
        };
        Self::new(weight * norm.weight.val().unsqueeze(), Some(bias), precision)
    }

    /// The two layers of a projector; the first includes the batch normalisation.
    fn projector(projector: &Projector, precision: Precision) -> [Self; 2] {
        let (first, norm) = (&projector.net._0, &projector.net._1);
        let scale = norm.weight.val() / (norm.running_var.val() + BatchNorm::EPSILON).sqrt();
        let shift = match &first.bias {
            Some(bias) => bias.val() - norm.running_mean.val(),
            None => -norm.running_mean.val(),
        };
        let bias = shift * scale.clone() + norm.bias.val();
        let weight = first.weight.val() * scale.unsqueeze_dim::<2>(1);
        [Self::new(weight, Some(bias), precision), Self::of(&projector.net._3, precision)]
    }

    /// Maps `[rows, inputs]` to `[rows, outputs]`.
    fn apply(&self, x: Tensor<2>) -> Tensor<2> {
        let y = self.precision.raise(self.precision.lower(x).matmul(self.weight.clone()));
        match &self.bias {
            Some(bias) => y + bias.clone(),
            None => y,
        }
    }
}

impl DeviceRollout {
    /// Lays out the weights of a model, on the model's device.
    pub fn new(model: &Lewm, precision: Precision) -> Self {
        let predictor = &model.predictor;
        let (config, parts) = (predictor.config(), &predictor.transformer);
        let latent = model.latent();
        let dense = |layer: &Option<Linear>| layer.as_ref().map(|layer| Dense::of(layer, precision));
        let positions = predictor.pos_embedding.val().squeeze_dim::<2>(0);
        let modulations = |part: fn(&Linear) -> Tensor<2>| {
            Tensor::cat(parts.layers.iter().map(|block| part(&block.adaLN_modulation._1)).collect(), 0)
        };
        let bias = modulations(|layer| match &layer.bias {
            Some(bias) => bias.val().unsqueeze_dim(1),
            None => Tensor::zeros([layer.weight.dims()[0], 1], &layer.weight.val().device()),
        });
        let layer = |block: &Block| Layer {
            qkv: Dense::after(&block.attn.norm, &block.attn.to_qkv, precision),
            out: block.attn.to_out.as_ref().map(|out| Dense::of(&out._0, precision)),
            mlp: [
                Dense::after(&block.mlp.net._0, &block.mlp.net._1, precision),
                Dense::of(&block.mlp.net._4, precision),
            ],
            epsilons: [block.attn.norm.epsilon(), block.mlp.net._0.epsilon()],
        };
        Self {
            history: config.history,
            latent,
            dim: config.dim,
            heads: config.heads,
            action: model.action_encoder.clone(),
            positions: (0..config.history).map(|i| positions.clone().slice([i..i + 1, 0..latent])).collect(),
            input: dense(&parts.input_proj),
            condition: dense(&parts.cond_proj),
            output: dense(&parts.output_proj),
            modulation: Dense::new(modulations(|layer| layer.weight.val()), Some(bias.squeeze_dim(1)), precision),
            layers: parts.layers.iter().map(layer).collect(),
            norm: parts.norm.clone(),
            project: Dense::projector(&model.pred_proj, precision),
            device: model.device(),
        }
    }

    /// Returns the squared distances between the last latents of rollouts and goals.
    ///
    /// # Shapes
    /// `starts` is `[envs, frames, latent]`, `goals` is `[envs, latent]`, `actions` is `[envs, samples, steps, action_dim]` with
    /// `steps >= frames`; returns `[envs * samples]`.
    pub fn costs(
        &self,
        starts: Vec<f32>,
        goals: Vec<f32>,
        actions: Vec<f32>,
        samples: usize,
        steps: usize,
    ) -> Tensor<1> {
        let (latent, envs) = (self.latent, goals.len() / self.latent);
        let (frames, rows) = (starts.len() / goals.len(), envs * samples);
        let starts = Tensor::<4>::from_data(TensorData::new(starts, [envs, 1, frames, latent]), &self.device);
        let each = |t: usize| {
            let frame = starts.clone().slice([0..envs, 0..1, t..t + 1, 0..latent]).reshape([envs, 1, latent]);
            frame.expand([envs, samples, latent]).reshape([rows, latent])
        };
        let goals = Tensor::<3>::from_data(TensorData::new(goals, [envs, 1, latent]), &self.device);
        let goals = goals.expand([envs, samples, latent]).reshape([rows, latent]);
        let width = actions.len() / (rows * steps);
        let actions = Tensor::<3>::from_data(TensorData::new(actions, [rows, steps, width]), &self.device);
        let actions = actions.swap_dims(0, 1).reshape([steps * rows, width]);
        let last = self.last((0..frames).map(each).collect(), actions, rows, steps);
        (last - goals).square().sum_dim(1).squeeze_dim(1)
    }

    /// Returns the last latents of rollouts, `[rows, latent]`. `actions` is `[steps * rows, action_dim]`.
    fn last(&self, mut latents: Vec<Tensor<2>>, actions: Tensor<2>, rows: usize, steps: usize) -> Tensor<2> {
        let through = |layer: &Option<Dense>, x: Tensor<2>| match layer {
            Some(layer) => layer.apply(x),
            None => x,
        };
        let condition = through(&self.condition, self.action.forward(actions));
        let modulations = self.modulation.apply(Activation::Silu.forward(condition));
        let mut caches: Vec<Cached> = self.layers.iter().map(|_| None).collect();
        let mut tokens = 0;
        for end in latents.len()..=steps {
            let first = end.saturating_sub(self.history);
            if first > 0 {
                caches.iter_mut().for_each(|cache| *cache = None);
                tokens = 0;
            }
            let new = tokens..end - first;
            tokens = new.end;
            let placed = new.clone().map(|token| latents[first + token].clone() + self.positions[token].clone());
            let mut x = through(&self.input, Tensor::cat(placed.collect(), 0));
            let range = (first + new.start) * rows..(first + new.end) * rows;
            for (index, (layer, cache)) in self.layers.iter().zip(&mut caches).enumerate() {
                let columns = index * PARTS * self.dim..(index + 1) * PARTS * self.dim;
                let modulation = modulations.clone().slice([range.clone(), columns]);
                x = self.block(layer, x, modulation, cache, rows, index + 1 == self.layers.len());
            }
            let kept = x.dims()[0] - rows;
            let x = x.slice([kept..kept + rows, 0..self.dim]);
            let features = through(&self.output, self.norm.forward(x));
            let [hidden, out] = &self.project;
            latents.push(out.apply(Activation::Gelu.forward(hidden.apply(features))));
        }
        latents.pop().expect("a rollout has a last latent")
    }

    /// Applies a layer to the new tokens, `[new * rows, dim]`; returns all of them, or only the last one if `last_only`.
    fn block(
        &self,
        layer: &Layer,
        x: Tensor<2>,
        modulation: Tensor<2>,
        cache: &mut Cached,
        rows: usize,
        last_only: bool,
    ) -> Tensor<2> {
        let [all, dim] = x.dims();
        let part = |index: usize, from: usize| modulation.clone().slice([from..all, index * dim..(index + 1) * dim]);
        let modulate = |x: Tensor<2>, from: usize, first: usize, epsilon: f64| {
            let x = standardize(x, MODULATED_EPSILON) * (part(first + 1, from) + 1.0) + part(first, from);
            standardize(x, epsilon)
        };
        let [attention, feed_forward] = layer.epsilons;
        let qkv = layer.qkv.apply(modulate(x.clone(), 0, 0, attention));
        let inner = qkv.dims()[1] / 3;
        let third = |index: usize| {
            let part = qkv.clone().slice([0..all, index * inner..(index + 1) * inner]);
            part.reshape([all / rows, rows, inner])
        };
        let (keys, values) = match cache.take() {
            Some((keys, values)) => (Tensor::cat(vec![keys, third(1)], 0), Tensor::cat(vec![values, third(2)], 0)),
            None => (third(1), third(2)),
        };
        *cache = Some((keys.clone(), values.clone()));
        let from = if last_only { all - rows } else { 0 };
        let queries = third(0).slice([from / rows..all / rows, 0..rows, 0..inner]);
        let mixed = self.attend(queries, keys, values);
        let mixed = match &layer.out {
            Some(out) => out.apply(mixed),
            None => mixed,
        };
        let x = x.slice([from..all, 0..dim]) + part(2, from) * mixed;
        let hidden = layer.mlp[0].apply(modulate(x.clone(), from, 3, feed_forward));
        x + part(5, from) * layer.mlp[1].apply(Activation::Gelu.forward(hidden))
    }

    /// Causal attention of the newest tokens; a window has few tokens, so that products of single elements are summed.
    ///
    /// # Shapes
    /// `queries` is `[new, rows, heads * width]`, `keys` and `values` are `[tokens, rows, heads * width]`; returns `[new * rows,
    /// heads * width]`.
    fn attend(&self, queries: Tensor<3>, keys: Tensor<3>, values: Tensor<3>) -> Tensor<2> {
        let ([new, rows, inner], [tokens, _, _]) = (queries.dims(), keys.dims());
        if tokens == 1 {
            return values.reshape([rows, inner]);
        }
        let width = inner / self.heads;
        let keys = keys.reshape([1, tokens, rows, self.heads, width]);
        let values = values.reshape([1, tokens, rows, self.heads, width]);
        let queries = queries.reshape([new, 1, rows, self.heads, width]);
        let mut scores = (queries * keys).sum_dim(4) / (width as f64).sqrt();
        if new > 1 {
            let later = |i: usize| i % tokens > i / tokens + (tokens - new);
            let mask = (0..new * tokens).map(|i| if later(i) { f32::NEG_INFINITY } else { 0.0 }).collect();
            scores =
                scores + Tensor::<5>::from_data(TensorData::new::<f32, _>(mask, [new, tokens, 1, 1, 1]), &self.device);
        }
        (activation::softmax(scores, 1) * values).sum_dim(1).reshape([new * rows, inner])
    }
}
