//! The losses of [`super::step`] and their gradients on the CPU, with the kernels of `swm-kernels` in place of autodiff graphs.
//!
//! Parts of the batch, and in each part the Q functions and the policy, are computed on different threads. The gradients of the parts are
//! added in order, so that no byte depends on the number of threads.

use super::config::SacLoss;
use super::model::{Actor, Critic, Sac};
use super::step::{Losses, Transitions};
use crate::nn::Linear;
use crate::nn::parameters::{HostValues, Named, host};
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use std::f32::consts::{LN_2, TAU};
use std::ops::Range;
use std::sync::LazyLock;
use swm_kernels::{BLOCK, ReluLayer, ReluNetwork, ReluScratch, ReluTape, ScratchPool, functions, write_blocks};

/// The number of transitions in a part.
const PART: usize = 4 * BLOCK;

/// A feature of the rows of a block.
type Lane = [f32; BLOCK];

/// The networks with their weights on the host.
struct Networks {
    /// The outputs are the means, then the logarithms of the standard deviations.
    actor: ReluNetwork<HostValues>,
    /// The Q functions, then their target networks.
    critics: [ReluNetwork<HostValues>; 4],
}

/// The transitions on the host, `[rows, …]`.
struct Rows {
    observations: Vec<f32>,
    actions: Vec<f32>,
    rewards: Vec<f32>,
    terminated: Vec<f32>,
    next: Vec<f32>,
    noise: [Vec<f32>; 2],
    /// Elements of an observation and of an action.
    inputs: usize,
    action_dim: usize,
}

/// What the losses need besides networks and transitions.
#[derive(Clone, Copy)]
struct Settings {
    temperature: f32,
    discount: f32,
    /// One divided by the number of transitions of the batch.
    weight: f32,
}

/// Memory of a part.
#[derive(Default)]
struct Memory {
    /// The tapes of the policy and of the Q functions.
    tapes: [ReluTape; 3],
    scratch: ReluScratch,
    observations: Vec<f32>,
    noise: Vec<f32>,
    inputs: Vec<f32>,
}

static MEMORY: LazyLock<ScratchPool<Memory>> = LazyLock::new(ScratchPool::default);

/// Computes losses and gradients of a batch.
pub(super) fn losses(model: &Sac, batch: &Transitions, config: &SacLoss, temperature: f64) -> Losses {
    let device = batch.rewards.device();
    let (critics, targets) = (&model.critic, &model.critic_target);
    let networks = Networks {
        actor: actor_network(&model.actor),
        critics: [&critics.qf0, &critics.qf1, &targets.qf0, &targets.qf1].map(critic_network),
    };
    let rows = Rows::of(batch);
    let count = rows.rewards.len();
    let settings = Settings {
        temperature: temperature as f32,
        discount: config.discount as f32,
        weight: 1.0 / count.max(1) as f32,
    };
    let parts = (0..count.div_ceil(PART)).into_par_iter().map(|part| {
        let range = part * PART..((part + 1) * PART).min(count);
        rayon::join(
            || MEMORY.with(|memory| critic_part(&networks, &rows, range.clone(), settings, memory)),
            || MEMORY.with(|memory| policy_part(&networks, &rows, range.clone(), settings, memory)),
        )
    });
    let (of_critics, of_policy): (Vec<_>, Vec<_>) = parts.collect();
    let (squares, of_critics): (Vec<f64>, Vec<_>) = of_critics.into_iter().unzip();
    let (means, of_policy): (Vec<[f64; 2]>, Vec<_>) = of_policy.into_iter().unzip();
    let [density, q] = [0, 1].map(|i| means.iter().map(|means| means[i]).sum::<f64>() / count.max(1) as f64);
    let (of_critics, of_policy) = rayon::join(|| sum(of_critics), || sum(of_policy));
    Losses {
        critic: 0.5 * squares.iter().sum::<f64>() / count.max(1) as f64,
        actor: density * temperature - q,
        density,
        q,
        gradients: named(of_critics, of_policy, rows.action_dim, &device),
    }
}

fn layer(linear: &Linear) -> ReluLayer<HostValues> {
    let bias = linear.bias.as_ref().map(|bias| HostValues::of(&bias.val()));
    ReluLayer { weight: HostValues::of(&linear.weight.val()), bias: bias.expect("the layers of a SAC have a bias") }
}

fn actor_network(actor: &Actor) -> ReluNetwork<HostValues> {
    let heads = [layer(&actor.mu), layer(&actor.log_std)];
    let both = |of: fn(&ReluLayer<HostValues>) -> &[f32]| HostValues::Copied(heads.each_ref().map(of).concat());
    let last = ReluLayer { weight: both(|layer| &layer.weight), bias: both(|layer| &layer.bias) };
    ReluNetwork::new(vec![layer(&actor.latent_pi._0), layer(&actor.latent_pi._2), last])
}

fn critic_network(critic: &Critic) -> ReluNetwork<HostValues> {
    ReluNetwork::new([&critic._0, &critic._2, &critic._4].map(layer).into())
}

