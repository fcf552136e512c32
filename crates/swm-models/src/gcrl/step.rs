//! Loss and gradients of some clips.
//!
//! Values and policy are learnt at once, as Kostrikov et al. do: the policy's loss reaches neither the values nor the
//! encoder, so its gradients are those of the two phases of the paper's algorithms.

use super::heads::{Critic, Head};
use super::loss::{self, ValueLoss};
use super::model::{Gcbc, Gciql, Gcivl};
use crate::nn::{Backbone, DropoutRng, parameters};
use crate::train::StepOutput;
use burn::module::Module;
use burn::tensor::Tensor;

/// Some clips, normalised; all tensors are without autodiff.
#[derive(Clone, Debug)]
pub struct Clips {
    /// Pictures, cut up, `[clips * steps, patches, numbers]`: the history, and the frame after it where values are learnt.
    pub frames: Tensor<3>,
    /// What the values (of GCBC: the policy) shall lead to, `[clips, patches, numbers]`.
    pub goal: Tensor<3>,
    /// Actions taken from the frames of the history, `[clips, history, numbers]`.
    pub actions: Tensor<3>,
}

/// What learning values needs beside [`Clips`].
#[derive(Clone, Debug)]
pub struct Relabelled {
    /// What the policy shall lead to, `[clips, patches, numbers]`.
    pub policy_goal: Tensor<3>,
    /// 1 where a frame of the history shows the goal, else 0, `[clips, history, 1]`.
    pub reached: Tensor<3>,
}

/// What the heads look at, `[clips, frames * patches, dim]` each.
struct Views {
    /// The history, in the graph of a trained encoder.
    now: Tensor<3>,
    /// The goal, in that graph.
    goal: Tensor<3>,
    /// The frames that follow those of the history; outside of any graph, as is the rest.
    then: Tensor<3>,
    policy_goal: Tensor<3>,
}

impl Gcbc {
    /// The mean squared error of actions.
    pub fn losses(&self, clips: &Clips, noise: &mut DropoutRng<'_>, training: bool) -> StepOutput {
        let model = self.clone().train();
        let [count, _, _] = clips.actions.dims();
        let see = |pictures: &Tensor<3>| {
            if self.config.frozen {
                embed(&self.encoder, pictures.clone(), count).autodiff()
            } else {
                embed(&model.encoder, pictures.clone().autodiff(), count)
            }
        };
        let means = model.action_predictor.forward(&see(&clips.frames), &see(&clips.goal), noise);
        let loss = (means - clips.actions.clone().autodiff()).square().mean();
        finish(&model, &loss, vec![("loss", number(&loss))], training)
    }
}

impl Gcivl {
    /// Values by expectile regression on their own targets, a policy by regression weighted by what an action gains.
    pub fn losses(
        &self,
        clips: &Clips,
        more: &Relabelled,
        settings: &ValueLoss,
        noise: &mut DropoutRng<'_>,
        training: bool,
    ) -> StepOutput {
        let model = self.clone().train();
        let views = views(&self.encoder, &model.encoder, self.config.frozen, clips, more);
        let Views { now, goal, then, policy_goal } = &views;
        let target = bootstrap(&self.value_predictor.teacher, &views, more, settings);
        let value = model.value_predictor.student.forward(now, goal, noise);
        let value_loss = loss::expectile(value.clone(), target.autodiff(), settings.expectile);

        let worth =
            |frames: &Tensor<3>| self.value_predictor.student.forward(frames, policy_goal, &mut DropoutRng::disabled());
        let advantage = worth(then) - worth(&now.clone().inner());
        let Policy { loss: policy_loss, weights } =
            policy(&model.action_predictor, model.log_stds.val(), &views, clips, advantage, settings, noise);
        let total = value_loss.clone() + policy_loss.clone();
        let metrics = vec![
            ("loss", number(&total)),
            ("value_loss", number(&value_loss)),
            ("policy_loss", number(&policy_loss)),
            ("value", number(&value.mean())),
            ("weight", number(&weights.mean())),
            ("reached", number(&more.reached.clone().mean())),
        ];
        finish(&model, &total, metrics, training)
    }
}

