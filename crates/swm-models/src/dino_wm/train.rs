//! [`Trainable`] for DINO-WM, which connects [`super::step`] to the training loop.

use super::config::{ACTION, DinoWmConfig};
use super::model::DinoWm;
use super::step::{DinoWmStep, TrainBatch, step};
use crate::checks;
use crate::nn::{BackboneConfig, Init, Named};
use crate::pixels::{self, Frames, ImageNormalization};
use crate::train::{DatasetInfo, FixedPart, Preset, StepContext, StepOutput, TrainConfig, Trainable, shards};
use crate::weights;
use burn::tensor::{Device, Tensor, TensorData};
use serde::{Deserialize, Serialize};
use std::path::Path;
use swm_core::columns::PIXELS;
use swm_core::{Batch, Error, Result, Schema};
use swm_data::{ClipSpec, LoaderConfig};

/// The loss settings of a DINO-WM, an empty table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DinoWmLoss {}

impl Trainable for DinoWm {
    const FAMILY: &'static str = "dino_wm";
    const SUMMARY: &'static str = "DINO-WM: predicts the patches of the next frame in the features of a frozen encoder";
    const PRESETS: &'static [Preset] = &[
        Preset {
            id: "tiny",
            summary: "64 px, a small encoder with random weights: for first trials on two CPU cores",
            toml: include_str!("../../presets/dino_wm/tiny.toml"),
        },
        Preset {
            id: "colours",
            summary: "64 px, the encoder of colours of another model, given with model.weights: minutes on two CPU cores",
            toml: include_str!("../../presets/dino_wm/colours.toml"),
        },
        Preset {
            id: "paper",
            summary: "224 px, DINOv2-small, predictor of 6 layers: the published size, for a GPU",
            toml: include_str!("../../presets/dino_wm/paper.toml"),
        },
    ];
    type Config = DinoWmConfig;
    type Loss = DinoWmLoss;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        config.model.check()?;
        checks::clip_covers_history(config.data.num_steps, config.model.predictor.history)
    }

    fn image_size(config: &DinoWmConfig) -> Option<usize> {
        Some(config.image)
    }

    fn encoder_config(config: &mut DinoWmConfig) -> Option<(&mut BackboneConfig, ImageNormalization)> {
        let images = config.pixels();
        Some((&mut config.encoder, images))
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        pixels::check(config.model.image, schema, PIXELS)?;
        let mut columns = vec![PIXELS.to_owned()];
        for column in &config.model.columns {
            let spec = schema.column(&column.name)?;
            if spec.is_image() {
                return Err(Error::mismatch(
                    format!("reading the column '{}' of model.columns", column.name),
                    "images",
                    "a column of numeric values (remove the column from model.columns)",
                ));
            }
            columns.push(column.name.clone());
        }
        let clip = ClipSpec { num_steps: config.data.num_steps, frameskip: config.data.frameskip, columns };
        Ok(LoaderConfig { clip, ..LoaderConfig::default() })
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        let widths: Result<Vec<usize>> = config
            .model
            .columns
            .iter()
            .map(|column| match column.name.as_str() {
                ACTION => Ok(config.data.frameskip * dataset_info.action.dim()),
                name => Ok(dataset_info.column(name)?.dim()),
            })
            .collect();
        Ok(Self::init(&config.model, &widths?, init))
    }

    fn with_pretrained_weights(mut self, config: &TrainConfig<Self>, cache: &Path) -> Result<Self> {
        let model = &config.model;
        if model.weights.is_empty() && matches!(model.encoder, BackboneConfig::Keypoints(_)) {
            let fix = "give the weights.safetensors of a checkpoint whose encoder locates the same colours";
            return Err(Error::config("model.weights", "is empty, and this encoder is not trained here", fix));
        }
        let inputs = (&model.encoder, &model.pixels());
        self.backbone = weights::encoder::fill(self.backbone, inputs, &model.weights, cache)?;
        Ok(self)
    }

    fn fixed_part(&self, config: &DinoWmConfig) -> Option<FixedPart> {
        Some(FixedPart { kernels: self.backbone.fixed_part(config.image)?, images: config.pixels() })
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let StepContext { config, dataset_info, key, device, training } = context;
        let (model, data) = (&config.model, &config.data);
        let frames = Frames::of(&model.pixels(), batch, PIXELS)?;
        let columns: Result<Vec<Tensor<3>>> = model
            .columns
            .iter()
            .map(|column| match column.name.as_str() {
                ACTION => dataset_info.actions(batch, data.num_steps, data.frameskip, device),
                name => normalised(dataset_info, name, &batch.to_f32(name)?, [batch.rows(), data.num_steps], device),
            })
            .collect();
        let columns = columns?;
        shards::mean(batch.rows(), config.shards, |range| {
            let frames = frames.range(range.start * data.num_steps..range.end * data.num_steps);
            let clips = TrainBatch {
                patches: frames.inputs(&model.pixels(), model.encoder.patch(), device)?,
                columns: columns
                    .iter()
                    .map(|column| {
                        let [_, steps, features] = column.dims();
                        column.clone().slice([range.clone(), 0..steps, 0..features])
                    })
                    .collect(),
            };
            let mut noise = key.with("dropout").at(range.start as u64).rng();
            let DinoWmStep { losses, gradients } = step(self, &clips, training.then_some(&mut noise));
            Ok(StepOutput { metrics: losses, gradients, buffers: Named::new() })
        })
    }
}

/// Standardises a column; missing values (NaN) become 0, the mean.
///
/// # Shapes
/// Returns `[clips, steps, features]`.
///
/// # Errors
/// When the model was trained without the column.
pub(super) fn normalised(
    dataset_info: &DatasetInfo,
    name: &str,
    values: &[f32],
    [clips, steps]: [usize; 2],
    device: &Device,
) -> Result<Tensor<3>> {
    let column = dataset_info.column(name)?;
    let (mean, std) = (&column.mean, column.spread());
    let scaled = |(index, value): (usize, &f32)| {
        let index = index % mean.len();
        let scaled = ((f64::from(*value) - mean[index]) / std[index]) as f32;
        if scaled.is_nan() { 0.0 } else { scaled }
    };
    let scaled: Vec<f32> = values.iter().enumerate().map(scaled).collect();
    Ok(Tensor::from_data(TensorData::new(scaled, [clips, steps, column.dim()]), device))
}