impl Rows {
    fn of(batch: &Transitions) -> Self {
        let matrix = |x: &Tensor<2>| host(x.clone());
        Self {
            observations: matrix(&batch.observations),
            actions: matrix(&batch.actions),
            rewards: host(batch.rewards.clone()),
            terminated: host(batch.terminated.clone()),
            next: matrix(&batch.next),
            noise: [0, 1].map(|i| matrix(&batch.noise[i])),
            inputs: batch.observations.dims()[1],
            action_dim: batch.actions.dims()[1],
        }
    }
}

/// Returns the rows of a range.
fn rows_of<'a>(values: &'a [f32], range: &Range<usize>, width: usize) -> &'a [f32] {
    &values[range.start * width..range.end * width]
}

/// Returns the sum of the squared errors of both Q functions in a part of the batch, and the gradients of the Q functions' loss.
fn critic_part(
    networks: &Networks,
    rows: &Rows,
    range: Range<usize>,
    settings: Settings,
    memory: &mut Memory,
) -> (f64, Vec<ReluLayer>) {
    let next = rows_of(&rows.next, &range, rows.inputs);
    let density = memory.sample(networks, rows, next, rows_of(&rows.noise[0], &range, rows.action_dim));
    let Memory { tapes: [_, tape, _], scratch, inputs: x, .. } = memory;
    let mut targets: Vec<f32> = networks.critics[2].forward(x, tape).to_vec();
    let second = networks.critics[3].forward(x, tape);
    for (row, (target, second)) in targets.iter_mut().zip(second).enumerate() {
        let Some(reward) = rows.rewards[range.clone()].get(row) else { break };
        let soft = if *second < *target { *second } else { *target } - density[row] * settings.temperature;
        *target = reward + soft * (1.0 - rows.terminated[range.start + row]) * settings.discount;
    }
    let features = rows.inputs + rows.action_dim;
    write_blocks(rows_of(&rows.observations, &range, rows.inputs), rows.inputs, x, features, 0);
    write_blocks(rows_of(&rows.actions, &range, rows.action_dim), rows.action_dim, x, features, rows.inputs);
    let (mut squares, mut gradients) = (0.0, vec![]);
    for critic in &networks.critics[..2] {
        // The gradient of missing rows is 0.
        let mut d = vec![0.0; targets.len()];
        let errors = critic.forward(x, tape).iter().zip(&targets).zip(&mut d);
        for ((q, target), d) in errors.take(range.len()) {
            let error = q - target;
            squares += f64::from(error * error);
            *d = error * settings.weight;
        }
        gradients.extend(critic.weight_gradients(x, tape, &d, scratch));
    }
    (squares, gradients)
}

/// Returns the sums of the log-densities and of the values of the policy's actions in a part of the batch, and the gradients of the policy's
/// loss.
fn policy_part(
    networks: &Networks,
    rows: &Rows,
    range: Range<usize>,
    settings: Settings,
    memory: &mut Memory,
) -> ([f64; 2], Vec<ReluLayer>) {
    let Settings { temperature, weight, .. } = settings;
    let (width, features) = (rows.action_dim, rows.inputs + rows.action_dim);
    let observations = rows_of(&rows.observations, &range, rows.inputs);
    let density = memory.sample(networks, rows, observations, rows_of(&rows.noise[1], &range, width));
    let Memory { tapes: [of_actor, of_critics @ ..], scratch, observations, noise, inputs: x } = memory;
    let [first, second] = of_critics.each_mut();
    let q = [networks.critics[0].forward(x, first), networks.critics[1].forward(x, second)];
    let is_second: Vec<bool> = q[0].iter().zip(q[1]).map(|(first, second)| second < first).collect();
    let mut sums = [0.0; 2];
    for row in 0..range.len() {
        sums[0] += f64::from(density[row]);
        sums[1] += f64::from(q[usize::from(is_second[row])][row]);
    }

    // The gradient of the actions is that of the smaller value. It is 0 in missing rows, as are their weights.
    let mut of_actions = vec![0.0; is_second.len() * width];
    for (index, tape) in of_critics.iter().enumerate() {
        let of_q = |(row, is_second): (usize, &bool)| {
            if row < range.len() && usize::from(*is_second) == index { -weight } else { 0.0 }
        };
        let d: Vec<f32> = is_second.iter().enumerate().map(of_q).collect();
        let gradient = networks.critics[index].input_gradient(tape, &d, rows.inputs..features, scratch);
        of_actions.iter_mut().zip(gradient).for_each(|(sum, d)| *sum += d);
    }
    let output = networks.actor.outputs(of_actor);
    let mut d = vec![0.0; output.len()];
    let blocks = lanes_mut(&mut d).chunks_exact_mut(2 * width).zip(lanes(output).chunks_exact(2 * width));
    let samples = lanes(x).chunks_exact(features).zip(lanes(noise).chunks_exact(width));
    let blocks = blocks.zip(samples).zip(lanes(&of_actions).chunks_exact(width));
    for (block, (((d, output), (x, noise)), of_actions)) in blocks.enumerate() {
        let (of_mean, of_log_std) = d.split_at_mut(width);
        for i in 0..width {
            for row in 0..BLOCK {
                let weight = if block * BLOCK + row < range.len() { weight } else { 0.0 };
                let (action, log_std) = (x[rows.inputs + i][row], output[width + i][row]);
                // The derivative of the log-density by the action before tanh is 2 tanh.
                let of_raw = of_actions[i][row] * (1.0 - action * action) + temperature * weight * 2.0 * action;
                of_mean[i][row] = of_raw;
                if LOG_STD.contains(&log_std) {
                    of_log_std[i][row] = of_raw * log_std.exp() * noise[i][row] - temperature * weight;
                }
            }
        }
    }
    (sums, networks.actor.weight_gradients(observations, of_actor, &d, scratch))
}

