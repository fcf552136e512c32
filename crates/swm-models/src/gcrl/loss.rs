//! The losses of goal-conditioned learning (Kostrikov et al. 2021, "Offline reinforcement learning with implicit
//! Q-learning"; Peng et al. 2019, "Advantage-weighted regression").

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use swm_data::GoalMixture;

/// The largest weight an action gets by its advantage, as published.
pub const LARGEST_WEIGHT: f32 = 100.0;
/// The logarithm of a policy's spread is kept within these, as published.
pub const LOG_STD: [f32; 2] = [-5.0, 2.0];

/// Settings of value learning and policy extraction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueLoss {
    /// γ: what a value a model step later is worth now.
    pub discount: f32,
    /// τ: 0.5 is the mean of what follows, towards 1 the best of it.
    pub expectile: f32,
    /// α: how much more an action counts that is better than expected.
    pub temperature: f32,
    /// ρ: the share of its former self that a target network keeps in a step.
    pub target: f32,
    /// Where the goals come from that values are learnt for.
    pub goals: GoalMixture,
    /// Where the goals come from that the policy is learnt for.
    pub policy_goals: GoalMixture,
}

/// Settings of behavioural cloning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CloningLoss {
    /// Where goals come from.
    pub goals: GoalMixture,
}

/// The mean of `|τ - 1[u < 0]| u²` over `u = targets - predictions`: least at the τ-expectile of the targets.
///
/// # Shapes
/// Any, twice the same.
pub fn expectile<const D: usize>(predictions: Tensor<D>, targets: Tensor<D>, tau: f32) -> Tensor<1> {
    let residual = targets - predictions;
    // Where the residual is below 0 the weight is 1 - τ, else τ.
    let below = residual.clone().lower_elem(0.0).float();
    let weight = (below * (1.0 - 2.0 * tau) + tau).detach();
    (weight * residual.square()).mean()
}

/// What an action weighs whose advantage is given: `exp(α A)`, at most [`LARGEST_WEIGHT`].
///
/// # Shapes
/// Any, to the same.
pub fn weights<const D: usize>(advantage: Tensor<D>, temperature: f32) -> Tensor<D> {
    // The bound is put before the exponential, so that nothing overflows.
    (advantage * temperature).clamp_max(LARGEST_WEIGHT.ln()).exp()
}

/// The negative log-likelihood of actions under a normal distribution, without its constant, weighted, on average over
/// all numbers.
///
/// # Shapes
/// Means and actions `[rows, frames, numbers]`, logarithms of the spread `[numbers]`, weights `[rows, frames, 1]`.
pub fn regression(means: Tensor<3>, log_stds: Tensor<1>, actions: Tensor<3>, weights: Tensor<3>) -> Tensor<1> {
    let log_stds = log_stds.clamp(LOG_STD[0], LOG_STD[1]).unsqueeze::<3>();
    let precision = (log_stds.clone() * -2.0).exp();
    (((actions - means).square() * precision * 0.5 + log_stds) * weights).mean()
}

#[cfg(test)]
mod tests {
    use super::*;
    use burn::tensor::Device;

    fn tensor(values: &[f32]) -> Tensor<1> {
        Tensor::from_floats(values, &Device::flex())
    }

    #[test]
    fn an_expectile_leans_to_the_better_outcomes() {
        // Residuals 1 and -3: 0.9 * 1 + 0.1 * 9 over two.
        let loss: f32 = expectile(tensor(&[0.0, 0.0]), tensor(&[1.0, -3.0]), 0.9).into_scalar();
        assert!((loss - 0.9).abs() < 1e-6, "{loss}");
    }

    #[test]
    fn weights_are_bounded_whatever_the_advantage() {
        let weights: Vec<f32> = weights(tensor(&[0.0, 0.1, 1e6, -1e6]), 10.0).into_data().iter::<f32>().collect();
        assert!((weights[0] - 1.0).abs() < 1e-6 && (weights[1] - 1f32.exp()).abs() < 1e-5, "{weights:?}");
        assert!((weights[2] - LARGEST_WEIGHT).abs() < 1e-3 && weights[3] == 0.0, "{weights:?}");
    }
}
