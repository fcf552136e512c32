//! [`ModelFamily`] for LeWM.

use super::predictor::LewmPredictor;
use super::{Lewm, LewmConfig, LewmCost, import, pixels};
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily};
use crate::nn::parameters::host;
use crate::probe::ImageEncoder;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::Naming;
use std::path::Path;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::{CostModel, Predictor, Result};

/// The registry row of LeWM.
pub const ENTRY: FamilyEntry = FamilyEntry::of::<Lewm>();

impl ModelFamily for Lewm {
    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "LeWM",
            observations: RequiredObservations::Images,
            reward: false,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(LewmCost::new(checkpoint)))
    }

    fn predictor(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        let scale = checkpoint.dataset_info.action.clone();
        let (config, frameskip) = (&checkpoint.config.model, checkpoint.config.data.frameskip);
        Some(Box::new(LewmPredictor::new(&checkpoint.model, config, scale, frameskip)))
    }

    fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(checkpoint.clone()))
    }

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(import::import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(import::export(checkpoint, folder, Naming::default()))
    }
}

impl ImageEncoder for Checkpoint<Lewm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.latent
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        encode(&self.model, &self.config.model, rgb)
    }
}

/// Returns the latents of images.
///
/// # Shapes
/// `rgb` is `[frames, image, image, 3]`; returns `[frames, latent]`.
///
/// # Errors
/// When the bytes are not a whole number of images.
pub(crate) fn encode(model: &Lewm, config: &LewmConfig, rgb: &[u8]) -> Result<Vec<f32>> {
    Ok(host(model.encode(pixels::patches(config, rgb, &model.device())?)))
}
