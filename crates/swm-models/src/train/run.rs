//! [`train`]: the training loop on a dataset.

use super::colours::with_colours;
use super::config::{LoopConfig, TrainConfig};
use super::dataset_info::DatasetInfo;
use super::failed_batch;
use super::fixed_features::FixedFeatures;
use super::learner::{self, DynLearner, Learner, Update};
use super::log::{Log, remove_later_steps};
use super::metrics::{MetricWindow, Metrics};
use super::optim::ParameterGroup;
use super::options::{TrainOptions, TrainSummary};
use super::resume;
use super::run_state::is_due;
use super::split::episodes;
use super::step_output::StepOutput;
use super::trainable::Trainable;
use crate::checkpoint::{self, Checkpoint};
use crate::nn::parameters;
use rayon::prelude::*;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use swm_core::files::Lock;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Batch, Error, Key, Manifest, Result};
use swm_data::{Epoch, Loader, LoaderConfig, Part, Reader};

/// The name of the stage in the events of a training run.
pub(crate) const STAGE: &str = "train";

/// Trains a model on a dataset; the checkpoint and the logs go to the folder `out`.
///
/// `control` is checked before every step. An interrupted run saves its checkpoint and returns a summary with
/// `interrupted`. The metrics of the progress events are the metrics of the model, then `validation_loss` (after the
/// first validation), `lr`, `gradient_norm`, `clips_per_second` and `data_wait`, the fraction of the time spent waiting
/// for data.
///
/// # Errors
/// When the configuration contradicts itself or the data, `out` holds a run that cannot be continued, another process
/// trains in `out`, the loss or its gradient is not finite (the batch is saved), the caller's poll fails or a batch cannot be
/// read (both after saving), or writing fails.
pub fn train<M: Trainable>(
    config: &TrainConfig<M>,
    reader: Arc<dyn Reader>,
    out: &Path,
    options: &TrainOptions,
    control: &mut Control<'_>,
) -> Result<TrainSummary> {
    let threads = swm_core::pool::threads(options.threads)?;
    threads.install(|| {
        let config = &with_colours(config, &*reader)?;
        let inputs = Inputs::of(config, &*reader, options)?;
        check_data(config, &reader)?;
        let _lock = Lock::folder(out)?;
        let (mut learner, loader) = inputs.learner(config, out, options)?;
        let part = learner.model().fixed_part(&config.model);
        let reader = FixedFeatures::of(reader, part, options.feature_cache.as_deref(), control)?;
        let run = Run::new(config.loop_config(), loader, &reader, out, options, &mut learner)?;
        run.run_steps(M::FAMILY, control)
    })
}

/// Writes the checkpoint from which a run on a dataset begins, with the initial weights, for a training loop outside this
/// program; or, to continue a run, checks its checkpoint, and names the old one as the current one if a kill between the two
/// renamings left only the old one. Returns what the loop needs besides the checkpoint.
///
/// Before the first checkpoint, after all checks, `record` writes what continues the run: a kill between the two leaves no
/// checkpoint without it.
///
/// # Errors
/// As [`train`], before the first step.
pub fn begin<M: Trainable>(
    config: &TrainConfig<M>,
    reader: Arc<dyn Reader>,
    out: &Path,
    options: &TrainOptions,
    record: &dyn Fn() -> Result<()>,
) -> Result<TrainingPlan> {
    let config = &with_colours(config, &*reader)?;
    let inputs = Inputs::of(config, &*reader, options)?;
    let (training, validation) = loadable(&config.loop_config(), &inputs.loader, &reader)?;
    let _lock = Lock::folder(out)?;
    let (learner, _) = inputs.learner(config, out, options)?;
    if !Checkpoint::<M>::exists(out) {
        resume::check_new_run(out)?;
        record()?;
        learner.save(out)?;
    } else {
        checkpoint::restore_old(out)?;
        remove_later_steps(out, learner.state().step)?;
    }
    let names = parameters::shapes(learner.model()).into_keys();
    let parameters = names.map(|name| (name.clone(), M::parameter_group(&name))).collect();
    Ok(TrainingPlan { parameters, training, validation })
}

