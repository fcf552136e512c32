//! Training: one loop for every [`Trainable`] model, its configuration, its logs.
//!
//! A run is decided by its configuration and its data. The step number alone says which batches come next and which
//! random numbers they use, so a run that was interrupted continues as if it had not been.

pub mod config;
mod dataset_info;
pub(crate) mod failure;
pub mod log;
pub mod optim;
pub(crate) mod run;
pub mod schedule;
pub mod shards;
mod trainable;

pub use config::{DataConfig, Preset, TrainConfig, ValidationConfig, at_least};
pub use dataset_info::{ColumnInfo, DatasetInfo};
pub use optim::{AdamW, OptimConfig};
pub use run::train;
pub use schedule::ScheduleConfig;
pub use trainable::{ParameterGroup, StepContext, StepOutput, Trainable};

use burn::tensor::Device;
use serde::Serialize;
use std::path::PathBuf;
use swm_core::{Error, Result};
use swm_data::{Part, Reader, Split};

/// What does not decide the numbers of a run.
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// Continue the run in the output folder, if there is one.
    pub resume: bool,
    /// Where tensors live.
    pub device: Device,
    /// Threads that compute; 0 for all.
    pub threads: usize,
    /// Threads that load data.
    pub loader_threads: usize,
    /// Batches loaded ahead.
    pub prefetch: usize,
    /// Where weights of others are kept, once downloaded.
    pub cache: PathBuf,
}

impl Default for TrainOptions {
    fn default() -> Self {
        let cache = std::env::temp_dir().join("swm-weights");
        Self { resume: false, device: Device::flex(), threads: 0, loader_threads: 1, prefetch: 4, cache }
    }
}

/// How far a run is.
#[derive(Clone, Debug)]
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Steps in all.
    pub steps: usize,
    /// Passes over the data done.
    pub epoch: u64,
    /// The numbers of the last step; the first is the loss.
    pub metrics: Vec<(&'static str, f64)>,
    /// The loss on the episodes held out, when they were looked at last.
    pub validation: Option<f64>,
    /// The learning rate of the last step.
    pub lr: f64,
    /// The norm of its gradient before clipping.
    pub gradient_norm: f64,
    /// Clips trained on per second, since the run began or continued.
    pub clips_per_second: f64,
    /// The share of the time spent waiting for data.
    pub data_wait: f64,
}

/// Who wants to know how far a run is.
pub trait Observer: Send {
    /// A step is done.
    fn progress(&mut self, progress: &Progress);
}

/// Nobody.
impl Observer for () {
    fn progress(&mut self, _progress: &Progress) {}
}

/// How a run ended.
#[derive(Clone, Debug, Serialize)]
pub struct TrainSummary {
    /// The checkpoint.
    pub checkpoint: PathBuf,
    /// The hash of its weights.
    pub weights: String,
    /// Steps done.
    pub steps: usize,
    /// Whether it was stopped before its end; training again with `resume` continues it.
    pub interrupted: bool,
    /// Whether it ended early because the loss on held-out episodes fell no more.
    pub stopped_early: bool,
    /// The step and the loss of the best look at held-out episodes, whose weights are in `best/`.
    pub best: Option<(usize, f64)>,
    /// The means of the last logged steps, by name.
    pub metrics: std::collections::BTreeMap<String, f64>,
    /// Parameters trained.
    pub parameters: usize,
    /// Clips trained on per second.
    pub clips_per_second: f64,
    /// The share of the time spent waiting for data.
    pub data_wait: f64,
    /// Seconds in all.
    pub seconds: f64,
}

/// The positions of the episodes a model is trained on (or validated with): all, or those that are not held out.
///
/// # Errors
/// When no episode is left.
pub(crate) fn episodes(hold_out: bool, part: Part, reader: &dyn Reader) -> Result<Option<Vec<usize>>> {
    if !hold_out {
        return Ok(None);
    }
    match Split::default().episodes(reader, part) {
        Ok(episodes) => Ok(Some(episodes)),
        Err(_) => Err(Error::config(
            "data.hold_out",
            format!("of the {} episodes of the dataset, none is left for {part:?}", reader.episodes().len())
                .to_lowercase(),
            "collect more episodes, or train on all of them with data.hold_out=false validation.every=0",
        )),
    }
}
