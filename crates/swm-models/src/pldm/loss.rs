//! The regularisation terms of PLDM (Sobal et al. 2025, arXiv 2502.14819): variance and covariance as in VICReg (Bardes
//! et al. 2022), over the batch and over time, temporal alignment, and optionally straight latent paths (arXiv
//! 2603.12231). The inverse-dynamics term is computed with [`super::Idm`].

use crate::lewm::loss::straightening;
use burn::tensor::{Tensor, activation};
use serde::{Deserialize, Serialize};

/// The weights of the terms of the loss; the prediction error has the weight 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PldmLoss {
    /// Weight of the variance over the batch.
    pub std: f32,
    /// Weight of the variance over time.
    pub std_t: f32,
    /// Weight of the covariance over the batch.
    pub cov: f32,
    /// Weight of the covariance over time.
    pub cov_t: f32,
    /// Weight of temporal alignment.
    pub temp_align: f32,
    /// Weight of inverse dynamics.
    pub idm: f32,
    /// Weight of straight paths.
    pub temp_straight: f32,
    /// Hidden features of the inverse dynamics.
    pub idm_hidden: usize,
}

/// The terms that depend on latents only, each `[1]`.
pub struct Terms {
    /// Mean of `max(0, 1 - std)` over latent elements, with the standard deviation over the batch.
    pub std: Tensor<1>,
    /// Mean of `max(0, 1 - std)` over latent elements, with the standard deviation over time, of latents centred over
    /// the batch.
    pub std_t: Tensor<1>,
    /// Mean square of the covariances of two latent elements over the batch.
    pub cov: Tensor<1>,
    /// Mean square of the covariances of two latent elements over time.
    pub cov_t: Tensor<1>,
    /// Mean square of the difference between consecutive latents.
    pub temp_align: Tensor<1>,
    /// Negative cosine between consecutive differences; `None` for clips of two frames.
    pub temp_straight: Option<Tensor<1>>,
}

/// The value that is added to a variance before the square root.
const VARIANCE_EPSILON: f64 = 1e-4;

impl Terms {
    /// Computes the terms.
    ///
    /// # Shapes
    /// `z` is `[clips, steps, latent]` with at least two clips and two steps.
    pub fn of(z: Tensor<3>) -> Self {
        let [clips, steps, latent] = z.dims();
        let centred = z.clone() - z.clone().mean_dim(0);
        let by_time = centred.clone().swap_dims(0, 1);
        let frames = |from: usize, to: usize| z.clone().slice([0..clips, from..to, 0..latent]);
        let differences = frames(1, steps) - frames(0, steps - 1);
        let straight = (steps > 2).then(|| straightening(differences.clone()));
        Self {
            std: spread(by_time.clone()),
            std_t: spread(centred.clone()),
            cov: covariance(by_time),
            cov_t: covariance(centred),
            temp_align: differences.square().mean(),
            temp_straight: straight,
        }
    }

    /// Returns the weighted sum of the terms.
    pub fn sum(&self, weights: &PldmLoss) -> Tensor<1> {
        let mut sum = self.std.clone() * weights.std
            + self.std_t.clone() * weights.std_t
            + self.cov.clone() * weights.cov
            + self.cov_t.clone() * weights.cov_t
            + self.temp_align.clone() * weights.temp_align;
        if let Some(straight) = &self.temp_straight {
            sum = sum + straight.clone() * weights.temp_straight;
        }
        sum
    }
}

/// Returns the mean of `max(0, 1 - std)` with the standard deviation over rows.
///
/// # Shapes
/// `x` is `[groups, rows, features]`; returns `[1]`.
fn spread(x: Tensor<3>) -> Tensor<1> {
    let [_, rows, _] = x.dims();
    let centred = x.clone() - x.mean_dim(1);
    let variance = centred.square().sum_dim(1) / (rows as f64 - 1.0);
    activation::relu(((variance + VARIANCE_EPSILON).sqrt() - 1.0).neg()).mean()
}

/// Returns the mean square of the elements of `xᵀx / (rows - 1)` off the diagonal. `x` must be centred.
///
/// # Shapes
/// `x` is `[groups, rows, features]`; returns `[1]`.
fn covariance(x: Tensor<3>) -> Tensor<1> {
    let [groups, rows, features] = x.dims();
    let factor = 1.0 / (rows as f64 - 1.0);
    let all = (x.clone().transpose().matmul(x.clone()) * factor).square().sum();
    let diagonal = (x.square().sum_dim(1) * factor).square().sum();
    (all - diagonal) / (groups * features * (features - 1)) as f64
}
