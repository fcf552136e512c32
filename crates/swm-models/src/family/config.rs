//! [`TrainableConfig`]: a complete training configuration of any family.

use super::contract::{ModelFamily, OnlineRun, TrainRun};
use crate::online::OnlineSummary;
use crate::train::{TrainConfig, TrainOptions, TrainSummary, TrainingPlan, begin, check_data, train};
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use swm_core::run::Control;
use swm_core::{Result, Schema};
use swm_data::Reader;

/// A complete training configuration of any family.
pub trait TrainableConfig {
    /// Returns the configuration as TOML.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    fn to_toml(&self) -> Result<String>;

    /// Returns the configuration as TOML, with the documentation of each setting as a comment above it.
    ///
    /// # Errors
    /// As [`TrainableConfig::to_toml`].
    fn to_commented_toml(&self) -> Result<String>;

    /// Returns the configuration as JSON.
    fn to_json(&self) -> Value;

    /// Returns the number of training steps.
    fn steps(&self) -> usize;

    /// Returns the side of the model's square images in pixels; `None` for a state-only model.
    fn image_size(&self) -> Option<usize>;

    /// Checks that a dataset with the columns of `schema` fits the model, as far as the columns tell.
    ///
    /// # Errors
    /// When a column that the model reads is missing, or has another type or shape.
    fn check_columns(&self, schema: &Schema) -> Result<()>;

    /// Checks the dataset of a training, as far as it can be checked before there is a folder of the run.
    ///
    /// # Errors
    /// When the dataset does not fit the model, or does not fill a batch.
    fn check_data(&self, run: &TrainRun<'_>) -> Result<()>;

    /// Trains by acting in environments; `None` for a family that trains on datasets only.
    ///
    /// # Errors
    /// As [`crate::online::train_online`].
    fn train_online(&self, run: OnlineRun<'_>, control: &mut Control<'_>) -> Option<Result<OnlineSummary>>;

    /// Trains on a dataset.
    ///
    /// # Errors
    /// As [`crate::train()`].
    fn train(&self, run: TrainRun<'_>, control: &mut Control<'_>) -> Result<TrainSummary>;

    /// Writes the checkpoint from which a training loop outside this program begins, or checks the one from which it
    /// continues; `None` for a family that has no such checkpoint. `record` runs before the first checkpoint is written.
    ///
    /// # Errors
    /// As [`crate::train::begin`].
    fn begin(
        &self,
        reader: Arc<dyn Reader>,
        out: &Path,
        options: &TrainOptions,
        record: &dyn Fn() -> Result<()>,
    ) -> Option<Result<TrainingPlan>>;
}

impl<M: ModelFamily> TrainableConfig for TrainConfig<M> {
    fn to_toml(&self) -> Result<String> {
        Self::to_toml(self)
    }

    fn to_commented_toml(&self) -> Result<String> {
        Self::to_commented_toml(self)
    }

    fn to_json(&self) -> Value {
        json!(self)
    }

    fn steps(&self) -> usize {
        self.schedule.steps
    }

    fn image_size(&self) -> Option<usize> {
        M::image_size(&self.model)
    }

    fn check_columns(&self, schema: &Schema) -> Result<()> {
        M::loader_config(self, schema).map(drop)
    }

    fn check_data(&self, run: &TrainRun<'_>) -> Result<()> {
        check_data(self, &run.reader)
    }

    fn train_online(&self, run: OnlineRun<'_>, control: &mut Control<'_>) -> Option<Result<OnlineSummary>> {
        M::train_online(self, run, control)
    }

    fn train(&self, run: TrainRun<'_>, control: &mut Control<'_>) -> Result<TrainSummary> {
        train(self, run.reader, run.out, &run.options, control)
    }

    fn begin(
        &self,
        reader: Arc<dyn Reader>,
        out: &Path,
        options: &TrainOptions,
        record: &dyn Fn() -> Result<()>,
    ) -> Option<Result<TrainingPlan>> {
        Some(begin(self, reader, out, options, record))
    }
}
