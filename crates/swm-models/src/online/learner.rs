//! [`Learner`]: a model, its optimizer, and how far they are.

use crate::checkpoint::{Checkpoint, TrainState};
use crate::train::run::RunState;
use crate::train::{AdamW, DatasetInfo, StepContext, StepOutput, TrainConfig, Trainable, failure};
use burn::tensor::Device;
use std::path::Path;
use swm_core::{Batch, Error, Key, Manifest, Result};

/// Learns from batches.
pub(super) struct Learner<'a, M: Trainable> {
    pub config: &'a TrainConfig<M>,
    pub model: M,
    pub dataset_info: DatasetInfo,
    pub manifest: Manifest,
    device: &'a Device,
    optimizer: AdamW,
    pub state: RunState,
}

/// What a gradient step found: numbers of the model, and the norm of its gradient.
pub(super) struct Learnt {
    pub metrics: Vec<(&'static str, f64)>,
    pub gradient_norm: f64,
}

impl<'a, M: Trainable> Learner<'a, M> {
    /// One that has learnt nothing.
    pub fn new(
        config: &'a TrainConfig<M>,
        dataset_info: DatasetInfo,
        manifest: Manifest,
        device: &'a Device,
    ) -> Result<Self> {
        let model = M::new(config, &dataset_info, Key::new(config.seed).with("init"), device)?;
        let optimizer = AdamW::new(config.optim.clone());
        Ok(Self { config, model, dataset_info, manifest, device, optimizer, state: RunState::default() })
    }

    /// Goes on where a checkpoint is.
    pub fn restore(&mut self, checkpoint: Checkpoint<M>, state: TrainState<M>) {
        self.optimizer.restore(state.position.step, state.moments, self.device);
        (self.state, self.model) = (state.position, checkpoint.model);
    }

    /// Learns from a batch; one whose numbers are not finite is saved in `out`.
    pub fn learn(&mut self, batch: &Batch, out: &Path) -> Result<Learnt> {
        let key = Key::new(self.config.seed).with("step").at(self.state.step as u64);
        let output = self.model.step(&self.context(key), batch)?;
        let StepOutput { metrics, gradients, buffers } = output;
        let loss = metrics.first().map_or(f64::NAN, |&(_, loss)| loss);
        let share = self.config.schedule.share(self.state.step);
        let (model, gradient_norm) = self.optimizer.step(self.model.clone(), share, gradients, M::parameter_group);
        if !(loss.is_finite() && gradient_norm.is_finite()) {
            let numbers: Vec<String> = metrics.iter().map(|(name, value)| format!("{name} {value}")).collect();
            let kept = match failure::save(out, batch) {
                Ok(path) => format!("the batch is in {}", path.display()),
                Err(error) => format!("the batch could not be saved ({error})"),
            };
            return Err(Error::NotFinite {
                what: format!("the loss or its gradient at training step {}", self.state.step + 1),
                given: format!("{}, gradient norm {gradient_norm} ({kept})", numbers.join(", ")),
                fix: "lower optim.lr; the last checkpoint, if any, is kept".to_owned(),
            });
        }
        self.model = model.after_step(&self.context(key), buffers);
        self.state.step += 1;
        Ok(Learnt { metrics, gradient_norm })
    }

    fn context(&self, key: Key) -> StepContext<'_, M> {
        StepContext { config: self.config, dataset_info: &self.dataset_info, key, device: self.device, training: true }
    }

    /// The model as others use it.
    pub fn checkpoint(&self) -> Checkpoint<M> {
        Checkpoint {
            model: self.model.clone(),
            config: self.config.clone(),
            dataset_info: self.dataset_info.clone(),
            manifest: self.manifest.clone(),
        }
    }

    /// Saves it with all that is needed to go on; returns the hash of the weights.
    pub fn save(&self, out: &Path) -> Result<String> {
        let state = TrainState { position: self.state.clone(), moments: self.optimizer.state(), raw: None };
        self.checkpoint().save(out, Some(&state))
    }
}
