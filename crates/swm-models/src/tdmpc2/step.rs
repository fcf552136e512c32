//! One training step: losses and gradients of a batch of clips.
//!
//! Two graphs, because nothing of the one reaches the other: the world (encoder, dynamics, rewards, values), and the policy,
//! for which latents and Q functions are given. All that does not depend on the step before it, which is everything but the
//! dynamics, is computed for all steps of a clip at once; Q functions are one batched product.
//!
//! A batch is cut into shards of clips that run in parallel. Their gradients are added in their order; only the spread of
//! values, by which the policy's loss is scaled, needs all of them.

use super::config::LossConfig;
use super::model::{Observation, Tdmpc2};
use crate::nn::parameters::{self, IntoF32, Named};
use crate::nn::{Bins, DropoutRng, Ensemble, Head, two_hot};
use burn::module::Module;
use burn::tensor::{Tensor, TensorData, activation};
use rand::Rng as _;
use rand_distr::{Distribution as _, StandardNormal};
use rayon::prelude::*;
use swm_core::Key;

/// A batch of clips, step after step, each of all clips.
pub struct TrainBatch {
    /// `[(horizon + 1) * clips]` observations.
    pub observations: Observation,
    /// `[horizon, clips, actions]`, in model units.
    pub actions: Tensor<3>,
    /// `[horizon, clips]`.
    pub rewards: Tensor<2>,
    /// `[horizon, clips]`: 1 where the episode terminated by that action.
    pub terminated: Tensor<2>,
}

/// What is drawn at random in a step.
pub struct Draws {
    /// Standard normal, `[horizon, clips, actions]`, for the actions at the frames to come.
    pub target: Tensor<3>,
    /// Standard normal, `[horizon, clips, actions]`, for the actions the policy is judged by.
    pub policy: Tensor<3>,
    /// The two target Q functions whose smaller value counts, of every step.
    pub target_critics: Vec<[usize; 2]>,
    /// The two Q functions whose mean the policy is judged by, of every step.
    pub policy_critics: Vec<[usize; 2]>,
    /// Decides dropout; none in validation.
    pub dropout: Option<Key>,
}

impl Draws {
    /// What a key decides.
    pub fn new(key: Key, model: &Tdmpc2, shape: [usize; 3], training: bool) -> Self {
        let normal = |purpose: &str| {
            let mut rng = key.with(purpose).rng();
            let numbers: Vec<f32> = (0..shape.iter().product()).map(|_| StandardNormal.sample(&mut rng)).collect();
            Tensor::from_data(TensorData::new(numbers, shape), &model.device())
        };
        let pairs = |purpose: &str| {
            let mut rng = key.with(purpose).rng();
            let count = model.qs.len();
            let mut pair = || {
                let first = rng.random_range(0..count);
                let second = rng.random_range(0..count - 1);
                [first, if second < first { second } else { second + 1 }]
            };
            (0..shape[0]).map(|_| pair()).collect()
        };
        Self {
            target: normal("target actions"),
            policy: normal("policy actions"),
            target_critics: pairs("target critics"),
            policy_critics: pairs("policy critics"),
            dropout: training.then(|| key.with("dropout")),
        }
    }
}

/// What a step found.
pub struct Step {
    /// The weighted sum.
    pub total: f64,
    /// Mean squared difference between predicted latents and those of the frames to come.
    pub consistency: f64,
    /// Cross-entropy of rewards.
    pub reward: f64,
    /// Cross-entropy of values.
    pub value: f64,
    /// The policy's loss.
    pub policy: f64,
    /// Cross-entropy of terminations.
    pub termination: f64,
    /// The mean value of the policy's actions.
    pub q: f64,
    /// The mean entropy of the policy, estimated from the actions drawn.
    pub entropy: f64,
    /// The running spread of values after this step.
    pub scale: f32,
    /// Gradients by parameter, flat.
    pub gradients: Named<Tensor<1>>,
}

