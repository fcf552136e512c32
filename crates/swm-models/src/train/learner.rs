//! [`Learner`]: a model, its optimizer and the progress of the run. The training loop on datasets and the
//! online training loop both update a learner.
//!
//! The loops access a model through the object-safe trait [`DynLearner`], so they are compiled once and not once per
//! family.

use super::config::TrainConfig;
use super::dataset_info::DatasetInfo;
use super::optim::AdamW;
use super::options::TrainOptions;
use super::run_state::RunState;
use super::step_output::StepOutput;
use super::trainable::{StepContext, Trainable};
use super::{metrics::Metrics, resume};
use crate::checkpoint::{Checkpoint, TrainState};
use crate::device::within_memory;
use crate::nn::{Init, parameters};
use burn::tensor::Device;
use std::path::Path;
use swm_core::{Batch, Key, Manifest, Result};

/// The operations of a training loop on a model of any family.
pub(crate) trait DynLearner {
    /// The progress of the run.
    fn state(&self) -> &RunState;

    /// The mutable progress of the run.
    fn state_mut(&mut self) -> &mut RunState;

    /// Saves the weights in a folder inside `out` if `loss` is the lowest so far; returns whether `loss` is the lowest.
    ///
    /// # Errors
    /// When writing fails.
    fn save_if_best(&mut self, loss: f64, out: &Path) -> Result<bool>;

    /// Computes loss and gradients of a batch. Without `training`, uses the averaged weights if an average is kept.
    ///
    /// # Errors
    /// When the batch does not fit the model.
    fn loss_and_gradients(&self, batch: &Batch, key: Key, training: bool) -> Result<StepOutput>;

    /// Makes one optimizer step, then calls [`Trainable::after_step`] with `key`.
    fn update(&mut self, output: StepOutput, key: Key) -> Update;

    /// Saves the checkpoint and the state from which training continues, and returns the hash of the weights.
    ///
    /// # Errors
    /// When writing fails.
    fn save(&self, out: &Path) -> Result<String>;

    /// The number of trained scalars.
    fn parameter_count(&self) -> usize;
}

/// The result of an optimizer step.
pub(crate) struct Update {
    /// The metrics of the step.
    pub metrics: Metrics,
    /// The learning rate of the step.
    pub lr: f64,
    /// The norm of the gradient before clipping.
    pub gradient_norm: f64,
}

/// The folder, inside a run folder, of the checkpoint with the lowest validation loss or the highest mean return.
const BEST: &str = "best";

/// A model in training.
pub(crate) struct Learner<'a, M: Trainable> {
    config: &'a TrainConfig<M>,
    device: &'a Device,
    /// The trained weights.
    model: M,
    /// The exponential moving average of the weights; `None` if the configuration sets no average.
    average: Option<M>,
    dataset_info: DatasetInfo,
    manifest: Manifest,
    optimizer: AdamW,
    state: RunState,
}

impl<'a, M: Trainable> Learner<'a, M> {
    /// Resumes the run in the folder `out`, or returns `None` if the folder holds no run.
    ///
    /// # Errors
    /// When the run cannot be continued: `options.resume` is not set, or the configuration or the data differ.
    pub fn resume(
        config: &'a TrainConfig<M>,
        dataset_info: &DatasetInfo,
        manifest: &Manifest,
        out: &Path,
        options: &'a TrainOptions,
    ) -> Result<Option<Self>> {
        if !Checkpoint::<M>::exists(out) {
            return Ok(None);
        }
        if !options.resume {
            return Err(resume::refuse_existing(out));
        }
        let device = &options.device;
        let (checkpoint, stored) = Checkpoint::<M>::load_to_resume(out, device)?;
        resume::check_same_run(out, &checkpoint.manifest, manifest)?;
        if let Some((step, _)) = stored.state.best {
            resume::check_best(&out.join(BEST), step)?;
        }
        let mut optimizer = AdamW::new(config.optim.clone());
        optimizer.restore(stored.state.step, stored.moments, device);
        let (model, average) = match stored.raw {
            Some(raw) => (raw, Some(checkpoint.model)),
            None => (checkpoint.model, None),
        };
        let (dataset_info, manifest) = (dataset_info.clone(), manifest.clone());
        Ok(Some(Self { config, device, model, average, dataset_info, manifest, optimizer, state: stored.state }))
    }

