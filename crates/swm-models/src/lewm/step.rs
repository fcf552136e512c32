//! One training step: loss and gradients of a batch.
//!
//! The encoder works on a fixed number of shards of the batch, in parallel; what follows it sees the whole batch.
//! The split is part of the configuration, never of the machine, and gradients are summed in the order of the
//! shards, so the numbers do not depend on the number of threads.

use super::loss;
use super::model::{Encoder, Lewm};
use crate::nn::parameters::{self, IntoF32, Named};
use crate::nn::{BatchStatistics, Noise};
use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::Rng;

/// The weight and the settings of SIGReg.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SigregConfig {
    /// Its weight in the loss.
    pub weight: f32,
    /// Random directions a step.
    pub directions: usize,
    /// Where characteristic functions are compared.
    pub knots: usize,
}

/// One batch, normalised.
pub struct TrainBatch {
    /// `[clips * steps, patches, numbers]`.
    pub patches: Tensor<3>,
    /// `[clips, steps, actions]`; the actions of the last step are not used.
    pub actions: Tensor<3>,
}

/// The losses of a batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Losses {
    /// `prediction + weight * sigreg`.
    pub total: f64,
    /// Mean squared error of the predicted latents.
    pub prediction: f64,
    /// The SIGReg statistic.
    pub sigreg: f64,
}

/// What a step found.
pub struct StepOutput {
    /// The losses.
    pub losses: Losses,
    /// Gradients by parameter, flat.
    pub gradients: Named<Tensor<1>>,
    /// Batch statistics of the projections behind the encoder and the predictor.
    pub statistics: [BatchStatistics; 2],
    /// The latents, `[clips, steps, latent]`.
    pub latents: Vec<f32>,
}

/// Loss and gradients of a batch.
///
/// `model` is without autodiff; `directions` are `[count, latent]`; `shards` is at least 1.
pub fn step(
    model: &Lewm,
    batch: &TrainBatch,
    config: &SigregConfig,
    directions: &[f32],
    shards: usize,
    noise: Option<&mut Rng>,
) -> StepOutput {
    let [clips, steps, _] = batch.actions.dims();
    let frames = clips * steps;

    // Every shard differentiates its own copy of the encoder: their graphs share nothing.
    let size = frames.div_ceil(shards.max(1));
    let ranges: Vec<_> = (0..frames).step_by(size).map(|start| start..(start + size).min(frames)).collect();
    let encoded: Vec<(Encoder, Tensor<2>)> = ranges
        .par_iter()
        .map(|range| {
            let encoder = model.encoder.clone().train();
            let [_, count, numbers] = batch.patches.dims();
            let patches = batch.patches.clone().slice([range.clone(), 0..count, 0..numbers]).autodiff();
            let features = encoder.forward(patches);
            (encoder, features)
        })
        .collect();

    // The rest of the model, from the features on.
    let head = model.clone().train();
    let features = Tensor::cat(encoded.iter().map(|(_, f)| f.clone().inner()).collect(), 0).autodiff().require_grad();
    let (latents, projector_statistics) = head.projector.forward_train(features.clone());
    let [_, latent] = latents.dims();
    let host = latents.clone().inner().into_data().try_into_vec_as_f32();
    let (sigreg, sigreg_gradient) = loss::sigreg(&host, steps, latent, directions, config.knots);
    let sigreg_gradient =
        Tensor::<2>::from_data(TensorData::new(sigreg_gradient, [frames, latent]), &latents.device()).autodiff();
    // A linear form whose gradient is that of the statistic.
    let pull = (latents.clone() * sigreg_gradient).sum() * config.weight;

    let latents = latents.reshape([clips, steps, latent]);
    // Every window of the history's length that has a next frame. One window where the clip is one longer than the
    // history, as published.
    let history = head.predictor.config().history.min(steps - 1);
    let windows = |x: &Tensor<3>, offset: usize| {
        let [_, _, width] = x.dims();
        let starts = 0..steps - history;
        Tensor::cat(
            starts.map(|s| x.clone().slice([0..clips, s + offset..s + offset + history, 0..width])).collect(),
            0,
        )
    };
    let conditions = head.embed_actions(windows(&batch.actions, 0).autodiff());
    let (predicted, pred_proj_statistics) = head.predict_train(windows(&latents, 0), conditions, &mut Noise(noise));
    let prediction = (predicted - windows(&latents, 1)).square().mean();
    let prediction_value: f32 = prediction.clone().inner().into_scalar();

    let mut all = (prediction + pull).backward();
    let features_gradient = features.grad_remove(&mut all);
    let mut gradients = parameters::gradients(&head, &all);

    if let Some(features_gradient) = features_gradient {
        let [_, width] = features_gradient.dims();
        let shards: Vec<Named<Tensor<1>>> = encoded
            .into_par_iter()
            .zip(&ranges)
            .map(|((encoder, features), range)| {
                let gradient = features_gradient.clone().slice([range.clone(), 0..width]).autodiff();
                let all = (features * gradient).sum().backward();
                parameters::gradients(&encoder, &all)
            })
            .collect();
        for shard in shards {
            for (name, gradient) in shard {
                let name = format!("encoder.{name}");
                let sum = match gradients.remove(&name) {
                    Some(sum) => sum + gradient,
                    None => gradient,
                };
                gradients.insert(name, sum);
            }
        }
    }
    let prediction = f64::from(prediction_value);
    StepOutput {
        losses: Losses { total: prediction + f64::from(config.weight) * sigreg, prediction, sigreg },
        gradients,
        statistics: [projector_statistics, pred_proj_statistics],
        latents: host,
    }
}
