//! One training step of a SAC (Haarnoja et al. 2018, equations 5, 7 and 18): losses and gradients of a batch of
//! transitions.
//!
//! All gradients are computed at the same weights; the publication updates the Q functions before computing the policy's loss.
//! [`cpu_losses`] computes them on the CPU. On other devices, the losses of Q functions and policy have separate autodiff graphs.

use super::config::SacLoss;
use super::cpu_losses;
use super::model::{Critics, Sac};
use crate::nn::activation::has_kernels;
use crate::nn::{Named, parameters};
use burn::module::Module;
use burn::tensor::Tensor;

/// A batch of transitions.
pub struct Transitions {
    /// The observations before the actions, `[rows, inputs]`.
    pub observations: Tensor<2>,
    /// The actions in model units, `[rows, action_dim]`.
    pub actions: Tensor<2>,
    /// The rewards, `[rows]`.
    pub rewards: Tensor<1>,
    /// 1 where the episode terminated, else 0: `[rows]`.
    pub terminated: Tensor<1>,
    /// The observations after the actions, `[rows, inputs]`.
    pub next: Tensor<2>,
    /// Standard normal noise of the actions at the next observations, and of the actions in the policy's loss,
    /// `[rows, action_dim]` each.
    pub noise: [Tensor<2>; 2],
}

/// Losses and gradients of a batch.
pub struct SacStep {
    /// Half the sum of the mean squared errors of the two Q functions.
    pub critic: f64,
    /// The policy's loss: temperature times log-density minus value.
    pub actor: f64,
    /// The temperature.
    pub temperature: f64,
    /// The mean entropy of the policy, estimated from sampled actions.
    pub entropy: f64,
    /// The mean value of the policy's actions.
    pub q: f64,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
}

/// The losses of Q functions and policy, and their gradients.
pub(super) struct Losses {
    /// Half the sum of the mean squared errors of the two Q functions.
    pub critic: f64,
    /// The policy's loss.
    pub actor: f64,
    /// The mean of the log-density of the policy's actions.
    pub density: f64,
    /// The mean value of the policy's actions.
    pub q: f64,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
}

/// Computes losses and gradients of a batch. `model` is outside autodiff.
pub fn step(model: &Sac, batch: &Transitions, config: &SacLoss) -> SacStep {
    let temperature = f64::from(model.log_ent_coef.val().into_scalar::<f32>()).exp();
    let compute = if has_kernels(&batch.observations) { cpu_losses::losses } else { losses };
    let Losses { critic, actor, density, q, mut gradients } = compute(model, batch, config, temperature);

    // The temperature's loss is -ln α (ln π + H), whose gradient needs no autodiff graph.
    let entropy = -density;
    let target_entropy = config.entropy * batch.actions.dims()[1] as f64;
    let gradient = model.log_ent_coef.val().zeros_like() + (entropy - target_entropy);
    gradients.insert("log_ent_coef".to_owned(), gradient);
    SacStep { critic, actor, temperature, entropy, q, gradients }
}

/// Computes the losses with autodiff graphs. The two losses are computed at the same weights, so that neither waits for the other.
fn losses(model: &Sac, batch: &Transitions, config: &SacLoss, temperature: f64) -> Losses {
    let Transitions { observations, actions, rewards, terminated, next, noise: [next_noise, noise] } = batch;
    let q_functions = || {
        let sample = model.actor.sample(next.clone(), next_noise.clone());
        let [first, second] = model.critic_target.forward(Tensor::cat(vec![next.clone(), sample.actions], 1));
        let soft = first.min_pair(second) - sample.log_density * temperature;
        let target = (rewards.clone() + soft * (terminated.clone().neg() + 1.0) * config.discount).autodiff();
        let critic = model.critic.clone().train();
        let errors = critic
            .forward(Tensor::cat(vec![observations.clone(), actions.clone()], 1).autodiff())
            .map(|q| (q - target.clone()).square().mean());
        let [first, second] = errors;
        let loss = (first + second) * 0.5;
        (value_of(&loss), parameters::gradients(&critic, &loss.backward()))
    };
    let policy = || {
        let actor = model.actor.clone().train();
        let observations = observations.clone().autodiff();
        let sample = actor.sample(observations.clone(), noise.clone().autodiff());
        let [first, second] = constants(&model.critic).forward(Tensor::cat(vec![observations, sample.actions], 1));
        let (q, density) = (first.min_pair(second).mean(), sample.log_density.mean());
        let loss = density.clone() * temperature - q.clone();
        let values = [&loss, &density, &q].map(value_of);
        (values, parameters::gradients(&actor, &loss.backward()))
    };
    let ((critic, of_critic), ([actor, density, q], of_actor)) = rayon::join(q_functions, policy);
    let mut gradients = parameters::prefixed("critic", of_critic);
    gradients.extend(parameters::prefixed("actor", of_actor));
    Losses { critic, actor, density, q, gradients }
}

/// Returns the Q functions as constants of an autodiff graph: gradients reach the inputs of the Q functions, not the
/// weights.
fn constants(critics: &Critics) -> Critics {
    critics.clone().train().no_grad()
}

fn value_of(tensor: &Tensor<1>) -> f64 {
    f64::from(tensor.clone().inner().into_scalar::<f32>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::nn::{Init, normal, parameters::host};
    use crate::sac::SacConfig;
    use burn::tensor::{Device, TensorData};
    use swm_core::Key;

    #[test]
    fn losses_and_gradients_on_the_cpu_are_those_of_autodiff_graphs() {
        let (device, key) = (Device::flex(), Key::new(3));
        let loss = SacLoss { discount: 0.9, tau: 0.1, entropy: -1.0, temperature: 0.3 };
        let config = SacConfig { columns: vec![], hidden: 40 };
        for (rows, inputs, width) in [(1, 1, 1), (33, 7, 3), (300, 40, 2)] {
            let mut model = Sac::init(&config, &loss, inputs, width, &Init::new(key, &device));
            // Some standard deviations are clamped.
            model.actor.log_std.weight = model.actor.log_std.weight.map(|weight| weight * 30.0);
            let values = |name: &str, width: usize| {
                let values = normal(&[key.with(name)], rows * width);
                Tensor::<2>::from_data(TensorData::new(values, [rows, width]), &device)
            };
            let batch = Transitions {
                observations: values("observations", inputs),
                actions: values("actions", width).tanh(),
                rewards: values("rewards", 1).squeeze_dim(1),
                terminated: values("terminated", 1).greater_elem(1.0).float().squeeze_dim(1),
                next: values("next", inputs),
                noise: [values("next noise", width), values("noise", width)],
            };
            let [found, expected] = [cpu_losses::losses, losses].map(|losses| losses(&model, &batch, &loss, 0.3));
            let close = |found: f64, expected: f64, what: &str| {
                let tolerance = 1e-4 * expected.abs().max(1.0);
                assert!((found - expected).abs() < tolerance, "{what}: {found}, expected {expected}");
            };
            close(found.critic, expected.critic, "critic");
            close(found.actor, expected.actor, "actor");
            close(found.density, expected.density, "density");
            close(found.q, expected.q, "q");
            assert!(found.gradients.keys().eq(expected.gradients.keys()));
            for (name, gradient) in &expected.gradients {
                let both = [&found.gradients[name], gradient].map(|gradient| host(gradient.clone()));
                assert_eq!(both[0].len(), both[1].len(), "{name}");
                both[0].iter().zip(&both[1]).for_each(|(f, e)| close(f64::from(*f), f64::from(*e), name));
            }
        }
    }
}