    /// Creates a model with initial weights.
    ///
    /// # Errors
    /// When the data do not fit the configuration.
    pub fn start(
        config: &'a TrainConfig<M>,
        dataset_info: DatasetInfo,
        manifest: Manifest,
        device: &'a Device,
    ) -> Result<Self> {
        let init = Init::new(Key::new(config.seed).with("init"), device);
        let model = M::new(config, &dataset_info, &init)?;
        init.check()?;
        let (optimizer, state) = (AdamW::new(config.optim.clone()), RunState::default());
        Ok(Self { config, device, model, average: None, dataset_info, manifest, optimizer, state })
    }

    /// Loads pretrained weights, and starts the average of the weights if the configuration sets one.
    ///
    /// # Errors
    /// When the weights cannot be fetched or do not fit.
    pub fn with_pretrained_weights(self, cache: &Path) -> Result<Self> {
        let model = self.model.with_pretrained_weights(self.config, cache)?;
        let average = (self.config.optim.ema > 0.0).then(|| model.clone());
        Ok(Self { model, average, ..self })
    }

    /// The trained weights.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Statistics of the data.
    pub fn dataset_info(&self) -> &DatasetInfo {
        &self.dataset_info
    }

    fn context(&self, key: Key, training: bool) -> StepContext<'_, M> {
        StepContext { config: self.config, dataset_info: &self.dataset_info, key, device: self.device, training }
    }

    /// Returns the checkpoint, with the averaged weights if an average is kept.
    fn checkpoint(&self) -> Checkpoint<M> {
        Checkpoint {
            model: self.average.as_ref().unwrap_or(&self.model).clone(),
            config: self.config.clone(),
            dataset_info: self.dataset_info.clone(),
            manifest: self.manifest.clone(),
        }
    }
}

impl<M: Trainable> DynLearner for Learner<'_, M> {
    fn state(&self) -> &RunState {
        &self.state
    }

    fn state_mut(&mut self) -> &mut RunState {
        &mut self.state
    }

    fn save_if_best(&mut self, loss: f64, out: &Path) -> Result<bool> {
        let is_best = self.state.best.is_none_or(|(_, best)| loss < best || best.is_nan());
        if is_best {
            self.state.best = Some((self.state.step, loss));
            self.checkpoint().save(&out.join(BEST), None)?;
        }
        Ok(is_best)
    }

    fn loss_and_gradients(&self, batch: &Batch, key: Key, training: bool) -> Result<StepOutput> {
        let model = if training { &self.model } else { self.average.as_ref().unwrap_or(&self.model) };
        let setting =
            "data.batch_size (optim.accumulate keeps the clips of an optimizer step) or the sizes of the model";
        within_memory(self.device, setting, || model.step(&self.context(key, training), batch))
    }

    fn update(&mut self, output: StepOutput, key: Key) -> Update {
        let StepOutput { metrics, gradients, buffers } = output;
        let lr_factor = self.config.schedule.lr_factor(self.state.step);
        let (model, gradient_norm) = self.optimizer.step(self.model.clone(), lr_factor, gradients, M::parameter_group);
        let model = model.after_step(&self.context(key, true), buffers);
        if let Some(average) = self.average.take() {
            self.average = Some(parameters::blend(average, &model, self.config.optim.ema));
        }
        self.model = model;
        self.state.step += 1;
        Update { metrics, lr: self.config.optim.lr * lr_factor, gradient_norm }
    }

    fn save(&self, out: &Path) -> Result<String> {
        let state = TrainState {
            state: self.state.clone(),
            moments: self.optimizer.state(),
            raw: self.average.as_ref().map(|_| self.model.clone()),
        };
        self.checkpoint().save(out, Some(&state))
    }

    fn parameter_count(&self) -> usize {
        parameters::trained_count(&self.model)
    }
}

/// The manifest of a training run whose data have the hash `dataset`.
pub(crate) fn manifest<M: Trainable>(config: &TrainConfig<M>, dataset: String, device: &Device) -> Manifest {
    let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
    manifest.libraries.insert("burn".to_owned(), "0.22.1".to_owned());
    manifest.hashes.insert("dataset".to_owned(), dataset);
    manifest.device = crate::device::name(device);
    manifest
}