/// What a training loop outside this program needs besides the checkpoint from which a run begins.
pub struct TrainingPlan {
    /// The names of all weights, including running statistics, with their groups.
    pub parameters: Vec<(String, ParameterGroup)>,
    /// The batches to train on.
    pub training: LoaderConfig,
    /// The batches of validation; `None` without validation.
    pub validation: Option<LoaderConfig>,
}

/// The inputs of a run, which are checked.
struct Inputs {
    loader: LoaderConfig,
    dataset_info: DatasetInfo,
    manifest: Manifest,
}

impl Inputs {
    fn of<M: Trainable>(config: &TrainConfig<M>, reader: &dyn Reader, options: &TrainOptions) -> Result<Self> {
        config.check()?;
        let loader = M::loader_config(config, reader.schema())?;
        let goals = loader.goals.iter().flat_map(|goal| &goal.columns);
        let columns: Vec<String> = loader.clip.columns.iter().chain(goals).cloned().collect();
        let dataset_info = DatasetInfo::for_training(reader, &columns, M::BOUNDED_ACTIONS)?;
        let manifest = learner::manifest(config, reader.content_hash()?, &options.device);
        Ok(Self { loader, dataset_info, manifest })
    }

    /// Continues the run in `out`, or creates the model of a new run.
    fn learner<'a, M: Trainable>(
        self,
        config: &'a TrainConfig<M>,
        out: &Path,
        options: &'a TrainOptions,
    ) -> Result<(Learner<'a, M>, LoaderConfig)> {
        let Self { loader, dataset_info, manifest } = self;
        let learner = match Learner::resume(config, &dataset_info, &manifest, out, options)? {
            Some(learner) => learner,
            None => Learner::start(config, dataset_info, manifest, &options.device)?
                .with_pretrained_weights(&options.cache)?,
        };
        Ok((learner, loader))
    }
}

/// Checks that a dataset has the columns of a model and fills the batches of a training, before there is a folder of the run.
///
/// # Errors
/// When a column is missing or has another shape, no episode is long enough for a clip, or the clips do not fill a batch.
pub fn check_data<M: Trainable>(config: &TrainConfig<M>, reader: &Arc<dyn Reader>) -> Result<()> {
    loadable(&config.loop_config(), &M::loader_config(config, reader.schema())?, reader).map(drop)
}

/// Returns the batches of training, and those of validation if there is one, after checking that a loader can load them.
fn loadable(
    config: &LoopConfig,
    loader: &LoaderConfig,
    reader: &Arc<dyn Reader>,
) -> Result<(LoaderConfig, Option<LoaderConfig>)> {
    let of = |part| {
        let batches = batches(config, loader.clone(), part, &**reader)?;
        let checked = LoaderConfig { threads: 0, ..batches.clone() };
        Loader::new(Arc::clone(reader), checked).map(|_| batches)
    };
    let training = of(Part::Train)?;
    if config.validation.every == 0 {
        return Ok((training, None));
    }
    let validation = of(Part::Validation).map_err(|error| {
        let fix = "collect more episodes, lower data.batch_size, or leave validation out (validation.every=0)";
        Error::config("the episodes of validation", error.to_string(), fix)
    })?;
    Ok((training, Some(validation)))
}

/// Returns the batches of a part of the dataset.
fn batches(config: &LoopConfig, loader: LoaderConfig, part: Part, reader: &dyn Reader) -> Result<LoaderConfig> {
    Ok(LoaderConfig {
        batch_size: config.data.batch_size,
        // Validation clips are shuffled, because the first batches in stored order come from one or two episodes.
        shuffle: true,
        seed: config.seed,
        drop_last: true,
        episodes: episodes(config.data.hold_out, part, reader)?,
        ..loader
    })
}

