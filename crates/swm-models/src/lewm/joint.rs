//! The training step of joint-embedding models (LeWM, PLDM), with the regulariser as a parameter.
//!
//! The encoder processes a fixed number of shards of the batch in parallel; the other modules process the whole batch.
//! The configuration sets the number of shards, and gradients are summed in the order of the shards, so the result does
//! not depend on the number of threads.

use super::model::Lewm;
use super::shard::{Differentiation, Shard};
use super::step::TrainBatch;
use crate::nn::parameters::{self, Named};
use crate::nn::{BatchStatistics, DropoutRng};
use burn::module::Module;
use burn::tensor::{Gradients, Tensor};
use rayon::prelude::*;
use swm_core::Rng;

/// Prediction error and gradients of a batch.
pub(crate) struct JointStep {
    /// Mean squared error of the predicted latents.
    pub prediction: f64,
    /// The flattened gradient of each parameter of the model, by parameter name.
    pub gradients: Named<Tensor<1>>,
    /// All gradients, including the gradients of the regulariser's own parameters.
    pub all: Gradients,
    /// Batch statistics of the projectors after the encoder and after the predictor.
    pub statistics: [BatchStatistics; 2],
}

/// Returns every window of `history` steps that another step follows, shifted by `offset` steps: one window per clip
/// if clips are one step longer than the history, as published.
///
/// # Shapes
/// `x` is `[clips, steps, width]`; returns `[(steps - history) * clips, history, width]`.
fn windows(x: &Tensor<3>, history: usize, offset: usize) -> Tensor<3> {
    let [clips, steps, width] = x.dims();
    let starts = 0..steps - history;
    Tensor::cat(starts.map(|s| x.clone().slice([0..clips, s + offset..s + offset + history, 0..width])).collect(), 0)
}

/// Computes prediction error and gradients of a batch. The loss is the prediction error plus `regularise(latents)`,
/// where the latents are `[clips, steps, latent]`. `model` is outside autodiff; `shards` is at least 1.
pub(crate) fn step(
    model: &Lewm,
    batch: &TrainBatch,
    shards: usize,
    noise: Option<&mut Rng>,
    regularise: impl FnOnce(&Tensor<3>) -> Tensor<1>,
) -> JointStep {
    let [clips, steps, _] = batch.actions.dims();
    let frames = clips * steps;

    let size = frames.div_ceil(shards.max(1));
    let ranges: Vec<_> = (0..frames).step_by(size).map(|start| start..(start + size).min(frames)).collect();
    let [_, count, elements] = batch.patches.dims();
    let differentiation = Differentiation::of(&model.encoder, count, &model.device());
    let encoded: Vec<Shard> = ranges
        .par_iter()
        .map(|range| {
            let patches = batch.patches.clone().slice([range.clone(), 0..count, 0..elements]);
            Shard::forward(&differentiation, patches)
        })
        .collect();

    // The modules after the encoder process the whole batch.
    let head = model.clone().train();
    let features = Tensor::cat(encoded.iter().map(|shard| shard.features.clone()).collect(), 0);
    let features = features.autodiff().require_grad();
    let (latents, projector_statistics) = head.projector.forward_train(features.clone());
    let [_, latent] = latents.dims();
    let latents = latents.reshape([clips, steps, latent]);
    let regulariser = regularise(&latents);
    let history = head.predictor.config().history.min(steps - 1);
    let conditions = head.embed_actions(windows(&batch.actions, history, 0).autodiff());
    let (predicted, pred_proj_statistics) =
        head.predict_train(windows(&latents, history, 0), conditions, &mut DropoutRng(noise));
    let prediction = (predicted - windows(&latents, history, 1)).square().mean();
    let prediction_value: f32 = prediction.clone().inner().into_scalar();

    let mut all = (prediction + regulariser).backward();
    let features_gradient = features.grad_remove(&mut all);
    let mut gradients = parameters::gradients(&head, &all);

    if let Some(features_gradient) = features_gradient {
        let [_, width] = features_gradient.dims();
        let shards: Vec<Named<Tensor<1>>> = encoded
            .into_par_iter()
            .zip(&ranges)
            .map(|(shard, range)| {
                let gradient = features_gradient.clone().slice([range.clone(), 0..width]);
                shard.backward(&differentiation, gradient)
            })
            .collect();
        shards.into_iter().for_each(|shard| add_encoder_gradients(&mut gradients, shard));
    }
    JointStep {
        prediction: f64::from(prediction_value),
        gradients,
        all,
        statistics: [projector_statistics, pred_proj_statistics],
    }
}

/// Adds the gradients of the encoder on one shard to the sums over the earlier shards.
fn add_encoder_gradients(sums: &mut Named<Tensor<1>>, shard: Named<Tensor<1>>) {
    for (name, gradient) in shard {
        let name = format!("encoder.{name}");
        let sum = match sums.remove(&name) {
            Some(sum) => sum + gradient,
            None => gradient,
        };
        sums.insert(name, sum);
    }
}
