//! [`TrainableConfig`] and [`LoadedModel`] for inverse dynamics, which has its own training loop and checkpoint format
//! because its network is trained on the latents of another checkpoint.

use super::checkpoint::FAMILY;
use super::{InverseCheckpoint, InverseConfig, InversePolicy, check_data, train};
use crate::checkpoint::Checkpoint;
use crate::family::{CheckpointInfo, FamilyEntry, LoadedModel, OnlineRun, TrainRun, TrainableConfig};
use crate::lewm::Lewm;
use crate::online::OnlineSummary;
use crate::probe::ImageEncoder;
use crate::train::described::describe;
use crate::train::{Preset, TrainOptions, TrainSummary, Trainable as _, TrainingPlan};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{EnvSpec, Error, Policy, Result, Schema};
use swm_data::Reader;

/// The registry row of inverse dynamics.
pub const ENTRY: FamilyEntry = FamilyEntry {
    id: FAMILY,
    summary: "inverse dynamics on the frozen encoder of another checkpoint: acts without planning, the cheap baseline",
    presets: &[Preset {
        id: "tiny",
        summary: "trains in seconds on two CPU cores, given --encoder",
        toml: InverseConfig::PRESET,
    }],
    borrows_encoder: Some(Lewm::FAMILY),
    config: |_, settings| Ok(Box::new(InverseConfig::load(settings)?)),
    requirements: || Ok(None),
    load: |stored, device| Ok(Box::new(InverseCheckpoint::load(stored, device)?)),
    import: |_, _, _| None,
};

impl TrainableConfig for InverseConfig {
    fn to_toml(&self) -> Result<String> {
        Self::to_toml(self)
    }

    fn to_commented_toml(&self) -> Result<String> {
        Ok(describe(&Self::to_toml(self)?, "InverseConfig", &[]))
    }

    fn to_json(&self) -> Value {
        json!(self)
    }

    fn steps(&self) -> usize {
        self.schedule.steps
    }

    fn image_size(&self) -> Option<usize> {
        None
    }

    /// The encoder's checkpoint, which is opened later, decides which columns fit.
    fn check_columns(&self, _: &Schema) -> Result<()> {
        Ok(())
    }

    fn check_data(&self, run: &TrainRun<'_>) -> Result<()> {
        check_data(self, &world_model(run)?, &run.reader)
    }

    fn train_online(&self, _: OnlineRun<'_>, _: &mut Control<'_>) -> Option<Result<OnlineSummary>> {
        None
    }

    fn train(&self, run: TrainRun<'_>, control: &mut Control<'_>) -> Result<TrainSummary> {
        if run.options.resume {
            return Err(not_resumed());
        }
        train(self, &world_model(&run)?, run.reader, run.out, run.options.threads, control)
    }

    fn begin(
        &self,
        _: Arc<dyn Reader>,
        _: &Path,
        _: &TrainOptions,
        _: &dyn Fn() -> Result<()>,
    ) -> Option<Result<TrainingPlan>> {
        None
    }
}

/// Loads the checkpoint whose encoder a training uses.
///
/// # Errors
/// When none is named, or it cannot be loaded.
fn world_model(run: &TrainRun<'_>) -> Result<Checkpoint<Lewm>> {
    let Some(encoder) = run.encoder else {
        return Err(Error::config(
            "--encoder",
            "an inverse-dynamics policy uses the encoder of another model",
            "name a checkpoint with --encoder (`swm checkpoints` lists them)",
        ));
    };
    Checkpoint::load(encoder, &run.options.device)
}

impl LoadedModel for InverseCheckpoint {
    fn info(&self) -> Result<CheckpointInfo> {
        Ok(CheckpointInfo {
            family: FAMILY,
            weights: self.hash().to_owned(),
            config: json!(self.config),
            toml: self.config.to_toml()?,
            dataset_info: self.world_model.dataset_info.clone(),
            image_size: Lewm::image_size(&self.world_model.config.model),
            action_block: self.world_model.config.data.frameskip,
            history: 1,
            manifest: self.manifest.clone(),
        })
    }

    fn acts(&self) -> bool {
        true
    }

    fn policy(&self, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        Some(InversePolicy::new(self.clone(), spec, slots).map(|policy| Box::new(policy) as Box<dyn Policy>))
    }

    fn encoder(&self) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(self.world_model.clone()))
    }
}

/// The error of a run that is to be continued.
pub fn not_resumed() -> Error {
    let problem = "an inverse-dynamics run takes seconds and cannot be resumed";
    Error::config("--resume", problem, "leave out --resume and choose another --output")
}
