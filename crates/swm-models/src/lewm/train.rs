//! [`Trainable`] for LeWM, which connects [`super::step`] to the training loop.

use super::step::{self, LewmStep, SigregConfig, TrainBatch};
use super::{Lewm, LewmConfig, loss, pixels};
use crate::checks;
use crate::nn::{BackboneConfig, Init, Named};
use crate::pixels::{Frames, ImageNormalization};
use crate::train::{
    DataConfig, DatasetInfo, FixedPart, Preset, StepContext, StepOutput, TrainConfig, Trainable, check_sizes, limits,
};
use burn::tensor::{Device, Tensor};
use swm_core::columns::{ACTION, PIXELS};
use swm_core::{Batch, Error, Result, Schema};
use swm_data::{ClipSpec, LoaderConfig};

impl Trainable for Lewm {
    const FAMILY: &'static str = "lewm";
    const SUMMARY: &'static str = "LeWorldModel: encoder and predictor trained end to end, regularised by SIGReg";
    const PRESETS: &'static [Preset] = &[
        Preset {
            id: "tiny",
            summary: "64 px, a small convolutional encoder: trains in half a minute on two CPU cores",
            toml: include_str!("../../presets/lewm/tiny.toml"),
        },
        Preset {
            id: "small",
            summary: "64 px, overlapping convolutions, for small and rotated objects: trains in about an hour on two CPU cores",
            toml: include_str!("../../presets/lewm/small.toml"),
        },
        Preset {
            id: "keypoints",
            summary: "64 px, keypoints of fixed random filters, encoded once per frame: trains in minutes on two CPU cores",
            toml: include_str!("../../presets/lewm/keypoints.toml"),
        },
        Preset {
            id: "colours",
            summary: "64 px, moments of six colours of the frames, for scenes of flat colours, encoded once per frame: minutes on two CPU cores",
            toml: include_str!("../../presets/lewm/colours.toml"),
        },
        Preset {
            id: "paper",
            summary: "224 px, ViT-tiny/14, predictor of 6 layers: the published size, for a GPU",
            toml: include_str!("../../presets/lewm/paper.toml"),
        },
    ];
    type Config = LewmConfig;
    type Loss = SigregConfig;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        check(&config.model, &config.data)?;
        check_straightening(config.loss.temp_straight, &config.data)?;
        checks::loss_weights(&[("loss.weight", config.loss.weight)])?;
        check_sizes(&[
            ("loss.directions", config.loss.directions, 1, limits::FEATURES),
            ("loss.knots", config.loss.knots, 2, limits::FEATURES),
        ])
    }

    fn image_size(config: &LewmConfig) -> Option<usize> {
        Some(config.image)
    }

    fn encoder_config(config: &mut LewmConfig) -> Option<(&mut BackboneConfig, ImageNormalization)> {
        let images = pixels::normalization(config);
        Some((&mut config.encoder, images))
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        loader_config(&config.model, &config.data, schema)
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        Ok(Self::init(&config.model, config.data.frameskip * dataset_info.action.dim(), init))
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let StepContext { config, dataset_info, key, device, training } = context;
        let directions = loss::directions(key.with("sigreg"), config.model.latent, config.loss.directions);
        let batch = prepare(&config.model, &config.data, dataset_info, batch, device)?;
        let mut noise = key.with("dropout").rng();
        let noise = training.then_some(&mut noise);
        let LewmStep { losses, gradients, buffers, .. } =
            step::step(self, &batch, &config.loss, &directions, config.shards, noise);
        let mut metrics = vec![("loss", losses.total), ("prediction", losses.prediction), ("sigreg", losses.sigreg)];
        metrics.extend(losses.temp_straight.map(|straight| ("temp_straight", straight)));
        metrics.extend(losses.features.map(|features| ("features", features)));
        Ok(StepOutput { metrics, gradients, buffers })
    }

    fn fixed_part(&self, config: &LewmConfig) -> Option<FixedPart> {
        fixed_part(self, config)
    }

    fn after_step(mut self, _: &StepContext<'_, Self>, buffers: Named<Tensor<1>>) -> Self {
        self.track(buffers);
        self
    }
}

/// Checks the model configuration, and that the clips cover the predictor's history.
pub(crate) fn check(model: &LewmConfig, data: &DataConfig) -> Result<()> {
    model.check()?;
    checks::clip_covers_history(data.num_steps, model.predictor.history)
}

/// Checks that clips have two differences of latents, if straight paths have a weight.
pub(crate) fn check_straightening(weight: f32, data: &DataConfig) -> Result<()> {
    checks::loss_weights(&[("loss.temp_straight", weight)])?;
    if weight == 0.0 || data.num_steps > 2 {
        return Ok(());
    }
    Err(Error::config(
        "loss.temp_straight",
        format!("weight {weight}, and clips of {} frames; two consecutive latent differences need 3", data.num_steps),
        "give data.num_steps of at least 3, or the weight 0",
    ))
}

/// Returns the part of the encoder that is not trained.
pub(crate) fn fixed_part(model: &Lewm, config: &LewmConfig) -> Option<FixedPart> {
    Some(FixedPart { kernels: model.encoder.fixed_part(config.image)?, images: pixels::normalization(config) })
}

/// Returns the loader configuration for clips of images and actions.
pub(crate) fn loader_config(model: &LewmConfig, data: &DataConfig, schema: &Schema) -> Result<LoaderConfig> {
    pixels::check(model, schema, PIXELS)?;
    let columns = vec![PIXELS.to_owned(), ACTION.to_owned()];
    let clip = ClipSpec { num_steps: data.num_steps, frameskip: data.frameskip, columns };
    Ok(LoaderConfig { clip, ..LoaderConfig::default() })
}

/// Normalises a batch of clips.
pub(crate) fn prepare(
    model: &LewmConfig,
    data: &DataConfig,
    dataset_info: &DatasetInfo,
    batch: &Batch,
    device: &Device,
) -> Result<TrainBatch> {
    let images = pixels::normalization(model);
    Ok(TrainBatch {
        patches: Frames::of(&images, batch, PIXELS)?.inputs(&images, model.encoder.patch(), device)?,
        actions: dataset_info.actions(batch, data.num_steps, data.frameskip, device)?,
    })
}
