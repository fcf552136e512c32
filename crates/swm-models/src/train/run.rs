//! The loop.

use super::config::TrainConfig;
use super::trainable::{StepContext, StepOutput, Trainable};
use super::{AdamW, DatasetInfo, Observer, Progress, TrainOptions, TrainSummary, episodes, failure, log};
use crate::checkpoint::{Checkpoint, TrainState};
use crate::nn::parameters::{self, Named};
use burn::tensor::Tensor;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use swm_core::{Batch, Error, Key, Manifest, Result};
use swm_data::{Loader, LoaderConfig, Part, Reader};

/// The folder, inside a run's, of the checkpoint with the lowest loss on held-out episodes.
pub const BEST: &str = "best";

/// Trains a model on a dataset; the checkpoint and the logs go to `out`.
///
/// `stop` ends the run after the current step; what was learnt is saved.
///
/// # Errors
/// When the configuration contradicts itself or the data, `out` holds a run that may not or cannot be continued,
/// the loss is not finite (the batch is saved), or the disk refuses.
pub fn train<M: Trainable>(
    config: &TrainConfig<M>,
    reader: Arc<dyn Reader>,
    out: &Path,
    options: &TrainOptions,
    observer: &mut dyn Observer,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let threads = swm_core::pool::threads(options.threads)?;
    threads.install(|| Run::new(config, reader, out, options)?.go(observer, stop))
}

/// A run in progress.
struct Run<'a, M: Trainable> {
    config: &'a TrainConfig<M>,
    out: &'a Path,
    options: &'a TrainOptions,
    loader: Loader,
    validation: Option<Loader>,
    /// The weights that are trained.
    model: M,
    /// Their running average, where one is kept.
    average: Option<M>,
    dataset_info: DatasetInfo,
    manifest: Manifest,
    optimizer: AdamW,
    state: RunState,
    log: log::Log,
}

