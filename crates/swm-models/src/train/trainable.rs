//! [`Trainable`]: what a model tells the training loop.

use super::config::{Preset, TrainConfig};
use super::dataset_info::DatasetInfo;
use crate::nn::parameters::Named;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Serialize, de::DeserializeOwned};
use std::fmt::Debug;
use std::path::Path;
use swm_core::{Batch, Key, Result, Schema};
use swm_data::LoaderConfig;

/// A model that the training loop can train: a module with its configuration, its data and its loss.
///
/// Everything a model stores is a parameter of its module, under its published name: target networks and running
/// statistics are parameters that need no gradient.
pub trait Trainable: Module + Sync + 'static {
    /// Its name, such as `lewm`.
    const FAMILY: &'static str;
    /// What it is, in a sentence.
    const SUMMARY: &'static str;
    /// The configurations that come with the program; the first is what is meant when none is named.
    const PRESETS: &'static [Preset];
    /// Whether actions lie between -1 and 1 in its units, which stand for the smallest and the largest of the data, instead of
    /// having mean 0 and spread 1.
    const BOUNDED_ACTIONS: bool = false;
    /// Its sizes: the table `model` of a configuration.
    type Config: Serialize + DeserializeOwned + Clone + Debug + PartialEq + Send + Sync;
    /// Weights and settings of its loss: the table `loss`.
    type Loss: Serialize + DeserializeOwned + Clone + Debug + PartialEq + Send + Sync;

    /// Checks that the settings fit each other, as far as the family knows; the loop checks its own.
    ///
    /// # Errors
    /// Naming the first that does not.
    fn check(config: &TrainConfig<Self>) -> Result<()>;

    /// The side of the square pictures it sees; none for a model without eyes.
    fn image_size(config: &Self::Config) -> Option<usize>;

    /// What a batch holds: clip, columns and goals. The loop decides batch size, order, threads and episodes.
    ///
    /// # Errors
    /// When the dataset lacks a column, or it is of another shape.
    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig>;

    /// A model with initial values decided by `key`.
    ///
    /// # Errors
    /// When the data do not fit the configuration.
    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, key: Key, device: &Device) -> Result<Self>;

    /// Puts weights of others in place, such as a pretrained encoder's; called once, on a model that begins its
    /// training. `cache` is where downloads are kept.
    ///
    /// # Errors
    /// When they cannot be had or do not fit.
    fn with_pretrained_weights(self, _config: &TrainConfig<Self>, _cache: &Path) -> Result<Self> {
        Ok(self)
    }

    /// Loss and gradients of one batch.
    ///
    /// # Errors
    /// When the batch does not fit.
    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput>;

    /// The model after the optimizer's step: running statistics follow, target networks move.
    #[must_use]
    fn after_step(self, _context: &StepContext<'_, Self>, _buffers: Named<Tensor<1>>) -> Self {
        self
    }

    /// How the optimizer treats the parameter of a name.
    fn parameter_group(_name: &str) -> ParameterGroup {
        ParameterGroup::default()
    }
}

/// How the optimizer treats a parameter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ParameterGroup {
    /// Parameters of equal number share one gradient norm, which is clipped.
    pub clip: usize,
    /// A factor of the learning rate.
    pub lr: f64,
}

impl Default for ParameterGroup {
    fn default() -> Self {
        Self { clip: 0, lr: 1.0 }
    }
}

/// What a step may look at beside the model and the batch.
pub struct StepContext<'a, M: Trainable> {
    /// The run's configuration.
    pub config: &'a TrainConfig<M>,
    /// What is known of the data.
    pub dataset_info: &'a DatasetInfo,
    /// Decides the random numbers of this step.
    pub key: Key,
    /// Where tensors live.
    pub device: &'a Device,
    /// Whether this is training; in validation there is no dropout, and nobody looks at gradients.
    pub training: bool,
}

/// What a step found.
#[derive(Default)]
pub struct StepOutput {
    /// Named numbers; the first is the total loss, `loss`.
    pub metrics: Vec<(&'static str, f64)>,
    /// Gradients by parameter, flat. A parameter without one keeps its value.
    pub gradients: Named<Tensor<1>>,
    /// What [`Trainable::after`] needs.
    pub buffers: Named<Tensor<1>>,
}

impl StepOutput {
    /// The total loss.
    pub fn loss(&self) -> f64 {
        self.metrics.first().map_or(f64::NAN, |&(_, loss)| loss)
    }
}
