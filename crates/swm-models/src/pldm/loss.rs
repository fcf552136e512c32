//! What keeps a PLDM's latents from collapsing, and in order (Sobal et al. 2025, arXiv 2502.14819): variance and
//! covariance as in VICReg (Bardes et al. 2022), over the batch and over time, temporal alignment, and, as an option,
//! straight paths (arXiv 2603.12231). The last term, inverse dynamics, is [`super::Idm`].

use burn::tensor::{Tensor, activation};
use serde::{Deserialize, Serialize};

/// The weights of the terms of the loss; the prediction error has the weight 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PldmLoss {
    /// Of the spread over the batch.
    pub std: f32,
    /// Of the spread over time.
    pub std_t: f32,
    /// Of the covariance over the batch.
    pub cov: f32,
    /// Of the covariance over time.
    pub cov_t: f32,
    /// Of temporal alignment.
    pub temp_align: f32,
    /// Of inverse dynamics.
    pub idm: f32,
    /// Of straight paths.
    pub temp_straight: f32,
    /// Hidden features of the inverse dynamics, which exist for the loss alone.
    pub idm_hidden: usize,
}

/// The terms that look at latents alone, each `[1]`.
pub struct Terms {
    /// By how much the spread of a number falls short of 1, over the batch.
    pub std: Tensor<1>,
    /// The same over time, of latents from which the batch's mean at each time was taken.
    pub std_t: Tensor<1>,
    /// The mean square of the covariances of two numbers, over the batch.
    pub cov: Tensor<1>,
    /// The same over time.
    pub cov_t: Tensor<1>,
    /// The mean square of the way from one latent to the next.
    pub temp_align: Tensor<1>,
    /// The negative cosine between one such way and the next; none for clips of two frames.
    pub temp_straight: Option<Tensor<1>>,
}

/// Added to a variance before its root is taken.
const VARIANCE_EPSILON: f64 = 1e-4;
/// The shortest way that has a direction.
const LENGTH_EPSILON: f64 = 1e-8;

impl Terms {
    /// The terms of latents `[clips, steps, latent]`, at least two of each.
    pub fn of(z: Tensor<3>) -> Self {
        let [clips, steps, latent] = z.dims();
        let centred = z.clone() - z.clone().mean_dim(0);
        let by_time = centred.clone().swap_dims(0, 1);
        let frames = |from: usize, to: usize| z.clone().slice([0..clips, from..to, 0..latent]);
        let way = frames(1, steps) - frames(0, steps - 1);
        let straight = (steps > 2).then(|| {
            let part = |from: usize, to: usize| way.clone().slice([0..clips, from..to, 0..latent]);
            let (before, after) = (part(0, steps - 2), part(1, steps - 1));
            let length = |way: Tensor<3>| way.square().sum_dim(2).clamp_min(LENGTH_EPSILON.powi(2)).sqrt();
            let cosine = (before.clone() * after.clone()).sum_dim(2) / (length(before) * length(after));
            cosine.mean().neg()
        });
        Self {
            std: spread(by_time.clone()),
            std_t: spread(centred.clone()),
            cov: covariance(by_time),
            cov_t: covariance(centred),
            temp_align: way.square().mean(),
            temp_straight: straight,
        }
    }

    /// The weighted sum.
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

/// By how much the standard deviation over rows falls short of 1, on average. `x` is `[groups, rows, numbers]`.
#[allow(clippy::cast_precision_loss)]
fn spread(x: Tensor<3>) -> Tensor<1> {
    let [_, rows, _] = x.dims();
    let centred = x.clone() - x.mean_dim(1);
    let variance = centred.square().sum_dim(1) / (rows as f64 - 1.0);
    activation::relu(((variance + VARIANCE_EPSILON).sqrt() - 1.0).neg()).mean()
}

/// The mean square of what lies off the diagonal of `xᵀx / (rows - 1)`. `x` is `[groups, rows, numbers]`; it is not
/// centred here.
#[allow(clippy::cast_precision_loss)]
fn covariance(x: Tensor<3>) -> Tensor<1> {
    let [groups, rows, numbers] = x.dims();
    let share = 1.0 / (rows as f64 - 1.0);
    let all = (x.clone().transpose().matmul(x.clone()) * share).square().sum();
    let diagonal = (x.square().sum_dim(1) * share).square().sum();
    (all - diagonal) / (groups * numbers * (numbers - 1)) as f64
}