/// A run in progress.
struct Run<'a> {
    config: LoopConfig,
    out: &'a Path,
    learner: &'a mut dyn DynLearner,
    batches: Batches,
    validation: Option<Loader>,
    log: Log,
    clock: Clock,
}

/// The batches of a run, epoch after epoch.
struct Batches {
    loader: Loader,
    epoch: Epoch,
    /// The number of batches taken since the start of the run, including the batches before an interruption.
    taken: usize,
}

/// Durations and rates of a run.
struct Clock {
    start: Instant,
    /// The step at which the run began or continued.
    first_step: usize,
    /// Seconds spent waiting for batches.
    waited: f64,
    clips_per_second: f64,
}

impl<'a> Run<'a> {
    fn new(
        config: LoopConfig,
        loader_config: LoaderConfig,
        reader: &Arc<dyn Reader>,
        out: &'a Path,
        options: &TrainOptions,
        learner: &'a mut dyn DynLearner,
    ) -> Result<Self> {
        let loader = |part| {
            let config = batches(&config, loader_config.clone(), part, &**reader)?;
            let config = LoaderConfig { threads: options.loader_threads, prefetch: options.prefetch, ..config };
            Loader::new(Arc::clone(reader), config)
        };
        let validation = match config.validation.every {
            0 => None,
            _ => Some(loader(Part::Validation)?),
        };
        let first_step = learner.state().step;
        let batches = Batches::new(loader(Part::Train)?, first_step * config.optim.accumulate);
        let log = Log::new(out, first_step)?;
        let clock = Clock { start: Instant::now(), first_step, waited: 0.0, clips_per_second: 0.0 };
        Ok(Self { config, out, learner, batches, validation, log, clock })
    }

    fn run_steps(mut self, family: &'static str, control: &mut Control<'_>) -> Result<TrainSummary> {
        let steps = self.config.schedule.steps;
        control.emit(Event::Started(Stage { name: STAGE, subject: &[family], total: steps, unit: "steps" }));
        self.clock.start = Instant::now();
        let mut last = vec![];
        // A run that ended early has nothing left to train when it is resumed.
        let (mut stop, mut stopped_early, mut validation) = (None, self.is_out_of_patience(), None);
        while self.learner.state().step < steps && !stopped_early {
            if let Err(error) = control.check() {
                stop = Some(error);
                break;
            }
            let Update { metrics, lr, gradient_norm } = match self.step()? {
                Step::Made(update) => update,
                Step::NoBatch(error) if self.learner.state().step > self.clock.first_step => {
                    stop = Some(error);
                    break;
                }
                Step::NoBatch(error) => return Err(error),
            };
            let done = self.learner.state().step;
            let elapsed = self.clock.tick(done, &self.config);
            self.learner.state_mut().window.add(&metrics, gradient_norm);
            if is_due(self.config.validation.every, done, steps) {
                let loss = self.validate()?;
                if !loss.is_finite() {
                    stop = Some(self.not_validated(done));
                    break;
                }
                validation = Some(loss);
                stopped_early = self.record_validation(loss)?;
            }
            let rates = self.clock.rates(elapsed);
            let validated = validation.map(|loss| ("validation_loss", loss));
            let rest = [("lr", lr), ("gradient_norm", gradient_norm)].into_iter().chain(rates);
            let shown: Metrics = metrics.into_iter().chain(validated).chain(rest).collect();
            control.progress(Progress { stage: STAGE, done, total: steps, unit: "steps", metrics: &shown });
            if is_due(self.config.log_every, done, steps) || stopped_early {
                let (means, norm) = self.learner.state_mut().window.take();
                last.clone_from(&means);
                self.log_line(done, means, lr, norm, rates, elapsed)?;
            }
            let save_every = self.config.save_every;
            if save_every > 0 && done.is_multiple_of(save_every) && done < steps {
                self.learner.save(self.out)?;
                control.emit(Event::Saved(self.out));
            }
        }
        let saved = self.learner.save(self.out);
        if saved.is_ok() {
            control.emit(Event::Saved(self.out));
        }
        let interrupted = match stop {
            None => false,
            Some(Error::Interrupted) => true,
            Some(error) => return Err(error),
        };
        let weights = saved?;
        if !interrupted {
            control.emit(Event::Finished { stage: STAGE, metrics: &last });
        }
        Ok(self.summary(weights, interrupted, stopped_early, last))
    }

