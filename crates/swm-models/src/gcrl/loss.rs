//! The losses of goal-conditioned learning (Kostrikov et al. 2021, "Offline reinforcement learning with implicit
//! Q-learning"; Peng et al. 2019, "Advantage-weighted regression").

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};
use swm_data::GoalMixture;

/// The largest advantage weight of an action, as published.
pub const LARGEST_WEIGHT: f32 = 100.0;
/// Bounds of the logarithm of a policy's standard deviation, as published.
pub const LOG_STD: [f32; 2] = [-5.0, 2.0];

/// Settings of value learning and policy extraction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValueLoss {
    /// Discount per model step, γ.
    pub discount: f32,
    /// Expectile, τ: 0.5 estimates the mean outcome, and values close to 1 estimate the best outcome.
    pub expectile: f32,
    /// Inverse temperature of the advantage weights, α.
    pub temperature: f32,
    /// Factor of the old weights in the update of a target network, ρ.
    pub target: f32,
    /// Sources of the goals for value learning.
    pub goals: GoalMixture,
    /// Sources of the goals for policy extraction.
    pub policy_goals: GoalMixture,
}

/// Settings of behavioural cloning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CloningLoss {
    /// Sources of the goals.
    pub goals: GoalMixture,
}

/// Computes the expectile loss (Kostrikov et al. 2021, equation 5), the mean of `|τ - 1[u < 0]| u²` over
/// `u = targets - predictions`.
///
/// # Shapes
/// `predictions` and `targets` have the same shape; returns `[1]`.
pub fn expectile<const D: usize>(predictions: Tensor<D>, targets: Tensor<D>, tau: f32) -> Tensor<1> {
    let residual = targets - predictions;
    // The weight is 1 - τ for negative residuals, else τ.
    let below = residual.clone().lower_elem(0.0).float();
    let weight = (below * (1.0 - 2.0 * tau) + tau).detach();
    (weight * residual.square()).mean()
}

/// Computes advantage weights (Peng et al. 2019, equation 10): `exp(α A)`, at most [`LARGEST_WEIGHT`].
///
/// # Shapes
/// Returns the shape of `advantage`.
pub fn weights<const D: usize>(advantage: Tensor<D>, temperature: f32) -> Tensor<D> {
    // Clamping before the exponential avoids overflow.
    (advantage * temperature).clamp_max(LARGEST_WEIGHT.ln()).exp()
}

/// Computes the weighted negative log-likelihood of actions under a normal distribution, without the constant term,
/// averaged over all elements.
///
/// # Shapes
/// `means` and `actions` are `[rows, frames, action_dim]`, `log_stds` is `[action_dim]`, `weights` is
/// `[rows, frames, 1]`; returns `[1]`.
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
    fn expectile_loss_weights_positive_residuals_by_tau() {
        // Residuals 1 and -3: the loss is (0.9 * 1 + 0.1 * 9) / 2.
        let loss: f32 = expectile(tensor(&[0.0, 0.0]), tensor(&[1.0, -3.0]), 0.9).into_scalar();
        assert!((loss - 0.9).abs() < 1e-6, "{loss}");
    }

    #[test]
    fn advantage_weights_are_bounded() {
        let weights: Vec<f32> = weights(tensor(&[0.0, 0.1, 1e6, -1e6]), 10.0).into_data().iter::<f32>().collect();
        assert!((weights[0] - 1.0).abs() < 1e-6 && (weights[1] - 1f32.exp()).abs() < 1e-5, "{weights:?}");
        assert!((weights[2] - LARGEST_WEIGHT).abs() < 1e-3 && weights[3] == 0.0, "{weights:?}");
    }
}
