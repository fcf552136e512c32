//! One training step of a TD-MPC2 (Hansen et al. 2024, equations 3 to 6): losses and gradients of a batch of clips.
//!
//! The world model (encoder, dynamics, rewards, values) and the policy have separate autodiff graphs: latents and Q
//! functions are constants for the policy. Everything except the dynamics is computed for all steps of a clip at once;
//! the Q functions are one batched product.
//!
//! A batch is split into shards of clips that run in parallel. The gradients of the shards are added in order; only the
//! spread of values, which scales the policy's loss, is computed over all shards.

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

/// A batch of clips. Rows are ordered by step, then by clip.
pub struct TrainBatch {
    /// The observations, `(horizon + 1) * clips` rows.
    pub observations: Observation,
    /// The actions in model units, `[horizon, clips, action_dim]`.
    pub actions: Tensor<3>,
    /// The rewards, `[horizon, clips]`.
    pub rewards: Tensor<2>,
    /// 1 where the action terminated the episode, else 0: `[horizon, clips]`.
    pub terminated: Tensor<2>,
}

/// The random draws of a step.
pub struct Draws {
    /// Standard normal noise of the actions at the next frames, `[horizon, clips, action_dim]`.
    pub target: Tensor<3>,
    /// Standard normal noise of the actions in the policy's loss, `[horizon, clips, action_dim]`.
    pub policy: Tensor<3>,
    /// The two target Q functions of each step whose minimum is the target.
    pub target_critics: Vec<[usize; 2]>,
    /// The two Q functions of each step whose mean is the value of the policy's actions.
    pub policy_critics: Vec<[usize; 2]>,
    /// The key of dropout; `None` in validation.
    pub dropout: Option<Key>,
}

