//! One training step: losses and gradients of a batch of transitions.
//!
//! Three losses that share nothing but numbers: the Q functions', the policy's, the temperature's. All gradients are taken
//! at the same weights; the publication and its descendants move the Q functions before the policy looks at them.

use super::config::SacLoss;
use super::model::{Critics, Sac};
use crate::nn::Named;
use crate::nn::parameters;
use burn::module::Module;
use burn::tensor::Tensor;

/// Transitions.
pub struct Transitions {
    /// `[rows, inputs]`.
    pub observations: Tensor<2>,
    /// `[rows, actions]`, in model units.
    pub actions: Tensor<2>,
    /// `[rows]`.
    pub rewards: Tensor<1>,
    /// `[rows]`: 1 where the episode terminated.
    pub terminated: Tensor<1>,
    /// `[rows, inputs]`.
    pub next: Tensor<2>,
    /// Standard normal, `[rows, actions]`: for the actions at the next observations, and for those the policy is judged by.
    pub noise: [Tensor<2>; 2],
}

/// What a step found.
pub struct Step {
    /// Half the mean squared error of both Q functions.
    pub critic: f64,
    /// What the policy lowers: temperature times log-density, less value.
    pub actor: f64,
    /// The temperature.
    pub temperature: f64,
    /// The mean entropy of the policy, estimated from the actions drawn.
    pub entropy: f64,
    /// The mean value of the policy's actions.
    pub q: f64,
    /// Gradients by parameter, flat.
    pub gradients: Named<Tensor<1>>,
}

/// Losses and gradients of a batch. `model` is without autodiff.
#[allow(clippy::cast_precision_loss)]
pub fn step(model: &Sac, batch: &Transitions, config: &SacLoss) -> Step {
    let Transitions { observations, actions, rewards, terminated, next, noise: [next_noise, noise] } = batch;
    let temperature = f64::from(model.log_ent_coef.val().into_scalar::<f32>()).exp();
    let mut gradients = Named::new();
    let mut keep = |prefix: &str, found: Named<Tensor<1>>| {
        gradients.extend(found.into_iter().map(|(name, gradient)| (format!("{prefix}.{name}"), gradient)));
    };

    let drawn = model.actor.draw(next.clone(), next_noise.clone());
    let [first, second] = model.critic_target.forward(Tensor::cat(vec![next.clone(), drawn.actions], 1));
    let soft = first.min_pair(second) - drawn.log_density * temperature;
    let target = (rewards.clone() + soft * (terminated.clone().neg() + 1.0) * config.discount).autodiff();
    let critic = model.critic.clone().train();
    let errors = critic
        .forward(Tensor::cat(vec![observations.clone(), actions.clone()], 1).autodiff())
        .map(|q| (q - target.clone()).square().mean());
    let [first, second] = errors;
    let critic_loss = (first + second) * 0.5;
    keep("critic", parameters::gradients(&critic, &critic_loss.backward()));

    let actor = model.actor.clone().train();
    let observations = observations.clone().autodiff();
    let drawn = actor.draw(observations.clone(), noise.clone().autodiff());
    let [first, second] = still(&model.critic).forward(Tensor::cat(vec![observations, drawn.actions], 1));
    let q = first.min_pair(second).mean();
    let density = drawn.log_density.mean();
    let actor_loss = density.clone() * temperature - q.clone();
    keep("actor", parameters::gradients(&actor, &actor_loss.backward()));

    // The temperature's loss is -ln α (ln π + H), whose gradient needs no graph.
    let entropy = -value_of(&density);
    let wanted = config.entropy * actions.dims()[1] as f64;
    let gradient = model.log_ent_coef.val().zeros_like() + (entropy - wanted);
    gradients.insert("log_ent_coef".to_owned(), gradient);
    Step {
        critic: value_of(&critic_loss),
        actor: value_of(&actor_loss),
        temperature,
        entropy,
        q: value_of(&q),
        gradients,
    }
}

/// The Q functions as constants of a graph: gradients flow through them, not to them.
fn still(critics: &Critics) -> Critics {
    critics.clone().train().no_grad()
}

fn value_of(tensor: &Tensor<1>) -> f64 {
    f64::from(tensor.clone().inner().into_scalar::<f32>())
}
