//! One training step of a LeWM (Maes et al. 2026, LeWorldModel): the loss, prediction error plus SIGReg, and the
//! gradients of the loss.

use super::joint::{self, JointStep};
use super::loss;
use super::model::Lewm;
use crate::nn::parameters::{IntoF32, Named};
use burn::tensor::{Tensor, TensorData};
use serde::{Deserialize, Serialize};
use swm_core::Rng;

/// The settings of the loss: SIGReg, and optionally straight paths of latents.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SigregConfig {
    /// The weight of SIGReg in the loss, λ.
    pub weight: f32,
    /// The number of random directions per training step.
    pub directions: usize,
    /// The number of points at which characteristic functions are compared.
    pub knots: usize,
    /// Weight of straight paths; 0 leaves the term out.
    #[serde(default)]
    pub temp_straight: f32,
}

/// A batch of normalised clips.
pub struct TrainBatch {
    /// The pixels of image patches, `[clips * steps, patches, 3 * patch * patch]`.
    pub patches: Tensor<3>,
    /// The actions, `[clips, steps, action_dim]`; the actions of the last step are not used.
    pub actions: Tensor<3>,
}

/// The loss of a batch and the terms of the loss.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// The weighted sum of the other losses; the weight of the prediction error is 1.
    pub total: f64,
    /// Mean squared error of the predicted latents.
    pub prediction: f64,
    /// The SIGReg statistic.
    pub sigreg: f64,
    /// The straightening loss, if it has a weight.
    pub temp_straight: Option<f64>,
    /// Mean squared error of the decoded features, if the model has a decoder.
    pub features: Option<f64>,
}

/// Losses and gradients of a batch.
pub struct LewmStep {
    /// The losses.
    pub losses: Losses,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
    /// The batch statistics, which update the model's running statistics.
    pub buffers: Named<Tensor<1>>,
    /// The latents, `[clips, steps, latent]`.
    pub latents: Vec<f32>,
}

/// Computes loss and gradients of a batch. `model` is outside autodiff; `shards` is at least 1.
///
/// # Shapes
/// `directions` is `[count, latent]`.
pub fn step(
    model: &Lewm,
    batch: &TrainBatch,
    config: &SigregConfig,
    directions: &[f32],
    shards: usize,
    noise: Option<&mut Rng>,
) -> LewmStep {
    let (mut host, mut sigreg, mut temp_straight) = (vec![], 0.0, None);
    let step = joint::step(model, batch, shards, noise, |latents| {
        let shape = latents.dims();
        host = latents.clone().inner().into_data().into_f32_vec();
        let (value, gradient) = loss::sigreg(&host, shape[1], shape[2], directions, config.knots);
        sigreg = value;
        let gradient = Tensor::<3>::from_data(TensorData::new(gradient, shape), &latents.device()).autodiff();
        // Autodiff receives a linear function of the latents whose gradient equals the gradient of the statistic.
        let mut regulariser = (latents.clone() * gradient).sum() * config.weight;
        if config.temp_straight != 0.0 {
            let [clips, steps, dim] = latents.dims();
            let part = |from: usize, to: usize| latents.clone().slice([0..clips, from..to, 0..dim]);
            let straight = loss::straightening(part(1, steps) - part(0, steps - 1));
            temp_straight = Some(f64::from(straight.clone().inner().into_scalar::<f32>()));
            regulariser = regulariser + straight * config.temp_straight;
        }
        regulariser
    });
    let JointStep { prediction, decoding, gradients, buffers, .. } = step;
    let (features, weight) = decoding.unzip();
    let straight = f64::from(config.temp_straight) * temp_straight.unwrap_or_default();
    let decoding = features.zip(weight).map_or(0.0, |(error, weight)| error * weight);
    let total = prediction + f64::from(config.weight) * sigreg + straight + decoding;
    LewmStep {
        losses: Losses { total, prediction, sigreg, temp_straight, features },
        gradients,
        buffers,
        latents: host,
    }
}
