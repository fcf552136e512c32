//! [`ModelFamily`] for DINO-WM.

use super::{DinoWm, DinoWmCost, import};
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily};
use crate::nn::parameters::host;
use crate::probe::ImageEncoder;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::Naming;
use std::path::Path;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::{CostModel, Result};

/// The registry row of DINO-WM.
pub const ENTRY: FamilyEntry = FamilyEntry::of::<DinoWm>();

impl ModelFamily for DinoWm {
    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "DINO-WM",
            observations: RequiredObservations::Images,
            reward: false,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(DinoWmCost::new(checkpoint)))
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

impl ImageEncoder for Checkpoint<DinoWm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.patches() * self.config.model.encoder.patch_dim()
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        Ok(host(self.model.backbone.patches(self.config.model.image_patches(rgb, &self.model.device())?)))
    }
}
