//! The losses of goal-conditioned models on clips, and the gradients of the losses.
//!
//! Values and policy are trained together, as by Kostrikov et al. (2021): the policy's loss has no gradient with
//! respect to values and encoder, so the gradients are those of the two phases of the published algorithms.

use super::cells::CellPass;
use super::heads::{Critic, Head, ValueHead};
use super::loss::{self, ValueLoss};
use super::model::{Gcbc, Gciql, Gcivl};
use crate::nn::{Backbone, BatchStatistics, DropoutRng, Named, parameters};
use crate::train::StepOutput;
use burn::module::Module;
use burn::tensor::Tensor;
use std::ops::Range;

/// Normalised clips; the tensors are outside the autodiff graph.
#[derive(Clone, Debug)]
pub struct Clips {
    /// Image patches, `[clips * steps, patches, 3 * patch * patch]`: the history, and for value learning the next
    /// frame.
    pub frames: Tensor<3>,
    /// Goals of the values (for GCBC, of the policy), `[clips, patches, 3 * patch * patch]`.
    pub goal: Tensor<3>,
    /// Actions taken at the frames of the history, `[clips, history, action_dim]`.
    pub actions: Tensor<3>,
}

/// The inputs of value learning that [`Clips`] does not contain.
#[derive(Clone, Debug)]
pub struct Relabelled {
    /// Goals of the policy, `[clips, patches, 3 * patch * patch]`.
    pub policy_goal: Tensor<3>,
    /// 1 if a frame of the history is the goal, else 0: `[clips, history, 1]`.
    pub reached: Tensor<3>,
}

/// The inputs of the heads, `[clips, frames * patches, dim]` each.
struct HeadInputs {
    /// The history, in the autodiff graph.
    now: Tensor<3>,
    /// The goal of the values, in the autodiff graph.
    goal: Tensor<3>,
    /// The frame after each frame of the history, outside the autodiff graph.
    next: Tensor<3>,
    /// The goal of the policy, outside the autodiff graph.
    policy_goal: Tensor<3>,
}

impl Gcbc {
    /// Computes the mean squared error of actions and, in training, the gradients of the error.
    pub fn losses(&self, clips: &Clips, rng: &mut DropoutRng<'_>, training: bool) -> StepOutput {
        let model = self.clone().train();
        let encoders = Encoders::new(&self.encoder, &model.encoder, self.config.frozen, training, clips);
        let ([frames, goal], encoding) = encoders.with_gradient(clips.frames.clone(), clips.goal.clone());
        let means = model.action_predictor.forward(&frames, &goal, rng);
        let loss = (means - clips.actions.clone().autodiff()).square().mean();
        finish((&model, &self.encoder), &loss, vec![("loss", scalar(&loss))], training, encoding)
    }
}

impl Gcivl {
    /// Computes the losses of implicit value learning: values by expectile regression on bootstrapped targets, the
    /// policy by advantage-weighted regression.
    pub fn losses(
        &self,
        clips: &Clips,
        relabelled: &Relabelled,
        settings: &ValueLoss,
        rng: &mut DropoutRng<'_>,
        training: bool,
    ) -> StepOutput {
        let model = self.clone().train();
        let encoders = Encoders::new(&self.encoder, &model.encoder, self.config.frozen, training, clips);
        let (inputs, encoding) = head_inputs(&encoders, clips, relabelled);
        let HeadInputs { now, goal, next, policy_goal } = &inputs;
        let target = bootstrap(&self.value_predictor.teacher, &inputs, relabelled, settings);
        let value = model.value_predictor.student.forward(now, goal, rng);
        let value_loss = loss::expectile(value.clone(), target.autodiff(), settings.expectile);

        let state_value =
            |frames: &Tensor<3>| self.value_predictor.student.forward(frames, policy_goal, &mut DropoutRng::disabled());
        let advantage = state_value(next) - state_value(&now.clone().inner());
        let PolicyLoss { loss: policy_loss, weights } =
            policy_loss(&model.action_predictor, model.log_stds.val(), &inputs, clips, advantage, settings, rng);
        let total = value_loss.clone() + policy_loss.clone();
        let metrics = vec![
            ("loss", scalar(&total)),
            ("value_loss", scalar(&value_loss)),
            ("policy_loss", scalar(&policy_loss)),
            ("value", scalar(&value.mean())),
            ("weight", scalar(&weights.mean())),
            ("reached", scalar(&relabelled.reached.clone().mean())),
        ];
        finish((&model, &self.encoder), &total, metrics, training, encoding)
    }
}

