//! [`Trainable`]: the contract between a model and the training loop.

use super::config::TrainConfig;
use super::dataset_info::DatasetInfo;
use super::fixed_features::FixedPart;
use super::optim::ParameterGroup;
use super::presets::Preset;
use super::step_output::StepOutput;
use crate::nn::parameters::Named;
use crate::nn::{BackboneConfig, Init};
use crate::pixels::ImageNormalization;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use serde::{Serialize, de::DeserializeOwned};
use std::fmt::Debug;
use std::path::Path;
use swm_core::{Batch, Key, Result, Schema};
use swm_data::LoaderConfig;

/// A model that the training loop can train: a module with its configuration, its data and its loss.
///
/// Every stored tensor of a model is a parameter of the module, under its published name. Target networks and running
/// statistics are parameters that need no gradient.
pub trait Trainable: Module + Sync + 'static {
    /// The name of the family, as in `config.json` and on the command line.
    const FAMILY: &'static str;
    /// One-sentence description of the family.
    const SUMMARY: &'static str;
    /// The built-in configurations; the first is the default.
    const PRESETS: &'static [Preset];
    /// Whether the smallest and the largest action of the data are mapped to -1 and 1. Otherwise, actions are
    /// standardised to mean 0 and standard deviation 1.
    const BOUNDED_ACTIONS: bool = false;
    /// The sizes of the networks: the table `model` of a configuration.
    type Config: Serialize + DeserializeOwned + Clone + Debug + PartialEq + Send + Sync;
    /// Weights and settings of the loss: the table `loss`.
    type Loss: Serialize + DeserializeOwned + Clone + Debug + PartialEq + Send + Sync;

    /// Checks the settings of the family; the training loop checks the settings of all families.
    ///
    /// # Errors
    /// When two settings contradict each other; the error names the first such setting.
    fn check(config: &TrainConfig<Self>) -> Result<()>;

    /// The side of the square images that the model takes, in pixels; `None` for a state-only model.
    fn image_size(config: &Self::Config) -> Option<usize>;

    /// The image encoder and the normalisation of its images, whose colours may have to be found in the data; `None` for a model
    /// without images.
    fn encoder_config(_config: &mut Self::Config) -> Option<(&mut BackboneConfig, ImageNormalization)> {
        None
    }

    /// Returns the clips, columns and goals of a batch. The training loop sets batch size, order, threads and episodes.
    ///
    /// # Errors
    /// When the dataset lacks a column, or a column has another shape.
    fn loader_config(config: &TrainConfig<Self>, schema: &Schema) -> Result<LoaderConfig>;

    /// Creates a model whose initial values come from `init`.
    ///
    /// # Errors
    /// When the data do not fit the configuration.
    fn new(config: &TrainConfig<Self>, dataset_info: &DatasetInfo, init: &Init) -> Result<Self>;

    /// Loads pretrained weights, such as the weights of an encoder, into a new model. `cache` is the folder for
    /// downloads.
    ///
    /// # Errors
    /// When the weights cannot be fetched or do not fit.
    fn with_pretrained_weights(self, _config: &TrainConfig<Self>, _cache: &Path) -> Result<Self> {
        Ok(self)
    }

    /// The part of the encoder that is not trained, if frames may be replaced by its features: [`Trainable::step`] then
    /// receives features in place of images.
    fn fixed_part(&self, _config: &Self::Config) -> Option<FixedPart> {
        None
    }

    /// Computes loss and gradients of one batch.
    ///
    /// # Errors
    /// When the batch does not fit the model.
    fn step(&self, context: &StepContext<'_, Self>, batch: &Batch) -> Result<StepOutput>;

    /// Updates running statistics and target networks after the optimizer's step. The buffers are those
    /// that [`Trainable::step`] returned.
    #[must_use]
    fn after_step(self, _context: &StepContext<'_, Self>, _buffers: Named<Tensor<1>>) -> Self {
        self
    }

    /// Returns the group of a parameter, given the parameter's name.
    fn parameter_group(_name: &str) -> ParameterGroup {
        ParameterGroup::default()
    }
}

/// The inputs of a training step besides the model and the batch.
pub struct StepContext<'a, M: Trainable> {
    /// The run's configuration.
    pub config: &'a TrainConfig<M>,
    /// Statistics of the dataset.
    pub dataset_info: &'a DatasetInfo,
    /// The key of the step's random draws.
    pub key: Key,
    /// The device that holds the tensors.
    pub device: &'a Device,
    /// True in training; false in validation, which has no dropout and needs no gradients.
    pub training: bool,
}
