//! The training step of joint-embedding models (LeWM, PLDM), with the regulariser as a parameter.
//!
//! The encoder and the predictor process a fixed number of shards of the batch in parallel; the projectors process the
//! whole batch. The configuration sets the number of shards, and gradients are summed in the order of the shards, so the result does
//! not depend on the number of threads.

use super::model::Lewm;
use super::prediction::{self, Windows};
use super::shard::{Differentiation, Shard};
use super::step::TrainBatch;
use crate::nn::parameters::{self, Named};
use crate::nn::{Backbone, BatchNorm, BatchStatistics};
use burn::module::Module;
use burn::tensor::{Gradients, Tensor};
use rayon::prelude::*;
use swm_core::Rng;

/// Prediction error and gradients of a batch.
pub(crate) struct JointStep {
    /// Mean squared error of the predicted latents.
    pub prediction: f64,
    /// Mean squared error of the decoded features, and its weight in the loss, if the model has a decoder.
    pub decoding: Option<(f64, f64)>,
    /// The flattened gradient of each parameter of the model, by parameter name.
    pub gradients: Named<Tensor<1>>,
    /// All gradients, including the gradients of the regulariser's own parameters.
    pub all: Gradients,
    /// The batch statistics of the encoder and the projectors, for [`Lewm::track`].
    pub buffers: Named<Tensor<1>>,
}

/// The modules with running batch statistics, by their names in a model.
const ENCODER: &str = "encoder";
const PROJECTOR: &str = "projector";
const PRED_PROJ: &str = "pred_proj";

impl Lewm {
    /// Updates the running statistics with the batch statistics of a step.
    pub(crate) fn track(&mut self, mut buffers: Named<Tensor<1>>) {
        self.encoder.track(ENCODER, &mut buffers);
        for (name, projector) in [(PROJECTOR, &mut self.projector), (PRED_PROJ, &mut self.pred_proj)] {
            if let Some(statistics) = BatchStatistics::take(name, &mut buffers) {
                projector.track(statistics);
            }
        }
    }
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

/// Returns the mean squared error of the features that the decoder computes from the first latent of each clip, with the weight
/// of the error, if the model has a decoder. The features are normalised with the statistics of the batch.
fn decoding_error(model: &Lewm, patches: &Tensor<3>, latents: &Tensor<3>) -> Option<(Tensor<1>, f64)> {
    let (Some(decoder), Backbone::Keypoints(keypoints)) = (&model.decoder, &model.encoder) else { return None };
    let ([clips, steps, latent], [_, rows, width]) = (latents.dims(), patches.dims());
    let first = patches.clone().reshape([clips, steps, rows * width]).slice([0..clips, 0..1, 0..rows * width]);
    let features = keypoints.inputs(first.reshape([clips, rows, width]));
    let centred = features.clone() - features.mean_dim(0);
    let variance = centred.clone().square().mean_dim(0);
    let target = centred / (variance + BatchNorm::EPSILON).sqrt();
    let latents = latents.clone().slice([0..clips, 0..1, 0..latent]).reshape([clips, latent]);
    Some(((decoder.net.forward(latents) - target.autodiff()).square().mean(), decoder.weight()))
}

/// Computes prediction error and gradients of a batch. The loss is the prediction error plus `regularise(latents)`
/// and the weighted error of the decoder, where the latents are `[clips, steps, latent]`. `model` is outside autodiff; `shards` is at least 1.
pub(crate) fn step(
    model: &Lewm,
    batch: &TrainBatch,
    shards: usize,
    noise: Option<&mut Rng>,
    regularise: impl FnOnce(&Tensor<3>) -> Tensor<1>,
) -> JointStep {
    let [clips, steps, _] = batch.actions.dims();
    let frames = clips * steps;

    let [_, count, elements] = batch.patches.dims();
    let differentiation = Differentiation::of(&model.encoder, count, &model.device());
    let size = if differentiation.needs_whole_batch() { frames } else { frames.div_ceil(shards.max(1)) };
    let ranges: Vec<_> = (0..frames).step_by(size).map(|start| start..(start + size).min(frames)).collect();
    let mut encoded: Vec<Shard> = ranges
        .par_iter()
        .map(|range| {
            let patches = batch.patches.clone().slice([range.clone(), 0..count, 0..elements]);
            Shard::forward(&differentiation, patches)
        })
        .collect();

    let mut buffers = Named::new();
    let statistics = encoded.iter_mut().flat_map(|shard| shard.statistics.drain(..)).collect();
    model.encoder.store(statistics, ENCODER, &mut buffers);
    // The projector processes the whole batch.
    let head = model.clone().train();
    let features = Tensor::cat(encoded.iter().map(|shard| shard.features.clone()).collect(), 0);
    let features = features.autodiff().require_grad();
    let (latents, projector_statistics) = head.projector.forward_train(features.clone());
    let [_, latent] = latents.dims();
    let latents = latents.reshape([clips, steps, latent]);
    let mut regulariser = regularise(&latents);
    let mut decoding = None;
    if let Some((error, weight)) = decoding_error(&head, &batch.patches, &latents) {
        decoding = Some((f64::from(error.clone().inner().into_scalar::<f32>()), weight));
        regulariser = regulariser + error * weight;
    }
    let (history, values) = (head.predictor.config().history.min(steps - 1), latents.clone().inner());
    let inputs = Windows {
        latents: windows(&values, history, 0),
        actions: windows(&batch.actions, history, 0),
        targets: windows(&values, history, 1),
    };
    let prediction = prediction::predict(model, &inputs, shards, noise);
    projector_statistics.store(PROJECTOR, &mut buffers);
    prediction.statistics.store(PRED_PROJ, &mut buffers);

    // Autodiff receives linear functions of the latents whose gradients equal those of the prediction error.
    let linear = |x: Tensor<3>, gradient: Tensor<3>| (x * gradient.autodiff()).sum();
    let error = linear(windows(&latents, history, 0), prediction.latents)
        + linear(windows(&latents, history, 1), prediction.targets);
    let mut all = (error + regulariser).backward();
    let features_gradient = features.grad_remove(&mut all);
    let mut gradients = prediction.gradients;
    parameters::add(&mut gradients, parameters::gradients(&head, &all));

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
        let shards = shards.into_iter().map(|shard| parameters::prefixed(ENCODER, shard));
        parameters::add_all(&mut gradients, shards.collect());
    }
    JointStep { prediction: prediction.error, decoding, gradients, all, buffers }
}
