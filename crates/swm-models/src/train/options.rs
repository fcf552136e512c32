//! [`TrainOptions`] and [`TrainSummary`]: the options of a run that do not change its results, and the summary of a
//! run.

use burn::tensor::Device;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Options of a run that do not change its results.
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// Whether to continue the run in the output folder, if the folder holds a run.
    pub resume: bool,
    /// The device that holds the tensors.
    pub device: Device,
    /// Number of compute threads; 0 for all cores.
    pub threads: usize,
    /// Number of threads that load data.
    pub loader_threads: usize,
    /// Number of prefetched batches.
    pub prefetch: usize,
    /// The folder in which downloaded pretrained weights are cached.
    pub cache: PathBuf,
    /// The folder in which the features of frames by a part of an encoder that is not trained are kept for later runs;
    /// `None` keeps them in memory.
    pub feature_cache: Option<PathBuf>,
}

impl Default for TrainOptions {
    fn default() -> Self {
        let cache = std::env::temp_dir().join("swm-weights");
        let device = Device::flex();
        Self { resume: false, device, threads: 0, loader_threads: 1, prefetch: 4, cache, feature_cache: None }
    }
}

/// The result of a run.
#[derive(Clone, Debug, Serialize)]
pub struct TrainSummary {
    /// The run folder, which holds the checkpoint.
    #[serde(serialize_with = "swm_core::files::serialize_path")]
    pub checkpoint: PathBuf,
    /// The hash of the weights.
    pub weights: String,
    /// The number of finished steps.
    pub steps: usize,
    /// Whether the run was interrupted; training again with `resume` continues the run.
    pub interrupted: bool,
    /// Whether the run ended early because the validation loss no longer fell.
    pub stopped_early: bool,
    /// The step and the loss of the best validation, whose weights are in `best/`.
    pub best: Option<(usize, f64)>,
    /// Means of the metrics over the last logged steps, by name.
    pub metrics: BTreeMap<String, f64>,
    /// The number of trained scalars.
    pub parameters: usize,
    /// The number of training clips per second.
    pub clips_per_second: f64,
    /// The fraction of the time spent waiting for data.
    pub data_wait: f64,
    /// Duration of the run in seconds.
    pub seconds: f64,
}