/// Losses and gradients of a batch. `model` is without autodiff; `shards` is at least 1.
pub fn step(model: &Tdmpc2, batch: &TrainBatch, config: &LossConfig, draws: &Draws, shards: usize) -> Step {
    let [horizon, clips, _] = batch.actions.dims();
    let size = clips.div_ceil(shards.max(1));
    let parts: Vec<Part> = (0..clips)
        .step_by(size)
        .enumerate()
        .map(|(i, start)| Part::of(batch, draws, start..(start + size).min(clips), i))
        .collect();
    let worlds: Vec<World> = parts.par_iter().map(|part| world(model, part, config, draws)).collect();
    let judged: Vec<Judged> =
        parts.par_iter().zip(&worlds).map(|(part, world)| judge(model, part, &world.latents, draws)).collect();

    let first: Vec<f32> = judged
        .iter()
        .zip(&parts)
        .flat_map(|(judged, part)| values(judged.q.clone()).into_iter().take(part.clips))
        .collect();
    let old = values(model.scale.value.val())[0];
    #[allow(clippy::cast_possible_truncation)]
    let scale = old + (spread(first) - old) * config.tau as f32;
    let policies: Vec<Policy> =
        judged.into_par_iter().zip(&parts).map(|(judged, part)| learn(judged, part, config, scale)).collect();

    let mut step = Step {
        total: 0.0,
        consistency: 0.0,
        reward: 0.0,
        value: 0.0,
        policy: 0.0,
        termination: 0.0,
        q: 0.0,
        entropy: 0.0,
        scale,
        gradients: Named::new(),
    };
    for ((part, world), policy) in parts.iter().zip(worlds).zip(policies) {
        #[allow(clippy::cast_precision_loss)]
        let share = part.clips as f64 / clips as f64;
        let [consistency, reward, value, termination] = world.losses.map(|loss| loss * share);
        step.consistency += consistency;
        step.reward += reward;
        step.value += value;
        step.termination += termination;
        step.policy += policy.loss * share;
        step.q += policy.q * share;
        step.entropy += policy.entropy * share;
        for (name, gradient) in world.gradients.into_iter().chain(policy.gradients) {
            let gradient = gradient * share;
            let sum = match step.gradients.remove(&name) {
                Some(sum) => sum + gradient,
                None => gradient,
            };
            step.gradients.insert(name, sum);
        }
    }
    debug_assert_eq!(horizon, draws.target_critics.len());
    step.total = config.consistency * step.consistency
        + config.reward * step.reward
        + config.value * step.value
        + config.termination * step.termination
        + step.policy;
    step
}

/// Some clips of a batch, in rows: step after step, each of all clips.
struct Part {
    index: usize,
    clips: usize,
    horizon: usize,
    present: Observation,
    future: Observation,
    actions: Tensor<2>,
    rewards: Tensor<1>,
    terminated: Tensor<1>,
    target_noise: Tensor<2>,
    policy_noise: Tensor<2>,
}

impl Part {
    fn of(batch: &TrainBatch, draws: &Draws, range: std::ops::Range<usize>, index: usize) -> Self {
        let [horizon, clips, width] = batch.actions.dims();
        let count = range.len();
        let wide =
            |x: &Tensor<3>| x.clone().slice([0..horizon, range.clone(), 0..width]).reshape([horizon * count, width]);
        let narrow = |x: &Tensor<2>| x.clone().slice([0..horizon, range.clone()]).reshape([horizon * count]);
        let steps: Vec<Observation> =
            (0..=horizon).map(|t| batch.observations.rows(t * clips + range.start..t * clips + range.end)).collect();
        let (present, future) = (steps[0].clone(), Observation::cat(&steps[1..]));
        Self {
            index,
            clips: count,
            horizon,
            present,
            future,
            actions: wide(&batch.actions),
            rewards: narrow(&batch.rewards),
            terminated: narrow(&batch.terminated),
            target_noise: wide(&draws.target),
            policy_noise: wide(&draws.policy),
        }
    }

    fn rows(&self) -> usize {
        self.horizon * self.clips
    }

    /// The rows of a step.
    fn at(&self, x: &Tensor<2>, step: usize) -> Tensor<2> {
        x.clone().narrow(0, step * self.clips, self.clips)
    }