impl Gciql {
    /// Computes the losses of implicit Q-learning: values by expectile regression on a critic, the critic by regression
    /// on bootstrapped targets, the policy by advantage-weighted regression.
    pub fn losses(
        &self,
        clips: &Clips,
        relabelled: &Relabelled,
        settings: &ValueLoss,
        rng: &mut DropoutRng<'_>,
        training: bool,
    ) -> StepOutput {
        let model = self.clone().train();
        let encoders = Encoders::new(&self.encoder, &model.encoder, self.config.frozen, training, clips);
        let (inputs, encoding) = head_inputs(&encoders, clips, relabelled);
        let HeadInputs { now, goal, policy_goal, .. } = &inputs;
        let (actions, frames) = (clips.actions.clone(), now.clone().inner());
        let evaluate = |critic: &Critic, goal: &Tensor<3>| {
            critic.forward(&frames, actions.clone(), goal, &mut DropoutRng::disabled())
        };

        let target = bootstrap(&self.value_predictor.teacher, &inputs, relabelled, settings);
        let critic = model.critic_predictor.student.forward(now, actions.clone().autodiff(), goal, rng);
        let critic_loss = (critic - target.autodiff()).square().mean();

        let target = evaluate(&self.critic_predictor.teacher, &goal.clone().inner());
        let value = model.value_predictor.student.forward(now, goal, rng);
        let value_loss = loss::expectile(value.clone(), target.autodiff(), settings.expectile);

        let state_value = self.value_predictor.student.forward(&frames, policy_goal, &mut DropoutRng::disabled());
        let advantage = evaluate(&self.critic_predictor.student, policy_goal) - state_value;
        let PolicyLoss { loss: policy_loss, weights } =
            policy_loss(&model.action_predictor, model.log_stds.val(), &inputs, clips, advantage, settings, rng);
        let total = value_loss.clone() + critic_loss.clone() + policy_loss.clone();
        let metrics = vec![
            ("loss", scalar(&total)),
            ("value_loss", scalar(&value_loss)),
            ("critic_loss", scalar(&critic_loss)),
            ("policy_loss", scalar(&policy_loss)),
            ("value", scalar(&value.mean())),
            ("weight", scalar(&weights.mean())),
            ("reached", scalar(&relabelled.reached.clone().mean())),
        ];
        finish((&model, &self.encoder), &total, metrics, training, encoding)
    }
}

/// The name of the encoder in a model.
pub(super) const ENCODER: &str = "encoder";

/// The state of encoding the images of a batch that the gradients read.
struct Encoding<'a> {
    /// The statistics of the batch.
    statistics: Vec<BatchStatistics>,
    /// The pass on the CPU kernels; `None` if Burn differentiates the encoder.
    kernels: Option<CellPass<'a>>,
}

/// The encoder of a model, in and outside the autodiff graph. In training, an encoder that is not frozen normalises with
/// the statistics of the batch.
struct Encoders<'a> {
    plain: &'a Backbone,
    trained: &'a Backbone,
    frozen: bool,
    training: bool,
    clips: usize,
}

impl<'a> Encoders<'a> {
    fn new(plain: &'a Backbone, trained: &'a Backbone, frozen: bool, training: bool, clips: &Clips) -> Self {
        let [count, _, _] = clips.actions.dims();
        Self { plain, trained, frozen, training, clips: count }
    }

    /// Encodes frames and goals as one batch in the autodiff graph, with the patches of a clip in one row.
    ///
    /// # Shapes
    /// `frames` is `[clips * frames, patches, 3 * patch * patch]`, `goals` has one image per clip; returns
    /// `[clips, frames * patches, dim]` and `[clips, patches, dim]`.
    fn with_gradient(&self, frames: Tensor<3>, goals: Tensor<3>) -> ([Tensor<3>; 2], Encoding<'a>) {
        let images = Tensor::cat(vec![frames, goals], 0);
        let trains = self.training && !self.frozen;
        let (patches, encoding) = match trains.then(|| CellPass::forward(self.plain, &images)).flatten() {
            Some((pass, statistics)) => (pass.cells.clone(), Encoding { statistics, kernels: Some(pass) }),
            None if self.frozen => {
                (self.plain.patches(images).autodiff(), Encoding { statistics: vec![], kernels: None })
            }
            None => {
                let (patches, statistics) = self.encode(self.trained, images.autodiff());
                (patches, Encoding { statistics, kernels: None })
            }
        };
        let [all, count, dim] = patches.dims();
        let frames = all - self.clips;
        let part = |range: Range<usize>| {
            let per_clip = range.len() / self.clips;
            patches.clone().slice([range, 0..count, 0..dim]).reshape([self.clips, per_clip * count, dim])
        };
        ([part(0..frames), part(frames..all)], encoding)
    }

