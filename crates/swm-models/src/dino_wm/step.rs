//! One training step of a DINO-WM (Zhou et al. 2024, section 3): the prediction error of patches and the gradients of
//! the error.
//!
//! The loss is a mean over clips, so a batch can be split and the ranges of clips computed in parallel.

use super::config::ACTION;
use super::model::DinoWm;
use crate::nn::DropoutRng;
use crate::nn::parameters::{self, Named};
use burn::module::Module;
use burn::tensor::Tensor;
use swm_core::Rng;
use swm_core::columns::PIXELS;

/// A batch of normalised clips.
pub struct TrainBatch {
    /// The pixels of image patches, `[clips * steps, patches, 3 * patch * patch]`.
    pub patches: Tensor<3>,
    /// The columns in the order of the configuration, `[clips, steps, features]` each.
    pub columns: Vec<Tensor<3>>,
}

/// Losses and gradients of a batch.
pub struct DinoWmStep {
    /// The total loss, then the terms of the loss, by name.
    pub losses: Vec<(&'static str, f64)>,
    /// The flattened gradient of each parameter, by parameter name.
    pub gradients: Named<Tensor<1>>,
}

/// Computes the loss and the gradients of clips of at least 2 frames. `model` is outside autodiff.
pub fn step(model: &DinoWm, batch: &TrainBatch, noise: Option<&mut Rng>) -> DinoWmStep {
    let [clips, steps] = batch.columns.first().map_or([1, 1], |column| [column.dims()[0], column.dims()[1]]);
    // The encoder is frozen: its features and all targets stay outside the autodiff graph.
    let features = model.backbone.patches(batch.patches.clone());
    let [_, patches, width] = features.dims();
    let frame_features = features.clone().reshape([clips, steps, patches, width]);
    let targets = model.embed(frame_features.clone(), &batch.columns);
    let [_, _, _, dim] = targets.dims();

    let learner = model.clone().train();
    let columns: Vec<Tensor<3>> = batch.columns.iter().map(|column| column.clone().autodiff()).collect();
    let frames = learner.embed(frame_features.autodiff(), &columns);
    // The windows are all runs of `history` frames that a frame follows.
    let history = model.predictor.config().history.min(steps - 1);
    let windows = |x: &Tensor<4>, offset: usize| {
        let part = |s: usize| x.clone().slice([0..clips, s + offset..s + offset + history, 0..patches, 0..dim]);
        Tensor::cat((0..steps - history).map(part).collect(), 0)
    };
    let predicted = learner.predict(windows(&frames, 0), &mut DropoutRng(noise));
    let error = (predicted - windows(&targets, 1).autodiff()).square();
    let [windows, _, _, _] = error.dims();
    let errors = |range: std::ops::Range<usize>| error.clone().slice([0..windows, 0..history, 0..patches, range]);
    // Actions are not prediction targets.
    let pixels = errors(0..width);
    let mut parts = vec![pixels.clone()];
    parts.extend(learner.columns().into_iter().filter(|(name, _)| *name != ACTION).map(|(_, span)| errors(span)));
    let column_error = (parts.len() > 1).then(|| Tensor::cat(parts[1..].to_vec(), 3).mean());
    let prediction = Tensor::cat(parts, 3).mean();

    let value = |loss: &Tensor<1>| f64::from(loss.clone().inner().into_scalar::<f32>());
    let mut losses = vec![("prediction", value(&prediction)), (PIXELS, value(&pixels.mean()))];
    losses.extend(column_error.as_ref().map(|error| ("columns", value(error))));
    let mut loss = prediction;
    if let Some(decoder) = &learner.decoder {
        let images = batch.patches.clone().autodiff();
        let reconstruction = (decoder.forward(features.autodiff()) - images).square().mean();
        losses.push(("reconstruction", value(&reconstruction)));
        loss = loss + reconstruction;
    }
    losses.insert(0, ("loss", value(&loss)));
    let gradients = parameters::gradients(&learner, &loss.backward());
    DinoWmStep { losses, gradients }
}