    /// The weight of every row: `ρ^t`, over the number of rows.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    fn weights(&self, rho: f64) -> Tensor<1> {
        let weight = |row: usize| (rho.powf((row / self.clips) as f64) / self.rows() as f64) as f32;
        let weights: Vec<f32> = (0..self.rows()).map(weight).collect();
        Tensor::from_data(TensorData::new(weights, [self.rows()]), &self.rewards.device())
    }
}

struct World {
    /// Consistency, reward, value, termination.
    losses: [f64; 4],
    gradients: Named<Tensor<1>>,
    /// Before every action, `[rows, latent]`.
    latents: Tensor<2>,
}

/// Losses and gradients of everything but the policy.
fn world(model: &Tdmpc2, part: &Part, config: &LossConfig, draws: &Draws) -> World {
    let bins = model.config().bins;
    let ahead = model.encode(part.future.clone());
    let goals = bins.two_hot(targets(model, part, &ahead, config, draws));

    let live = model.clone().train();
    let weights = part.weights(config.rho);
    let actions = part.actions.clone().autodiff();
    let mut latents = live.encode(part.present.clone().autodiff());
    let (mut inputs, mut predicted) = (vec![], vec![]);
    for step in 0..part.horizon {
        let input = Tensor::cat(vec![latents, part.at(&actions, step)], 1);
        latents = live.next(input.clone());
        inputs.push(input);
        predicted.push(latents.clone());
    }
    let (inputs, predicted) = (Tensor::cat(inputs, 0), Tensor::cat(predicted, 0));

    let weighed = |loss: Tensor<1>| (loss * weights.clone().autodiff()).sum();
    let consistency = weighed((predicted.clone() - ahead.autodiff()).square().mean_dim(1).squeeze_dim(1));
    let reward =
        weighed(two_hot::cross_entropy(live.reward.forward(inputs.clone()), bins.two_hot(part.rewards.clone())));
    let mut rng = draws.dropout.map(|key| key.at(part.index as u64).rng());
    let critics = Ensemble::of(&live.qs.iter().collect::<Vec<_>>());
    let logits = critics.forward(inputs.clone(), model.config().dropout, &mut DropoutRng(rng.as_mut()));
    let [count, rows, width] = logits.dims();
    let goals = goals.unsqueeze_dim::<3>(0).expand([count, rows, width]).reshape([count * rows, width]);
    let value: Tensor<2> =
        two_hot::cross_entropy(logits.reshape([count * rows, width]), goals).reshape([count, rows]).mean_dim(0);
    let value = weighed(value.squeeze_dim(0));
    let mut total =
        consistency.clone() * config.consistency + reward.clone() * config.reward + value.clone() * config.value;
    let mut losses = [value_of(&consistency), value_of(&reward), value_of(&value), 0.0];
    if let Some(head) = &live.termination {
        let logits: Tensor<1> = head.forward(predicted).squeeze_dim(1);
        // Binary cross-entropy: softplus of the logit against the truth.
        let against = logits.clone() * (part.terminated.clone() * -2.0 + 1.0).autodiff();
        let termination = weighed(activation::softplus(against, 1.0));
        losses[3] = value_of(&termination);
        total = total + termination * config.termination;
    }
    let gradients = parameters::gradients(&live, &total.backward());
    let [rows, width] = inputs.dims();
    let latents = inputs.inner().slice([0..rows, 0..width - part.actions.dims()[1]]);
    World { losses, gradients, latents }
}

/// The values that Q functions are to learn: `r + γ min(Q_i, Q_j)` at the frames to come, nothing behind the end of an episode.
fn targets(model: &Tdmpc2, part: &Part, ahead: &Tensor<2>, config: &LossConfig, draws: &Draws) -> Tensor<1> {
    let next = model.policy(ahead.clone()).sample(part.target_noise.clone());
    let input = Tensor::cat(vec![ahead.clone(), next], 1);
    let least = (0..part.horizon).map(|step| {
        let chosen = chosen(&model.target_qs, draws.target_critics[step]);
        let q = numbers(
            model.config().bins,
            Ensemble::of(&chosen).forward(part.at(&input, step), 0.0, &mut DropoutRng::disabled()),
        );
        q.min_dim(0).squeeze_dim(0)
    });
    let q: Tensor<1> = Tensor::cat(least.collect(), 0);
    part.rewards.clone() + q * (part.terminated.clone().neg() + 1.0) * config.discount
}