    /// Encodes images outside the autodiff graph.
    ///
    /// # Shapes
    /// `images` is `[clips, patches, 3 * patch * patch]`; returns `[clips, patches, dim]`.
    fn without_gradient(&self, images: Tensor<3>) -> Tensor<3> {
        self.encode(self.plain, images).0
    }

    fn encode(&self, encoder: &Backbone, images: Tensor<3>) -> (Tensor<3>, Vec<BatchStatistics>) {
        if self.training && !self.frozen { encoder.patches_train(images) } else { (encoder.patches(images), vec![]) }
    }
}

/// Encodes the inputs of the heads; only the history and the goal of the values are encoded in the autodiff graph.
fn head_inputs<'a>(encoders: &Encoders<'a>, clips: &Clips, relabelled: &Relabelled) -> (HeadInputs, Encoding<'a>) {
    let [count, history, _] = clips.actions.dims();
    let [frames, patches, elements] = clips.frames.dims();
    let steps = frames / count;
    let images = |range: Range<usize>| {
        let length = range.len();
        let frames = clips.frames.clone().reshape([count, steps, patches * elements]);
        frames.slice([0..count, range, 0..patches * elements]).reshape([count * length, patches, elements])
    };
    let ([now, goal], encoding) = encoders.with_gradient(images(0..history), clips.goal.clone());
    let last = encoders.without_gradient(images(history..steps));
    let [_, tokens, dim] = now.dims();
    let later = now.clone().inner().slice([0..count, tokens / history..tokens, 0..dim]);
    let inputs = HeadInputs {
        now,
        goal,
        next: if history > 1 { Tensor::cat(vec![later, last], 1) } else { last },
        policy_goal: encoders.without_gradient(relabelled.policy_goal.clone()),
    };
    (inputs, encoding)
}

/// Returns the bootstrapped targets `r + γ m V(s', g)`: the reward `r` is -1 and the mask `m` is 1 until the goal is
/// reached, and then `r` and `m` are 0.
///
/// # Shapes
/// Returns `[clips, history, 1]`.
fn bootstrap(teacher: &ValueHead, inputs: &HeadInputs, relabelled: &Relabelled, settings: &ValueLoss) -> Tensor<3> {
    let next = teacher.forward(&inputs.next, &inputs.goal.clone().inner(), &mut DropoutRng::disabled());
    let not_reached = -relabelled.reached.clone() + 1.0;
    (next * settings.discount - 1.0) * not_reached
}

/// The loss of a policy and the advantage weights of actions.
struct PolicyLoss {
    loss: Tensor<1>,
    weights: Tensor<3>,
}

/// Computes advantage-weighted regression on the recorded actions, without a gradient with respect to the encoder.
fn policy_loss(
    head: &Head,
    log_stds: Tensor<1>,
    inputs: &HeadInputs,
    clips: &Clips,
    advantage: Tensor<3>,
    settings: &ValueLoss,
    rng: &mut DropoutRng<'_>,
) -> PolicyLoss {
    let weights = loss::weights(advantage, settings.temperature);
    let means = head.forward(&inputs.now.clone().inner().autodiff(), &inputs.policy_goal.clone().autodiff(), rng);
    let loss = loss::regression(means, log_stds, clips.actions.clone().autodiff(), weights.clone().autodiff());
    PolicyLoss { loss, weights }
}

fn scalar(value: &Tensor<1>) -> f64 {
    f64::from(value.clone().inner().into_scalar::<f32>())
}

/// Returns the output of a training step; the gradients are empty unless `training`. The buffers are the batch statistics
/// of the encoder.
fn finish<M: Module>(
    (model, encoder): (&M, &Backbone),
    loss: &Tensor<1>,
    metrics: Vec<(&'static str, f64)>,
    training: bool,
    encoding: Encoding<'_>,
) -> StepOutput {
    let (mut gradients, mut buffers) = (Named::new(), Named::new());
    if training {
        let mut all = loss.clone().backward();
        gradients = parameters::gradients(model, &all);
        if let Some(pass) = encoding.kernels {
            gradients.extend(pass.backward(&mut all));
        }
        encoder.store(encoding.statistics, ENCODER, &mut buffers);
    }
    StepOutput { metrics, gradients, buffers }
}
