//! [`LoadedModel`]: a checkpoint of any family.

use super::contract::ModelFamily;
use crate::checkpoint::Checkpoint;
use crate::probe::ImageEncoder;
use crate::train::DatasetInfo;
use serde_json::{Value, json};
use std::path::Path;
use swm_core::{CostModel, EnvSpec, Manifest, Policy, Predictor, Result};

/// A description of a checkpoint of any family.
pub struct CheckpointInfo {
    /// The id of the family.
    pub family: &'static str,
    /// The hash of the weights.
    pub weights: String,
    /// The training configuration as JSON.
    pub config: Value,
    /// The training configuration as TOML.
    pub toml: String,
    /// Statistics of the training data.
    pub dataset_info: DatasetInfo,
    /// The side of the model's square images in pixels; `None` for a state-only model.
    pub image_size: Option<usize>,
    /// Environment steps in a model step.
    pub action_block: usize,
    /// Frames that a prediction or decision reads.
    pub history: usize,
    /// The origin of the checkpoint.
    pub manifest: Manifest,
}

/// A checkpoint of any family. The methods correspond to those of [`ModelFamily`].
pub trait LoadedModel {
    /// Returns a description of the checkpoint.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    fn info(&self) -> Result<CheckpointInfo>;

    /// Returns the planning cost; `None` for a model that acts without planning.
    fn cost(&self) -> Option<Box<dyn CostModel>> {
        None
    }

    /// Returns whether the model acts without a solver.
    fn acts(&self) -> bool {
        false
    }

    /// Returns a policy that acts without a solver in `slots` environments; `None` for a model that only predicts.
    ///
    /// # Errors
    /// When the model was trained for another action space.
    fn policy(&self, _spec: &EnvSpec, _slots: usize) -> Option<Result<Box<dyn Policy>>> {
        None
    }

    /// Returns a predictor of latents; `None` for a model that does not predict latents.
    fn predictor(&self) -> Option<Box<dyn Predictor>> {
        None
    }

    /// Writes the files that `load_pretrained` of the reference implementation reads; `None` if the reference
    /// implementation has no such family.
    ///
    /// # Errors
    /// When the reference implementation has no model of these sizes, or a file cannot be written.
    fn export(&self, _folder: &Path) -> Option<Result<()>> {
        None
    }

    /// Returns the image encoder, for probes; `None` for a state-only model.
    fn encoder(&self) -> Option<Box<dyn ImageEncoder>> {
        None
    }
}

impl<M: ModelFamily> LoadedModel for Checkpoint<M> {
    fn info(&self) -> Result<CheckpointInfo> {
        Ok(CheckpointInfo {
            family: M::FAMILY,
            weights: self.hash().to_owned(),
            config: json!(self.config),
            toml: self.config.to_toml()?,
            dataset_info: self.dataset_info.clone(),
            image_size: M::image_size(&self.config.model),
            action_block: self.config.data.frameskip,
            history: M::history(&self.config),
            manifest: self.manifest.clone(),
        })
    }

    fn cost(&self) -> Option<Box<dyn CostModel>> {
        M::cost(self)
    }

    fn acts(&self) -> bool {
        M::ACTS
    }

    fn policy(&self, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        M::policy(self, spec, slots)
    }

    fn predictor(&self) -> Option<Box<dyn Predictor>> {
        M::predictor(self)
    }

    fn export(&self, folder: &Path) -> Option<Result<()>> {
        M::export(self, folder)
    }

    fn encoder(&self) -> Option<Box<dyn ImageEncoder>> {
        M::encoder(self)
    }
}