impl Gciql {
    /// Values by expectile regression on a critic, the critic by regression on what follows, a policy by regression weighted
    /// by how much better than the state's value an action is.
    pub fn losses(
        &self,
        clips: &Clips,
        more: &Relabelled,
        settings: &ValueLoss,
        noise: &mut DropoutRng<'_>,
        training: bool,
    ) -> StepOutput {
        let model = self.clone().train();
        let views = views(&self.encoder, &model.encoder, self.config.frozen, clips, more);
        let Views { now, goal, policy_goal, .. } = &views;
        let (actions, seen) = (clips.actions.clone(), now.clone().inner());
        let judge = |critic: &Critic, goal: &Tensor<3>| {
            critic.forward(&seen, actions.clone(), goal, &mut DropoutRng::disabled())
        };

        let target = bootstrap(&self.value_predictor.teacher, &views, more, settings);
        let critic = model.critic_predictor.student.forward(now, actions.clone().autodiff(), goal, noise);
        let critic_loss = (critic - target.autodiff()).square().mean();

        let target = judge(&self.critic_predictor.teacher, &goal.clone().inner());
        let value = model.value_predictor.student.forward(now, goal, noise);
        let value_loss = loss::expectile(value.clone(), target.autodiff(), settings.expectile);

        let worth = self.value_predictor.student.forward(&seen, policy_goal, &mut DropoutRng::disabled());
        let advantage = judge(&self.critic_predictor.student, policy_goal) - worth;
        let Policy { loss: policy_loss, weights } =
            policy(&model.action_predictor, model.log_stds.val(), &views, clips, advantage, settings, noise);
        let total = value_loss.clone() + critic_loss.clone() + policy_loss.clone();
        let metrics = vec![
            ("loss", number(&total)),
            ("value_loss", number(&value_loss)),
            ("critic_loss", number(&critic_loss)),
            ("policy_loss", number(&policy_loss)),
            ("value", number(&value.mean())),
            ("weight", number(&weights.mean())),
            ("reached", number(&more.reached.clone().mean())),
        ];
        finish(&model, &total, metrics, training)
    }
}

/// The patches of pictures, those of a clip in one row.
fn embed(encoder: &Backbone, pictures: Tensor<3>, clips: usize) -> Tensor<3> {
    let patches = encoder.patches(pictures);
    let [frames, count, dim] = patches.dims();
    patches.reshape([clips, frames / clips * count, dim])
}

/// Only what a loss differentiates is encoded within a graph: history and goal of the values.
fn views(plain: &Backbone, trained: &Backbone, frozen: bool, clips: &Clips, more: &Relabelled) -> Views {
    let [count, history, _] = clips.actions.dims();
    let [frames, patches, numbers] = clips.frames.dims();
    let steps = frames / count;
    let part = |steps_of: std::ops::Range<usize>| {
        let length = steps_of.len();
        let frames = clips.frames.clone().reshape([count, steps, patches * numbers]);
        frames.slice([0..count, steps_of, 0..patches * numbers]).reshape([count * length, patches, numbers])
    };
    let see = |pictures: Tensor<3>| {
        if frozen { embed(plain, pictures, count).autodiff() } else { embed(trained, pictures.autodiff(), count) }
    };
    let now = see(part(0..history));
    let last = embed(plain, part(history..steps), count);
    let [_, tokens, dim] = now.dims();
    let rest = now.clone().inner().slice([0..count, tokens / history..tokens, 0..dim]);
    Views {
        now,
        goal: see(clips.goal.clone()),
        then: if history > 1 { Tensor::cat(vec![rest, last], 1) } else { last },
        policy_goal: embed(plain, more.policy_goal.clone(), count),
    }
}

/// `r + γ m V(s', g)`: a step costs 1 until the goal is reached, where nothing follows.
fn bootstrap(teacher: &Head, views: &Views, more: &Relabelled, settings: &ValueLoss) -> Tensor<3> {
    let next = teacher.forward(&views.then, &views.goal.clone().inner(), &mut DropoutRng::disabled());
    let under_way = -more.reached.clone() + 1.0;
    (next * settings.discount - 1.0) * under_way
}

/// The loss of a policy, and what actions weighed in it.
struct Policy {
    loss: Tensor<1>,
    weights: Tensor<3>,
}

/// Regression on the actions of the data, weighted by their advantage. Nothing of it reaches the encoder.
fn policy(
    head: &Head,
    log_stds: Tensor<1>,
    views: &Views,
    clips: &Clips,
    advantage: Tensor<3>,
    settings: &ValueLoss,
    noise: &mut DropoutRng<'_>,
) -> Policy {
    let weights = loss::weights(advantage, settings.temperature);
    let means = head.forward(&views.now.clone().inner().autodiff(), &views.policy_goal.clone().autodiff(), noise);
    let loss = loss::regression(means, log_stds, clips.actions.clone().autodiff(), weights.clone().autodiff());
    Policy { loss, weights }
}

fn number(value: &Tensor<1>) -> f64 {
    f64::from(value.clone().inner().into_scalar::<f32>())
}

/// The output of a step; gradients only where somebody wants them.
fn finish<M: Module>(model: &M, loss: &Tensor<1>, metrics: Vec<(&'static str, f64)>, training: bool) -> StepOutput {
    let gradients =
        if training { parameters::gradients(model, &loss.clone().backward()) } else { parameters::Named::new() };
    StepOutput { metrics, gradients, ..StepOutput::default() }
}