/// The bounds of the logarithm of the standard deviation.
const LOG_STD: std::ops::RangeInclusive<f32> = -20.0..=2.0;

impl Memory {
    /// Samples actions at observations, and writes both to `inputs`; returns the logarithm of the density of each row's action.
    ///
    /// # Shapes
    /// `observations` is `[rows, inputs]`, `noise` `[rows, action_dim]`; `inputs` becomes `[blocks, inputs + action_dim, BLOCK]`.
    fn sample(&mut self, networks: &Networks, rows: &Rows, observations: &[f32], noise: &[f32]) -> Vec<f32> {
        let (width, features) = (rows.action_dim, rows.inputs + rows.action_dim);
        let blocks = (noise.len() / width).div_ceil(BLOCK);
        let Self { tapes: [tape, ..], observations: in_blocks, noise: noise_in_blocks, inputs, .. } = self;
        in_blocks.resize(blocks * rows.inputs * BLOCK, 0.0);
        noise_in_blocks.resize(blocks * width * BLOCK, 0.0);
        inputs.resize(blocks * features * BLOCK, 0.0);
        write_blocks(observations, rows.inputs, in_blocks, rows.inputs, 0);
        write_blocks(noise, width, noise_in_blocks, width, 0);
        let output = networks.actor.forward(in_blocks, tape);
        let mut density = vec![0.0; blocks * BLOCK];
        let samples = lanes(output).chunks_exact(2 * width).zip(lanes(noise_in_blocks).chunks_exact(width));
        let outputs = lanes_mut(inputs).chunks_exact_mut(features).zip(lanes_mut(&mut density));
        let blocks = samples.zip(outputs).zip(lanes(in_blocks).chunks_exact(rows.inputs));
        for (((output, noise), (inputs, density)), observations) in blocks {
            let (observed, actions) = inputs.split_at_mut(rows.inputs);
            observed.copy_from_slice(observations);
            for i in 0..width {
                for row in 0..BLOCK {
                    let log_std = output[width + i][row].clamp(*LOG_STD.start(), *LOG_STD.end());
                    let raw = output[i][row] + log_std.exp() * noise[i][row];
                    let normal = (noise[i][row] * noise[i][row] + TAU.ln()) * -0.5 - log_std;
                    // ln(1 - tanh² x) = 2 (ln 2 - x - softplus(-2 x)), which is accurate for large x.
                    let softplus = (-2.0 * raw).max(0.0) + (-2.0 * raw.abs()).exp().ln_1p();
                    density[row] += normal - 2.0 * (LN_2 - raw - softplus);
                    actions[i][row] = raw.tanh();
                }
            }
        }
        density
    }
}

fn lanes(values: &[f32]) -> &[Lane] {
    values.as_chunks().0
}

fn lanes_mut(values: &mut [f32]) -> &mut [Lane] {
    values.as_chunks_mut().0
}

/// Adds the gradients of all parts.
fn sum(parts: Vec<Vec<ReluLayer>>) -> Vec<ReluLayer> {
    let added = parts.into_iter().reduce(|mut sums, terms| {
        for (sum, term) in sums.iter_mut().zip(&terms) {
            functions::add(&mut sum.weight, &term.weight);
            functions::add(&mut sum.bias, &term.bias);
        }
        sums
    });
    added.unwrap_or_default()
}

/// Returns the gradients by parameter name.
fn named(critics: Vec<ReluLayer>, actor: Vec<ReluLayer>, action_dim: usize, device: &Device) -> Named<Tensor<1>> {
    let mut gradients = Named::new();
    let mut insert = |name: &str, layer: ReluLayer| {
        for (part, values) in [("weight", layer.weight), ("bias", layer.bias)] {
            let count = values.len();
            gradients.insert(format!("{name}.{part}"), Tensor::from_data(TensorData::new(values, [count]), device));
        }
    };
    let names = ["qf0.0", "qf0.2", "qf0.4", "qf1.0", "qf1.2", "qf1.4"];
    for (name, layer) in names.into_iter().zip(critics) {
        insert(&format!("critic.{name}"), layer);
    }
    for (name, mut layer) in ["latent_pi.0", "latent_pi.2", "mu"].into_iter().zip(actor) {
        if name == "mu" {
            let hidden = layer.weight.len() / layer.bias.len();
            let weight = layer.weight.split_off(action_dim * hidden);
            insert("actor.log_std", ReluLayer { weight, bias: layer.bias.split_off(action_dim) });
        }
        insert(&format!("actor.{name}"), layer);
    }
    gradients
}
