//! [`Trainable`] for PLDM, which connects [`super::step`] to the training loop.

use super::loss::PldmLoss;
use super::model::Pldm;
use super::step::{PldmStep, step};
use crate::checks;
use crate::lewm::{LewmConfig, pixels, train as lewm};
use crate::nn::{BackboneConfig, Init, Named};
use crate::pixels::ImageNormalization;
use crate::train::{
    DatasetInfo, FixedPart, Preset, StepContext, StepOutput, TrainConfig, Trainable, check_sizes, limits,
};
use burn::tensor::Tensor;
use swm_core::{Batch, Result, Schema};
use swm_data::LoaderConfig;

impl Trainable for Pldm {
    const FAMILY: &'static str = "pldm";
    const SUMMARY: &'static str =
        "PLDM: the networks of a LeWM, regularised by variance, covariance, temporal alignment and inverse dynamics";
    const PRESETS: &'static [Preset] = &[
        Preset {
            id: "tiny",
            summary: "64 px, a small convolutional encoder: trains in a minute on two CPU cores",
            toml: include_str!("../../presets/pldm/tiny.toml"),
        },
        Preset {
            id: "small",
            summary: "64 px, overlapping convolutions, for small and rotated objects: trains in about an hour on two CPU cores",
            toml: include_str!("../../presets/pldm/small.toml"),
        },
        Preset {
            id: "keypoints",
            summary: "64 px, keypoints of fixed random filters, encoded once per frame: trains in minutes on two CPU cores",
            toml: include_str!("../../presets/pldm/keypoints.toml"),
        },
        Preset {
            id: "colours",
            summary: "64 px, moments of six colours of the frames, for scenes of flat colours, encoded once per frame: minutes on two CPU cores",
            toml: include_str!("../../presets/pldm/colours.toml"),
        },
        Preset {
            id: "paper",
            summary: "224 px, ViT-tiny/14, predictor of 6 layers: the published size, for a GPU",
            toml: include_str!("../../presets/pldm/paper.toml"),
        },
    ];
    type Config = LewmConfig;
    type Loss = PldmLoss;

    fn check(config: &TrainConfig<Self>) -> Result<()> {
        lewm::check(&config.model, &config.data)?;
        check_sizes(&[
            ("model.latent", config.model.latent, 2, limits::FEATURES),
            ("loss.idm_hidden", config.loss.idm_hidden, 1, limits::FEATURES),
        ])?;
        let PldmLoss { std, std_t, cov, cov_t, temp_align, idm, .. } = config.loss;
        checks::loss_weights(&[
            ("loss.std", std),
            ("loss.std_t", std_t),
            ("loss.cov", cov),
            ("loss.cov_t", cov_t),
            ("loss.temp_align", temp_align),
            ("loss.idm", idm),
        ])?;
        lewm::check_straightening(config.loss.temp_straight, &config.data)
    }

    fn image_size(config: &LewmConfig) -> Option<usize> {
        Some(config.image)
    }

    fn encoder_config(config: &mut LewmConfig) -> Option<(&mut BackboneConfig, ImageNormalization)> {
        let images = pixels::normalization(config);
        Some((&mut config.encoder, images))
    }

    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig> {
        lewm::loader_config(&config.model, &config.data, schema)
    }

    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self> {
        let action_dim = config.data.frameskip * dataset_info.action.dim();
        Ok(Self::init(&config.model, action_dim, config.loss.idm_hidden, init))
    }

    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput> {
        let StepContext { config, dataset_info, key, device, training } = context;
        let batch = lewm::prepare(&config.model, &config.data, dataset_info, batch, device)?;
        let mut noise = key.with("dropout").rng();
        let noise = training.then_some(&mut noise);
        let PldmStep { losses, gradients, buffers, .. } = step(self, &batch, &config.loss, config.shards, noise);
        Ok(StepOutput { metrics: losses, gradients, buffers })
    }

    fn fixed_part(&self, config: &LewmConfig) -> Option<FixedPart> {
        lewm::fixed_part(&self.model, config)
    }

    fn after_step(mut self, _: &StepContext<'_, Self>, buffers: Named<Tensor<1>>) -> Self {
        self.model.track(buffers);
        self
    }
}
