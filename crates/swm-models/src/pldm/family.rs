//! [`ModelFamily`] for PLDM, whose world model has the networks of a LeWM.

use super::{Pldm, import};
use crate::checkpoint::Checkpoint;
use crate::family::{FamilyEntry, ModelFamily};
use crate::lewm::{LewmCost, LewmPredictor, encode};
use crate::probe::ImageEncoder;
use crate::train::{DatasetInfo, TrainConfig};
use crate::weights::Naming;
use std::path::Path;
use swm_core::requirements::{DatasetRequirements, RequiredObservations};
use swm_core::{CostModel, Predictor, Result};

/// The registry row of PLDM.
pub const ENTRY: FamilyEntry = FamilyEntry::of::<Pldm>();

impl ModelFamily for Pldm {
    fn requirements(config: &TrainConfig<Self>) -> DatasetRequirements {
        DatasetRequirements {
            model: "PLDM",
            observations: RequiredObservations::Images,
            reward: false,
            clip_rows: config.data.num_steps * config.data.frameskip,
        }
    }

    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(cost(checkpoint)))
    }

    fn predictor(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        let scale = checkpoint.dataset_info.action.clone();
        let (config, frameskip) = (&checkpoint.config.model, checkpoint.config.data.frameskip);
        Some(Box::new(LewmPredictor::new(&checkpoint.model.model, config, scale, frameskip)))
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

/// Returns the planning cost of a trained PLDM.
pub fn cost(checkpoint: &Checkpoint<Pldm>) -> LewmCost {
    LewmCost::of(&checkpoint.model.model, &checkpoint.config.model, checkpoint.action_dim())
}

impl ImageEncoder for Checkpoint<Pldm> {
    fn image_size(&self) -> usize {
        self.config.model.image
    }

    fn latent_dim(&self) -> usize {
        self.config.model.latent
    }

    fn encode(&self, rgb: &[u8]) -> Result<Vec<f32>> {
        encode(&self.model.model, &self.config.model, rgb)
    }
}