impl Draws {
    /// Draws the random values of a step, with noise of shape `[horizon, clips, action_dim]`.
    pub fn new(key: Key, model: &Tdmpc2, shape: [usize; 3], training: bool) -> Self {
        let normal = |purpose: &str| {
            let mut rng = key.with(purpose).rng();
            let values: Vec<f32> = (0..shape.iter().product()).map(|_| StandardNormal.sample(&mut rng)).collect();
            Tensor::from_data(TensorData::new(values, shape), &model.device())
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

/// Losses and gradients of a batch.
pub struct Tdmpc2Step {
    /// The weighted sum of the losses.
    pub total: f64,
    /// Mean squared error of the predicted latents.
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
    /// The mean entropy of the policy, estimated from sampled actions.
    pub entropy: f64,
    /// The running spread of values after the step.
    pub scale: f32,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
}

/// Computes losses and gradients of a batch. `model` is outside autodiff; `shards` is at least 1.
pub fn step(model: &Tdmpc2, batch: &TrainBatch, config: &LossConfig, draws: &Draws, shards: usize) -> Tdmpc2Step {
    let [horizon, clips, _] = batch.actions.dims();
    let size = clips.div_ceil(shards.max(1));
    let shards: Vec<Shard> = (0..clips)
        .step_by(size)
        .enumerate()
        .map(|(i, start)| Shard::of(batch, draws, start..(start + size).min(clips), i))
        .collect();
    let world_models: Vec<WorldModelLoss> =
        shards.par_iter().map(|shard| world_model_loss(model, shard, config, draws)).collect();
    let evaluations: Vec<PolicyEvaluation> = (shards.par_iter().zip(&world_models))
        .map(|(shard, world_model)| evaluate_policy(model, shard, &world_model.latents, draws))
        .collect();

    let first_step: Vec<f32> = (evaluations.iter().zip(&shards))
        .flat_map(|(evaluation, shard)| values(evaluation.q.clone()).into_iter().take(shard.clips))
        .collect();
    let old = values(model.scale.value.val())[0];
    let scale = old + (spread(first_step) - old) * config.tau as f32;
    let policies: Vec<PolicyLoss> = (evaluations.into_par_iter().zip(&shards))
        .map(|(evaluation, shard)| policy_loss(evaluation, shard, config, scale))
        .collect();

    let mut step = Tdmpc2Step {
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
    let mut gradients = vec![];
    for ((shard, world_model), policy) in shards.iter().zip(world_models).zip(policies) {
        let fraction = shard.clips as f64 / clips as f64;
        let [consistency, reward, value, termination] = world_model.losses.map(|loss| loss * fraction);
        step.consistency += consistency;
        step.reward += reward;
        step.value += value;
        step.termination += termination;
        step.policy += policy.loss * fraction;
        step.q += policy.q * fraction;
        step.entropy += policy.entropy * fraction;
        gradients.extend([(world_model.gradients, fraction), (policy.gradients, fraction)]);
    }
    let scaled = |(gradients, fraction): (Named<Tensor<1>>, f64)| -> Named<Tensor<1>> {
        gradients.into_iter().map(|(name, gradient)| (name, gradient * fraction)).collect()
    };
    parameters::add_all(&mut step.gradients, gradients.into_par_iter().map(scaled).collect());
    debug_assert_eq!(horizon, draws.target_critics.len());
    step.total = config.consistency * step.consistency
        + config.reward * step.reward
        + config.value * step.value
        + config.termination * step.termination
        + step.policy;
    step
}

/// A shard of the clips of a batch. Rows are ordered by step, then by clip.
struct Shard {
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

impl Shard {
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

    /// Returns the rows of `x` at a step.
    fn at(&self, x: &Tensor<2>, step: usize) -> Tensor<2> {
        x.clone().narrow(0, step * self.clips, self.clips)
    }

    /// Returns the weight of every row: `ρ^t` divided by the number of rows.
    fn weights(&self, rho: f64) -> Tensor<1> {
        let weight = |row: usize| (rho.powf((row / self.clips) as f64) / self.rows() as f64) as f32;
        let weights: Vec<f32> = (0..self.rows()).map(weight).collect();
        Tensor::from_data(TensorData::new(weights, [self.rows()]), &self.rewards.device())
    }
}

/// Losses and gradients of the world model.
struct WorldModelLoss {
    /// The losses of consistency, reward, value and termination.
    losses: [f64; 4],
    gradients: Named<Tensor<1>>,
    /// The latents before every action, `[rows, latent]`.
    latents: Tensor<2>,
}

/// Computes losses and gradients of all networks except the policy.
fn world_model_loss(model: &Tdmpc2, shard: &Shard, config: &LossConfig, draws: &Draws) -> WorldModelLoss {
    let bins = model.config().bins;
    let next_latents = model.encode(shard.future.clone());
    let targets = bins.two_hot(targets(model, shard, &next_latents, config, draws));

    let learner = model.clone().train();
    let weights = shard.weights(config.rho);
    let actions = shard.actions.clone().autodiff();
    let mut latents = learner.encode(shard.present.clone().autodiff());
    let (mut inputs, mut predicted) = (vec![], vec![]);
    for step in 0..shard.horizon {
        let input = Tensor::cat(vec![latents, shard.at(&actions, step)], 1);
        latents = learner.next(input.clone());
        inputs.push(input);
        predicted.push(latents.clone());
    }
    let (inputs, predicted) = (Tensor::cat(inputs, 0), Tensor::cat(predicted, 0));

    let weighted_sum = |loss: Tensor<1>| (loss * weights.clone().autodiff()).sum();
    let consistency = weighted_sum((predicted.clone() - next_latents.autodiff()).square().mean_dim(1).squeeze_dim(1));
    let reward = weighted_sum(two_hot::cross_entropy(
        learner.reward.forward(inputs.clone()),
        bins.two_hot(shard.rewards.clone()),
    ));
    let mut rng = draws.dropout.map(|key| key.at(shard.index as u64).rng());
    let critics = Ensemble::of(&learner.qs.iter().collect::<Vec<_>>());
    let logits = critics.forward(inputs.clone(), model.config().dropout, &mut DropoutRng(rng.as_mut()));
    let [count, rows, width] = logits.dims();
    let targets = targets.unsqueeze_dim::<3>(0).expand([count, rows, width]).reshape([count * rows, width]);
    let value: Tensor<2> =
        two_hot::cross_entropy(logits.reshape([count * rows, width]), targets).reshape([count, rows]).mean_dim(0);
    let value = weighted_sum(value.squeeze_dim(0));
    let mut total =
        consistency.clone() * config.consistency + reward.clone() * config.reward + value.clone() * config.value;
    let mut losses = [value_of(&consistency), value_of(&reward), value_of(&value), 0.0];
    if let Some(head) = &learner.termination {
        let logits: Tensor<1> = head.forward(predicted).squeeze_dim(1);
        // Binary cross-entropy is the softplus of the logit, which is negated in rows that terminate the episode.
        let signed = logits.clone() * (shard.terminated.clone() * -2.0 + 1.0).autodiff();
        let termination = weighted_sum(activation::softplus(signed, 1.0));
        losses[3] = value_of(&termination);
        total = total + termination * config.termination;
    }
    let gradients = parameters::gradients(&learner, &total.backward());
    let [rows, width] = inputs.dims();
    let latents = inputs.inner().slice([0..rows, 0..width - shard.actions.dims()[1]]);
    WorldModelLoss { losses, gradients, latents }
}

/// Returns the targets of the Q functions, `[rows]`: `r + γ min(Q_i, Q_j)` at the next frames, and `r` where the
/// episode terminates.
fn targets(model: &Tdmpc2, shard: &Shard, next_latents: &Tensor<2>, config: &LossConfig, draws: &Draws) -> Tensor<1> {
    let next = model.policy(next_latents.clone()).sample(shard.target_noise.clone());
    let input = Tensor::cat(vec![next_latents.clone(), next], 1);
    let least = (0..shard.horizon).map(|step| {
        let chosen = chosen(&model.target_qs, draws.target_critics[step]);
        let q = expected_values(
            model.config().bins,
            Ensemble::of(&chosen).forward(shard.at(&input, step), 0.0, &mut DropoutRng::disabled()),
        );
        q.min_dim(0).squeeze_dim(0)
    });
    let q: Tensor<1> = Tensor::cat(least.collect(), 0);
    shard.rewards.clone() + q * (shard.terminated.clone().neg() + 1.0) * config.discount
}

/// Values and entropies of the policy's actions.
struct PolicyEvaluation {
    policy: Head,
    /// Values of the policy's actions, `[rows]`.
    q: Tensor<1>,
    /// The negative log-density of the actions times the number of action elements, `[rows]`.
    entropy: Tensor<1>,
}

fn evaluate_policy(model: &Tdmpc2, shard: &Shard, latents: &Tensor<2>, draws: &Draws) -> PolicyEvaluation {
    let policy = model.pi.clone().train();
    let latents = latents.clone().autodiff();
    let gaussian = super::Gaussian::of(policy.forward(latents.clone()));
    let noise = shard.policy_noise.clone();
    let actions = gaussian.sample(noise.clone().autodiff());
    let [_, width] = actions.dims();
    let normal = (noise.square() * -0.5 - 0.5 * (2.0 * std::f64::consts::PI).ln()).autodiff() - gaussian.log_std;
    let squashed = (activation::relu(actions.clone().square().neg() + 1.0) + 1e-6).log();
    let entropy = (normal - squashed).sum_dim(1).squeeze_dim(1) * -(width as f64);
    let input = Tensor::cat(vec![latents, actions], 1);
    let means = (0..shard.horizon).map(|step| {
        let critics = Ensemble::of(&chosen(&model.qs, draws.policy_critics[step])).frozen();
        let logits = critics.forward(shard.at(&input, step), 0.0, &mut DropoutRng::disabled());
        expected_values(model.config().bins, logits).mean_dim(0).squeeze_dim(0)
    });
    PolicyEvaluation { policy, q: Tensor::cat(means.collect(), 0), entropy }
}

/// Loss and gradients of the policy.
struct PolicyLoss {
    loss: f64,
    q: f64,
    entropy: f64,
    gradients: Named<Tensor<1>>,
}

/// Computes the policy's loss and the gradients of the loss. The loss is the negated sum of the values, divided by the
/// spread `scale`, and of the weighted entropy.
fn policy_loss(evaluation: PolicyEvaluation, shard: &Shard, config: &LossConfig, scale: f32) -> PolicyLoss {
    let PolicyEvaluation { policy, q, entropy } = evaluation;
    let width = shard.actions.dims()[1] as f64;
    let means = [&q, &entropy].map(|x| value_of(&x.clone().mean()));
    let gain = q / scale + entropy * config.entropy;
    let loss = (gain * shard.weights(config.rho).autodiff()).sum().neg();
    let value = value_of(&loss);
    let gradients = parameters::gradients(&policy, &loss.backward());
    PolicyLoss {
        loss: value,
        q: means[0],
        entropy: means[1] / width,
        gradients: gradients.into_iter().map(|(name, gradient)| (format!("pi.{name}"), gradient)).collect(),
    }
}

fn chosen(heads: &[Head], pair: [usize; 2]) -> [&Head; 2] {
    pair.map(|i| &heads[i])
}

/// Returns the expected values of binned distributions.
///
/// # Shapes
/// `logits` is `[heads, rows, bins]`; returns `[heads, rows]`.
pub(super) fn expected_values(bins: Bins, logits: Tensor<3>) -> Tensor<2> {
    let [heads, rows, width] = logits.dims();
    bins.expectation(logits.reshape([heads * rows, width])).reshape([heads, rows])
}

/// Returns the distance from the 5th to the 95th percentile (with linear interpolation), at least 1e-4.
fn spread(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    let percentile = |fraction: f64| {
        let position = fraction * (values.len() - 1) as f64;
        let below = position as usize;
        let above = (below + 1).min(values.len() - 1);
        values[below] + (values[above] - values[below]) * (position - below as f64) as f32
    };
    (percentile(0.95) - percentile(0.05)).max(1e-4)
}

fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.inner().into_data().into_f32_vec()
}

fn value_of(tensor: &Tensor<1>) -> f64 {
    f64::from(tensor.clone().inner().into_scalar::<f32>())
}