    /// Averages the gradients of the step's batches and makes one optimizer step.
    fn step(&mut self) -> Result<Step> {
        let accumulate = self.config.optim.accumulate;
        let (mut sum, mut last) = (StepOutput::default(), None);
        for _ in 0..accumulate {
            let start = Instant::now();
            let index = self.batches.taken;
            let batch = match self.batches.next() {
                Ok(batch) => batch,
                Err(error) => return Ok(Step::NoBatch(error)),
            };
            self.clock.waited += start.elapsed().as_secs_f64();
            sum.add(self.loss_and_gradients(&batch, index)?);
            last = Some(batch);
        }
        let mean = if accumulate > 1 { sum.scaled(1.0 / accumulate as f64) } else { sum };
        let key = Key::new(self.config.seed).with("after").at(self.learner.state().step as u64);
        let update = self.learner.update(mean, key);
        match last.filter(|_| !update.gradient_norm.is_finite()) {
            // Clipping scales such a gradient to 0, so that the training would go on and learn nothing.
            Some(batch) => {
                Err(self.not_finite("the norm of the gradient", self.learner.state().step, &batch, &update.metrics))
            }
            None => Ok(Step::Made(update)),
        }
    }

    /// Computes loss and gradients of the batch with the index `index`, and checks that they are finite.
    fn loss_and_gradients(&self, batch: &Batch, index: usize) -> Result<StepOutput> {
        let key = Key::new(self.config.seed).with("step").at(index as u64);
        let output = self.learner.loss_and_gradients(batch, key, true)?;
        let not_finite = if !output.loss().is_finite() {
            "the loss"
        } else if output.gradients.par_iter().any(|(_, g)| !g.clone().sum().into_scalar::<f32>().is_finite()) {
            "the gradient of the loss"
        } else {
            return Ok(output);
        };
        Err(self.not_finite(not_finite, self.learner.state().step + 1, batch, &output.metrics))
    }

