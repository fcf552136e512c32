//! Regression of numeric columns on images with a fresh encoder, which is trained with the columns as labels. Its scores are
//! a ceiling: an encoder that does not read a column with labels cannot be expected to read it without.

use super::fit::{fit, rows};
use super::scale::Scale;
use super::state::{Score, StateConfig, scores};
use super::targets::Targets;
use super::{ImageEncoder, samples};
use crate::lewm::shard::{Differentiation, Shard};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Backbone, BackboneConfig, Init, Mlp, Named};
use crate::pixels::{self, ImageNormalization};
use crate::train::{StepOutput, colours};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use swm_core::run::Control;
use swm_core::{Key, Result};
use swm_data::{Part, Reader};

/// The scores of an encoder that was trained with labels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SupervisedReport {
    /// The side of the images, in pixels.
    pub image: usize,
    /// Frames that were fitted on.
    pub frames: usize,
    /// Frames that were scored on.
    pub held_out: usize,
    /// The mean squared error of the last training batch, in units of the labels' variances.
    pub loss: f64,
    /// The scores on held-out episodes, element by element.
    pub scores: Vec<Score>,
}

/// An encoder and the network of a state probe on its features.
#[derive(Module, Debug)]
struct Labelled {
    encoder: Backbone,
    head: Mlp,
}

const ENCODER: &str = "encoder";
const HEAD: &str = "head";
/// The number of images that are encoded together for the scores.
const BLOCK: usize = 64;

/// Trains an encoder, and the network of a state probe on its features, to predict columns; scores the predictions on
/// held-out episodes. The baseline and the ridge regression of `config` are not used. `control` receives the progress of the
/// training.
///
/// # Errors
/// When a column is missing or holds images, the images have another size, no episode is held out, a setting is out of
/// range, or `control` stops the training.
pub fn train_encoder(
    encoder: &BackboneConfig,
    images: &ImageNormalization,
    reader: &dyn Reader,
    config: &StateConfig,
    control: &mut Control<'_>,
) -> Result<SupervisedReport> {
    encoder.check("model.encoder", images.side)?;
    let mut encoder = encoder.clone();
    colours::find(&mut encoder, images, reader, true)?;
    // Batch normalisation needs two frames.
    config.check(2)?;
    let targets = Targets::new(reader, &config.columns, &config.angles)?;
    let key = Key::new(config.seed).with("supervised probe");
    let sample = |part, count| {
        let samples = (count, key.with("frames"));
        samples::sample(&ImagesOnly(images.side), reader, part, &config.columns, true, samples)
    };
    let train = sample(Part::Train, config.frames)?;
    let held_out = sample(Part::Validation, config.held_out)?;
    let values = |samples: &samples::Samples| targets.of(&samples.targets, targets.width, 0);
    let labels = values(&train);
    let scale = Scale::of(&labels, train.count);
    let labels = scale.apply(&labels);

    let init = Init::new(key.with("init"), &Device::flex());
    let model = Labelled {
        encoder: encoder.init(&init.of(ENCODER), images.side),
        head: Mlp::new(&init.of(HEAD), encoder.dim(), config.hidden, targets.list.len()),
    };
    let bytes = images.side * images.side * 3;
    let step = |model: &Labelled, indices: &[usize]| {
        let rgb: Vec<u8> = indices.iter().flat_map(|&index| &train.images[index * bytes..][..bytes]).copied().collect();
        let patches = pixels::patches(images, encoder.patch(), &rgb, &Device::flex())?;
        Ok(losses(model, patches, rows(&labels, targets.list.len(), indices)))
    };
    let track = |model: &mut Labelled, mut buffers| model.encoder.track(ENCODER, &mut buffers);
    let (model, loss) = fit(model, config.fit, train.count, key.with("batches"), step, track, control)?;

    let predictions: Result<Vec<Vec<f32>>> = held_out
        .images
        .par_chunks(BLOCK * bytes)
        .map(|rgb| {
            let patches = pixels::patches(images, encoder.patch(), rgb, &Device::flex())?;
            Ok(model.head.forward(model.encoder.forward(patches)).into_data().into_f32_vec())
        })
        .collect();
    let mut predictions = predictions?.concat();
    scale.undo(&mut predictions);
    Ok(SupervisedReport {
        image: images.side,
        frames: train.count,
        held_out: held_out.count,
        loss,
        scores: scores(&targets.list, &predictions, &values(&held_out)),
    })
}

/// Computes the mean squared error of a batch and its gradients.
fn losses(model: &Labelled, patches: Tensor<3>, labels: Tensor<2>) -> StepOutput {
    let ([_, count, _], device) = (patches.dims(), patches.device());
    let differentiation = Differentiation::of(&model.encoder, count, &device);
    let mut shard = Shard::forward(&differentiation, patches);
    let mut buffers = Named::new();
    model.encoder.store(std::mem::take(&mut shard.statistics), ENCODER, &mut buffers);

    let head = model.head.clone().train();
    let features = shard.features.clone().autodiff().require_grad();
    let loss = (head.forward(features.clone()) - labels.autodiff()).square().mean();
    let metrics = vec![("loss", f64::from(loss.clone().inner().into_scalar::<f32>()))];
    let mut all = loss.backward();
    let mut gradients = parameters::prefixed(HEAD, parameters::gradients(&head, &all));
    if let Some(gradient) = features.grad_remove(&mut all) {
        gradients.extend(parameters::prefixed(ENCODER, shard.backward(&differentiation, gradient)));
    }
    StepOutput { metrics, gradients, buffers }
}

/// An encoder without latents, for samples of images.
struct ImagesOnly(usize);

impl ImageEncoder for ImagesOnly {
    fn image_size(&self) -> usize {
        self.0
    }

    fn latent_dim(&self) -> usize {
        0
    }

    fn encode(&self, _rgb: &[u8]) -> Result<Vec<f32>> {
        Ok(vec![])
    }
}