/// Named numbers.
type Metrics = Vec<(&'static str, f64)>;

/// How far a run is: all that its future depends on, beside the tensors.
#[derive(Clone, Debug, Default, serde::Serialize, serde::Deserialize)]
pub(crate) struct RunState {
    /// Steps done.
    pub step: usize,
    /// The step and the loss of the best look at held-out episodes.
    #[serde(default)]
    pub best: Option<(usize, f64)>,
    /// Looks since then.
    #[serde(default)]
    pub looks: usize,
}

impl<'a, M: Trainable> Run<'a, M> {
    fn new(
        config: &'a TrainConfig<M>,
        reader: Arc<dyn Reader>,
        out: &'a Path,
        options: &'a TrainOptions,
    ) -> Result<Self> {
        config.check()?;
        let device = &options.device;
        let wanted = M::loader_config(config, reader.schema())?;
        let columns: Vec<String> =
            wanted.clip.columns.iter().chain(wanted.goals.iter().flat_map(|goal| &goal.columns)).cloned().collect();
        let dataset_info = DatasetInfo::from_reader(&*reader, &columns, M::BOUNDED_ACTIONS)?;
        let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
        manifest.libraries.insert("burn".to_owned(), "0.22.1".to_owned());
        manifest.hashes.insert("dataset".to_owned(), reader.content_hash()?);
        manifest.device = crate::device::name(device);

        let mut optimizer = AdamW::new(config.optim.clone());
        let mut state = RunState::default();
        let (model, average);
        if Checkpoint::<M>::exists(out) {
            if !options.resume {
                return Err(Error::config(
                    out.display().to_string(),
                    "holds a training run already",
                    "continue it with `resume`, or choose another folder",
                ));
            }
            let (checkpoint, stored) = Checkpoint::<M>::load_to_resume(out, device)?;
            same_run(out, &checkpoint.manifest, &manifest)?;
            optimizer.restore(stored.position.step, stored.moments, device);
            state = stored.position;
            match stored.raw {
                Some(raw) => (model, average) = (raw, Some(checkpoint.model)),
                None => (model, average) = (checkpoint.model, None),
            }
        } else {
            std::fs::create_dir_all(out).map_err(|error| Error::io(out, "creating a folder", error))?;
            let fresh = M::new(config, &dataset_info, Key::new(config.seed).with("init"), device)?;
            model = fresh.with_pretrained_weights(config, &options.cache)?;
            average = (config.optim.ema > 0.0).then(|| model.clone());
        }

        let loader = |wanted: LoaderConfig, part, shuffle| {
            let config = LoaderConfig {
                batch_size: config.data.batch_size,
                shuffle,
                seed: config.seed,
                threads: options.loader_threads,
                prefetch: options.prefetch,
                drop_last: true,
                episodes: episodes(config.data.hold_out, part, &*reader)?,
                ..wanted
            };
            Loader::new(Arc::clone(&reader), config)
        };
        // In shuffled order, too: in stored order, the first batches would come from one or two episodes.
        let validation = match config.validation.every {
            0 => None,
            _ => Some(loader(wanted.clone(), Part::Validation, true)?),
        };
        let loader = loader(wanted, Part::Train, true)?;
        let log = log::Log::new(out, state.step > 0)?;
        Ok(Self {
            config,
            out,
            options,
            loader,
            validation,
            model,
            average,
            dataset_info,
            manifest,
            optimizer,
            state,
            log,
        })
    }

    #[allow(clippy::cast_precision_loss)]
    fn go(mut self, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<TrainSummary> {
        let steps = self.config.schedule.steps;
        let accumulate = self.config.optim.accumulate;
        let per_epoch = self.loader.batches_per_epoch();
        let begun = Instant::now();
        let first = self.state.step;
        let mut waited = 0.0;
        let mut window = Window::default();
        let mut last = vec![];
        let (mut interrupted, mut stopped_early) = (false, false);
        let mut clips_per_second = 0.0;
        let mut validation = None;
        let mut taken = self.state.step * accumulate;
        let mut batches = self.loader.epoch((taken / per_epoch) as u64, taken % per_epoch);
        while self.state.step < steps && !stopped_early {
            if stop.load(Ordering::Relaxed) {
                interrupted = true;
                break;
            }
            let mut learnt = Learnt::default();
            for _ in 0..accumulate {
                let asked = Instant::now();
                let batch = loop {
                    match batches.next() {
                        Some(batch) => break batch?,
                        None => batches = self.loader.epoch((taken / per_epoch) as u64, 0),
                    }
                };
                waited += asked.elapsed().as_secs_f64();
                self.look(&batch, taken, &mut learnt)?;
                taken += 1;
            }
            let (metrics, lr, gradient_norm) = self.learn(learnt)?;
            let done = self.state.step;

            let elapsed = begun.elapsed().as_secs_f64();
            clips_per_second = ((done - first) * accumulate * self.config.data.batch_size) as f64 / elapsed;
            let data_wait = waited / elapsed;
            window.add(&metrics, gradient_norm);
            if due(self.config.validation.every, done, steps) {
                let (loss, logged) = self.validate()?;
                validation = Some(loss);
                self.log.write(done, &logged.iter().map(|(name, v)| (name.as_str(), *v)).collect::<Vec<_>>())?;
                stopped_early = self.judge(loss)?;
            }
            observer.progress(&Progress {
                step: done,
                steps,
                epoch: (taken / per_epoch) as u64,
                metrics,
                validation,
                lr,
                gradient_norm,
                clips_per_second,
                data_wait,
            });
            if due(self.config.log_every, done, steps) || stopped_early {
                let (metrics, norm) = window.take();
                last.clone_from(&metrics);
                let mut line = metrics;
                line.extend([
                    ("lr", lr),
                    ("gradient_norm", norm),
                    ("clips_per_second", clips_per_second),
                    ("data_wait", data_wait),
                    ("seconds", elapsed),
                ]);
                self.log.write(done, &line)?;
            }
            let save = self.config.save_every;
            if save > 0 && done.is_multiple_of(save) && done < steps {
                self.save()?;
            }
        }
        let weights = self.save()?;
        let seconds = begun.elapsed().as_secs_f64();
        Ok(TrainSummary {
            checkpoint: self.out.to_owned(),
            weights,
            steps: self.state.step,
            interrupted,
            stopped_early,
            best: self.state.best,
            metrics: last.into_iter().map(|(name, value)| (name.to_owned(), value)).collect(),
            parameters: parameters::trained_count(&self.model),
            clips_per_second,
            data_wait: if seconds > 0.0 { waited / seconds } else { 0.0 },
            seconds,
        })
    }

    /// Loss and gradients of one batch, added to those of the step.
    fn look(&self, batch: &Batch, number: usize, learnt: &mut Learnt) -> Result<()> {
        let key = Key::new(self.config.seed).with("step").at(number as u64);
        let output = self.model.step(&self.context(key, true), batch)?;
        if !output.loss().is_finite() {
            return Err(self.failed(batch, &output, "the loss"));
        }
        if output.gradients.values().any(|g| !g.clone().abs().sum().into_scalar::<f32>().is_finite()) {
            return Err(self.failed(batch, &output, "the gradient of the loss"));
        }
        learnt.add(output);
        Ok(())
    }

    /// What is wrong with a batch that gave numbers that are not finite; the batch is saved.
    fn failed(&self, batch: &Batch, output: &StepOutput, what: &str) -> Error {
        let numbers: Vec<String> = output.metrics.iter().map(|(name, value)| format!("{name} {value}")).collect();
        let kept = match failure::save(self.out, batch) {
            Ok(path) => format!("the batch is in {}", path.display()),
            Err(error) => format!("the batch could not be saved ({error})"),
        };
        Error::NotFinite {
            what: format!("{what} at training step {}", self.state.step + 1),
            given: format!("{} ({kept})", numbers.join(", ")),
            fix: "lower optim.lr or lengthen schedule.warmup; the last checkpoint, if any, is kept".to_owned(),
        }
    }

    fn context(&self, key: Key, training: bool) -> StepContext<'_, M> {
        StepContext {
            config: self.config,
            dataset_info: &self.dataset_info,
            key,
            device: &self.options.device,
            training,
        }
    }

    /// One step of the optimizer; returns the step's numbers, its learning rate and the gradient's norm.
    fn learn(&mut self, learnt: Learnt) -> Result<(Metrics, f64, f64)> {
        let StepOutput { metrics, gradients, buffers } = learnt.mean();
        let share = self.config.schedule.share(self.state.step);
        let (model, norm) = self.optimizer.step(self.model.clone(), share, gradients, M::parameter_group);
        let key = Key::new(self.config.seed).with("after").at(self.state.step as u64);
        let model = model.after_step(&self.context(key, true), buffers);
        if let Some(average) = self.average.take() {
            self.average = Some(parameters::blend(average, &model, self.config.optim.ema));
        }
        self.model = model;
        self.state.step += 1;
        Ok((metrics, self.config.optim.lr * share, norm))
    }

    /// The loss on held-out episodes, and every number by the name it is logged under.
    #[allow(clippy::cast_precision_loss)]
    fn validate(&self) -> Result<(f64, Vec<(String, f64)>)> {
        let Some(loader) = &self.validation else { return Ok((f64::NAN, vec![])) };
        let model = self.average.as_ref().unwrap_or(&self.model);
        let mut window = Window::default();
        for (number, batch) in loader.epoch(0, 0).take(self.config.validation.batches).enumerate() {
            let key = Key::new(self.config.seed).with("validation").at(number as u64);
            window.add(&model.step(&self.context(key, false), &*batch?)?.metrics, 0.0);
        }
        if window.count == 0 {
            return Err(Error::config(
                "validation.every",
                format!("the episodes held out have fewer than {} clips, a batch", self.config.data.batch_size),
                "collect more episodes, lower data.batch_size, or say validation.every=0",
            ));
        }
        let (metrics, _) = window.take();
        let loss = metrics.first().map_or(f64::NAN, |&(_, loss)| loss);
        Ok((loss, metrics.into_iter().map(|(name, value)| (format!("validation/{name}"), value)).collect()))
    }

    /// Keeps the best weights so far; returns whether it is time to give up.
    fn judge(&mut self, loss: f64) -> Result<bool> {
        if self.state.best.is_none_or(|(_, best)| loss < best) {
            self.state.best = Some((self.state.step, loss));
            self.state.looks = 0;
            self.checkpoint().save(&self.out.join(BEST), None)?;
        } else {
            self.state.looks += 1;
        }
        let patience = self.config.validation.patience;
        Ok(patience > 0 && self.state.looks >= patience)
    }

    /// The model as others use it.
    fn checkpoint(&self) -> Checkpoint<M> {
        Checkpoint {
            model: self.average.as_ref().unwrap_or(&self.model).clone(),
            config: self.config.clone(),
            dataset_info: self.dataset_info.clone(),
            manifest: self.manifest.clone(),
        }
    }

    fn save(&self) -> Result<String> {
        let state = TrainState {
            position: self.state.clone(),
            moments: self.optimizer.state(),
            raw: self.average.as_ref().map(|_| self.model.clone()),
        };
        self.checkpoint().save(self.out, Some(&state))
    }
}

/// Whether something that happens every so many steps, and at the end, is due.
pub(crate) fn due(every: usize, done: usize, steps: usize) -> bool {
    every > 0 && (done.is_multiple_of(every) || done == steps)
}

/// What the batches of a step found, added up.
#[derive(Default)]
struct Learnt {
    sum: StepOutput,
    count: usize,
}

impl Learnt {
    fn add(&mut self, output: StepOutput) {
        self.count += 1;
        if self.count == 1 {
            self.sum = output;
            return;
        }
        for (sum, (_, value)) in self.sum.metrics.iter_mut().zip(output.metrics) {
            sum.1 += value;
        }
        add(&mut self.sum.gradients, output.gradients);
        add(&mut self.sum.buffers, output.buffers);
    }

    #[allow(clippy::cast_precision_loss)]
    fn mean(self) -> StepOutput {
        let Self { mut sum, count } = self;
        if count > 1 {
            let share = 1.0 / count as f64;
            sum.metrics.iter_mut().for_each(|(_, value)| *value *= share);
            for tensors in [&mut sum.gradients, &mut sum.buffers] {
                *tensors = std::mem::take(tensors).into_iter().map(|(name, t)| (name, t * share)).collect();
            }
        }
        sum
    }
}

/// Adds tensors by name.
pub(super) fn add(sum: &mut Named<Tensor<1>>, more: Named<Tensor<1>>) {
    for (name, tensor) in more {
        let tensor = match sum.remove(&name) {
            Some(sum) => sum + tensor,
            None => tensor,
        };
        sum.insert(name, tensor);
    }
}

/// Means of what happened since the last line of the log.
#[derive(Default)]
pub(crate) struct Window {
    metrics: Vec<(&'static str, f64)>,
    norm: f64,
    count: usize,
}

impl Window {
    pub fn add(&mut self, metrics: &[(&'static str, f64)], norm: f64) {
        if self.count == 0 {
            self.metrics = metrics.iter().map(|&(name, _)| (name, 0.0)).collect();
        }
        for (sum, (_, value)) in self.metrics.iter_mut().zip(metrics) {
            sum.1 += value;
        }
        self.norm += norm;
        self.count += 1;
    }

    /// The means and the mean gradient norm; begins anew.
    #[allow(clippy::cast_precision_loss)]
    pub fn take(&mut self) -> (Vec<(&'static str, f64)>, f64) {
        let Self { metrics, norm, count } = std::mem::take(self);
        let count = count.max(1) as f64;
        (metrics.into_iter().map(|(name, sum)| (name, sum / count)).collect(), norm / count)
    }
}

/// Checks that a stored run and the one asked for are the same.
pub(crate) fn same_run(path: &Path, stored: &Manifest, wanted: &Manifest) -> Result<()> {
    let problem = if stored.config != wanted.config {
        let differing = differences("", &stored.config, &wanted.config);
        format!("the run there has another configuration ({})", differing.join(", "))
    } else if stored.hashes.get("dataset") != wanted.hashes.get("dataset") {
        "the run there was trained on other data".to_owned()
    } else {
        return Ok(());
    };
    Err(Error::config(
        path.display().to_string(),
        problem,
        "continue with what it began with, or choose another folder",
    ))
}

/// The keys in which two configurations differ, with both values.
fn differences(prefix: &str, a: &serde_json::Value, b: &serde_json::Value) -> Vec<String> {
    match (a, b) {
        (serde_json::Value::Object(left), serde_json::Value::Object(right)) => {
            let mut keys: Vec<&String> = left.keys().chain(right.keys()).collect();
            keys.sort();
            keys.dedup();
            let null = serde_json::Value::Null;
            keys.into_iter()
                .flat_map(|key| {
                    let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                    differences(&name, left.get(key).unwrap_or(&null), right.get(key).unwrap_or(&null))
                })
                .collect()
        }
        _ if a == b => vec![],
        _ => vec![format!("{prefix}: {a} there, {b} here")],
    }
}