/// The policy's actions, judged.
struct Judged {
    policy: Head,
    /// Values of its actions, `[rows]`.
    q: Tensor<1>,
    /// The logarithm of their density, negated and times their numbers, `[rows]`.
    entropy: Tensor<1>,
}

fn judge(model: &Tdmpc2, part: &Part, latents: &Tensor<2>, draws: &Draws) -> Judged {
    let policy = model.pi.clone().train();
    let latents = latents.clone().autodiff();
    let gaussian = super::Gaussian::of(policy.forward(latents.clone()));
    let noise = part.policy_noise.clone();
    let actions = gaussian.sample(noise.clone().autodiff());
    let [_, width] = actions.dims();
    let normal = (noise.square() * -0.5 - 0.5 * (2.0 * std::f64::consts::PI).ln()).autodiff() - gaussian.log_std;
    let squashed = (activation::relu(actions.clone().square().neg() + 1.0) + 1e-6).log();
    #[allow(clippy::cast_precision_loss)]
    let entropy = (normal - squashed).sum_dim(1).squeeze_dim(1) * -(width as f64);
    let input = Tensor::cat(vec![latents, actions], 1);
    let means = (0..part.horizon).map(|step| {
        let critics = Ensemble::of(&chosen(&model.qs, draws.policy_critics[step])).frozen();
        let logits = critics.forward(part.at(&input, step), 0.0, &mut DropoutRng::disabled());
        numbers(model.config().bins, logits).mean_dim(0).squeeze_dim(0)
    });
    Judged { policy, q: Tensor::cat(means.collect(), 0), entropy }
}

struct Policy {
    loss: f64,
    q: f64,
    entropy: f64,
    gradients: Named<Tensor<1>>,
}

/// The policy's loss and gradients: values in units of their spread, and entropy.
#[allow(clippy::cast_precision_loss)]
fn learn(judged: Judged, part: &Part, config: &LossConfig, scale: f32) -> Policy {
    let Judged { policy, q, entropy } = judged;
    let width = part.actions.dims()[1] as f64;
    let means = [&q, &entropy].map(|x| value_of(&x.clone().mean()));
    let gain = q / scale + entropy * config.entropy;
    let loss = (gain * part.weights(config.rho).autodiff()).sum().neg();
    let value = value_of(&loss);
    let gradients = parameters::gradients(&policy, &loss.backward());
    Policy {
        loss: value,
        q: means[0],
        entropy: means[1] / width,
        gradients: gradients.into_iter().map(|(name, gradient)| (format!("pi.{name}"), gradient)).collect(),
    }
}

fn chosen(heads: &[Head], pair: [usize; 2]) -> [&Head; 2] {
    pair.map(|i| &heads[i])
}

/// Logits `[heads, rows, bins]` to numbers `[heads, rows]`.
pub(super) fn numbers(bins: Bins, logits: Tensor<3>) -> Tensor<2> {
    let [heads, rows, width] = logits.dims();
    bins.expectation(logits.reshape([heads * rows, width])).reshape([heads, rows])
}

/// From the 5th to the 95th percentile, at least 1e-4; between two numbers it lies on the line.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn spread(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    let at = |share: f64| {
        let place = share * (values.len() - 1) as f64;
        let below = place as usize;
        let above = (below + 1).min(values.len() - 1);
        values[below] + (values[above] - values[below]) * (place - below as f64) as f32
    };
    (at(0.95) - at(0.05)).max(1e-4)
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.inner().into_data().into_f32_vec()
}

fn value_of(tensor: &Tensor<1>) -> f64 {
    f64::from(tensor.clone().inner().into_scalar::<f32>())
}