    /// The error that `what` is not finite at a training step.
    fn not_finite(&self, what: &str, step: usize, batch: &Batch, metrics: &[(&'static str, f64)]) -> Error {
        let what = format!("{what} at training step {step}");
        let fix = "lower optim.lr or the weights of the loss, or lengthen schedule.warmup; the last checkpoint, if any, is kept";
        let repair = "remove or repair the episodes with NaN, which `swm doctor` lists";
        failed_batch::error(self.out, batch, what, &failed_batch::describe(metrics), repair, fix)
    }

    /// Logs the means of the metrics over the validation batches and returns the loss.
    fn validate(&mut self) -> Result<f64> {
        let Some(loader) = &self.validation else { return Ok(f64::NAN) };
        let mut window = MetricWindow::default();
        for (index, batch) in loader.epoch(0, 0).take(self.config.validation.batches).enumerate() {
            let key = Key::new(self.config.seed).with("validation").at(index as u64);
            window.add(&self.learner.loss_and_gradients(&*batch?, key, false)?.metrics, 0.0);
        }
        if window.is_empty() {
            return Err(Error::config(
                "validation.every",
                format!("the validation episodes have fewer clips than a batch of {}", self.config.data.batch_size),
                "collect more episodes, lower data.batch_size, or set validation.every=0",
            ));
        }
        let (metrics, _) = window.take();
        let names: Vec<String> = metrics.iter().map(|(name, _)| format!("validation/{name}")).collect();
        let scalars: Vec<(&str, f64)> = names.iter().map(String::as_str).zip(metrics.iter().map(|m| m.1)).collect();
        self.log.write(self.learner.state().step, &scalars)?;
        Ok(metrics.first().map_or(f64::NAN, |&(_, loss)| loss))
    }

    /// The error that the validation loss is not finite, after which the weights of the step are saved.
    fn not_validated(&self, step: usize) -> Error {
        Error::config(
            "the validation loss",
            format!("is not finite after step {step}, whose weights are kept"),
            "look for values that are not finite in the validation episodes (`swm doctor`), and continue with --resume, or train with \
             validation.every=0",
        )
    }

    /// Saves the weights if `loss` is the lowest so far; returns whether training is to stop early.
    fn record_validation(&mut self, loss: f64) -> Result<bool> {
        let is_best = self.learner.save_if_best(loss, self.out)?;
        let since_best = &mut self.learner.state_mut().validations_since_best;
        *since_best = if is_best { 0 } else { *since_best + 1 };
        Ok(self.is_out_of_patience())
    }

    /// Whether as many validations as `validation.patience` have followed the best one.
    fn is_out_of_patience(&self) -> bool {
        let patience = self.config.validation.patience;
        patience > 0 && self.learner.state().validations_since_best >= patience
    }

    fn log_line(
        &mut self,
        step: usize,
        mut means: Metrics,
        lr: f64,
        gradient_norm: f64,
        rates: [(&'static str, f64); 2],
        elapsed: f64,
    ) -> Result<()> {
        means.extend([("lr", lr), ("gradient_norm", gradient_norm)]);
        means.extend(rates);
        means.push(("seconds", elapsed));
        self.log.write(step, &means)
    }

    fn summary(self, weights: String, interrupted: bool, stopped_early: bool, last: Metrics) -> TrainSummary {
        let seconds = self.clock.start.elapsed().as_secs_f64();
        let state = self.learner.state();
        TrainSummary {
            checkpoint: self.out.to_owned(),
            weights,
            steps: state.step,
            interrupted,
            stopped_early,
            best: state.best,
            metrics: last.into_iter().map(|(name, value)| (name.to_owned(), value)).collect(),
            parameters: self.learner.parameter_count(),
            clips_per_second: self.clock.clips_per_second,
            data_wait: if seconds > 0.0 { self.clock.waited / seconds } else { 0.0 },
            seconds,
        }
    }
}

/// What came of a step.
enum Step {
    /// An update.
    Made(Update),
    /// A batch could not be read; the model is as before.
    NoBatch(Error),
}

impl Batches {
    /// Creates the batches that follow the first `taken` batches.
    fn new(loader: Loader, taken: usize) -> Self {
        let per_epoch = loader.batches_per_epoch();
        let epoch = loader.epoch((taken / per_epoch) as u64, taken % per_epoch);
        Self { loader, epoch, taken }
    }

    /// Returns the next batch; the first batch of the next epoch follows the last batch of an epoch.
    fn next(&mut self) -> Result<swm_data::LoadedBatch> {
        loop {
            match self.epoch.next() {
                Some(batch) => {
                    self.taken += 1;
                    return batch;
                }
                None => self.epoch = self.loader.epoch((self.taken / self.loader.batches_per_epoch()) as u64, 0),
            }
        }
    }
}

impl Clock {
    /// Updates the rates after `done` steps and returns the seconds since the run began or continued.
    fn tick(&mut self, done: usize, config: &LoopConfig) -> f64 {
        let elapsed = self.start.elapsed().as_secs_f64();
        let clips = (done - self.first_step) * config.optim.accumulate * config.data.batch_size;
        self.clips_per_second = clips as f64 / elapsed;
        elapsed
    }

    fn rates(&self, elapsed: f64) -> [(&'static str, f64); 2] {
        [("clips_per_second", self.clips_per_second), ("data_wait", self.waited / elapsed)]
    }
}
