//! Training: the loop, its configuration, its logs.
//!
//! A run is decided by its configuration and its data. The step number alone says which batch comes next and which
//! random numbers it uses, so a run that was interrupted continues as if it had not been.

pub mod config;
pub mod log;
pub mod optim;
pub mod schedule;

pub use config::{DataConfig, PRESETS, Preset, TrainConfig};
pub use optim::{AdamW, OptimConfig};
pub use schedule::ScheduleConfig;

use crate::checkpoint::{Checkpoint, TrainState};
use crate::lewm::step::{Losses, StepOutput, TrainBatch};
use crate::lewm::{Lewm, loss, pixels, step};
use burn::tensor::{Device, Tensor, TensorData};
use serde::Serialize;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use swm_core::{DType, Error, Key, Manifest, Result};
use swm_data::{ClipSpec, Loader, LoaderConfig, Part, Reader, Split, column_stats};
use swm_plan::ActionScale;

/// What does not decide the numbers of a run.
#[derive(Clone, Debug)]
pub struct TrainOptions {
    /// Continue the run in the output folder, if there is one.
    pub resume: bool,
    /// Threads that compute; 0 for all.
    pub threads: usize,
    /// Threads that load data.
    pub loader_threads: usize,
    /// Batches loaded ahead.
    pub prefetch: usize,
}

impl Default for TrainOptions {
    fn default() -> Self {
        Self { resume: false, threads: 0, loader_threads: 1, prefetch: 4 }
    }
}

/// How far a run is.
#[derive(Clone, Copy, Debug)]
pub struct Progress {
    /// Steps done.
    pub step: usize,
    /// Steps in all.
    pub steps: usize,
    /// Passes over the data done.
    pub epoch: u64,
    /// The losses of the last step.
    pub losses: Losses,
    /// Its learning rate.
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
    /// The mean losses of the last logged steps: total, prediction, SIGReg.
    pub losses: [f64; 3],
    /// Parameters trained.
    pub parameters: usize,
    /// Clips trained on per second.
    pub clips_per_second: f64,
    /// The share of the time spent waiting for data.
    pub data_wait: f64,
    /// Seconds in all.
    pub seconds: f64,
}

/// Trains a LeWM on a dataset with the columns `pixels` and `action`; the checkpoint and the logs go to `out`.
///
/// `stop` ends the run after the current step; what was learnt is saved.
///
/// # Errors
/// When the configuration contradicts itself or the data, `out` holds a run that may not or cannot be continued,
/// the loss is not finite, or the disk refuses.
pub fn train(
    config: &TrainConfig,
    reader: Arc<dyn Reader>,
    out: &Path,
    options: &TrainOptions,
    observer: &mut dyn Observer,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let threads = swm_core::pool::threads(options.threads)?;
    let mut run = Run::new(config, reader, out, options)?;
    threads.install(|| run.go(observer, stop))
}

/// A run in progress.
struct Run<'a> {
    config: &'a TrainConfig,
    out: &'a Path,
    device: Device,
    loader: Loader,
    checkpoint: Checkpoint,
    optimizer: AdamW,
    done: usize,
    log: log::Log,
}

impl<'a> Run<'a> {
    fn new(config: &'a TrainConfig, reader: Arc<dyn Reader>, out: &'a Path, options: &TrainOptions) -> Result<Self> {
        config.check()?;
        let device = Device::flex();
        let (action, action_dim) = action_scale(&*reader)?;
        pixels::check(&config.model, reader.schema(), "pixels")?;
        let dataset = reader.content_hash()?;
        let env = reader.manifest().and_then(|manifest| Some(manifest.config.get("env")?.as_str()?.to_owned()));

        let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
        manifest.libraries.insert("burn".to_owned(), "0.22.1".to_owned());
        manifest.hashes.insert("dataset".to_owned(), dataset);
        manifest.device = "cpu (flex)".to_owned();

        let fresh = |device: &Device| Checkpoint {
            model: Lewm::new(
                &config.model,
                config.data.frameskip * action_dim,
                Key::new(config.seed).with("init"),
                device,
            ),
            config: config.clone(),
            action,
            env,
            manifest,
        };
        let mut optimizer = AdamW::new(config.optim.clone());
        let mut done = 0;
        let checkpoint = if Checkpoint::exists(out) {
            if !options.resume {
                return Err(Error::config(
                    out.display().to_string(),
                    "holds a training run already",
                    "continue it with `resume`, or choose another folder",
                ));
            }
            let (checkpoint, state) = Checkpoint::load_to_resume(out, &device)?;
            let wanted = fresh(&device);
            same_run(out, &checkpoint.manifest, &wanted.manifest)?;
            done = state.step;
            optimizer.restore(state.step, state.moments, &device);
            checkpoint
        } else {
            std::fs::create_dir_all(out).map_err(|error| Error::io(out, "creating a folder", error))?;
            fresh(&device)
        };

        let episodes = trained_on(config.data.hold_out, &*reader)?;
        let loader = Loader::new(
            reader,
            LoaderConfig {
                clip: ClipSpec {
                    num_steps: config.data.num_steps,
                    frameskip: config.data.frameskip,
                    columns: vec!["pixels".to_owned(), "action".to_owned()],
                },
                batch_size: config.data.batch_size,
                shuffle: true,
                seed: config.seed,
                threads: options.loader_threads,
                prefetch: options.prefetch,
                drop_last: true,
                episodes,
                ..LoaderConfig::default()
            },
        )?;
        let log = log::Log::new(out, done > 0)?;
        Ok(Self { config, out, device, loader, checkpoint, optimizer, done, log })
    }

    #[allow(clippy::cast_precision_loss)]
    fn go(&mut self, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<TrainSummary> {
        let steps = self.config.schedule.steps;
        let per_epoch = self.loader.batches_per_epoch();
        let begun = Instant::now();
        let first = self.done;
        let mut waited = 0.0;
        let mut window = Window::default();
        let mut last = [f64::NAN; 3];
        let mut interrupted = false;
        let mut clips_per_second = 0.0;
        'run: while self.done < steps {
            let epoch = (self.done / per_epoch) as u64;
            let mut batches = self.loader.epoch(epoch, self.done % per_epoch);
            loop {
                if self.done == steps {
                    break 'run;
                }
                if stop.load(Ordering::Relaxed) {
                    interrupted = true;
                    break 'run;
                }
                let asked = Instant::now();
                let Some(batch) = batches.next() else { break };
                waited += asked.elapsed().as_secs_f64();
                let (losses, lr, gradient_norm) = self.learn(&*batch?)?;
                self.done += 1;

                let elapsed = begun.elapsed().as_secs_f64();
                clips_per_second = ((self.done - first) * self.config.data.batch_size) as f64 / elapsed;
                let data_wait = waited / elapsed;
                observer.progress(&Progress {
                    step: self.done,
                    steps,
                    epoch,
                    losses,
                    lr,
                    gradient_norm,
                    clips_per_second,
                    data_wait,
                });
                window.add(losses, gradient_norm);
                if self.done.is_multiple_of(self.config.log_every) || self.done == steps {
                    let ([total, prediction, sigreg], norm) = window.take();
                    last = [total, prediction, sigreg];
                    self.log.write(
                        self.done,
                        &[
                            ("loss", total),
                            ("prediction", prediction),
                            ("sigreg", sigreg),
                            ("lr", lr),
                            ("gradient_norm", norm),
                            ("clips_per_second", clips_per_second),
                            ("data_wait", data_wait),
                            ("seconds", elapsed),
                        ],
                    )?;
                }
                let save = self.config.save_every;
                if save > 0 && self.done.is_multiple_of(save) && self.done < steps {
                    self.save()?;
                }
            }
        }
        let weights = self.save()?;
        let seconds = begun.elapsed().as_secs_f64();
        Ok(TrainSummary {
            checkpoint: self.out.to_owned(),
            weights,
            steps: self.done,
            interrupted,
            losses: last,
            parameters: burn::module::Module::num_params(&self.checkpoint.model),
            clips_per_second,
            data_wait: if seconds > 0.0 { waited / seconds } else { 0.0 },
            seconds,
        })
    }

    /// One step; returns losses, learning rate and gradient norm.
    fn learn(&mut self, batch: &swm_core::Batch) -> Result<(Losses, f64, f64)> {
        let model = &self.config.model;
        let key = Key::new(self.config.seed).with("step").at(self.done as u64);
        let directions = loss::directions(key.with("sigreg"), model.latent, self.config.sigreg.directions);
        let batch = prepare(self.config, &self.checkpoint.action, batch, &self.device)?;
        let mut noise = key.with("dropout").rng();
        let StepOutput { losses, gradients, statistics: [projector, pred_proj], .. } = step::step(
            &self.checkpoint.model,
            &batch,
            &self.config.sigreg,
            &directions,
            self.config.shards,
            Some(&mut noise),
        );
        let share = self.config.schedule.share(self.done);
        let finite = losses.total.is_finite();
        let (mut model, norm) = if finite {
            self.optimizer.step(self.checkpoint.model.clone(), share, gradients)
        } else {
            (self.checkpoint.model.clone(), f64::NAN)
        };
        if !norm.is_finite() {
            return Err(Error::NotFinite {
                what: format!("the loss or its gradient at training step {}", self.done + 1),
                given: format!("loss {}, SIGReg {}, gradient norm {norm}", losses.total, losses.sigreg),
                fix: "lower optim.lr or lengthen schedule.warmup; the last checkpoint, if any, is kept".to_owned(),
            });
        }
        model.projector.track(projector);
        model.pred_proj.track(pred_proj);
        self.checkpoint.model = model;
        Ok((losses, self.config.optim.lr * share, norm))
    }

    fn save(&mut self) -> Result<String> {
        let state = TrainState { step: self.done, moments: self.optimizer.state() };
        self.checkpoint.save(self.out, Some(&state))
    }
}

/// Means of what happened since the last line of the log.
#[derive(Default)]
struct Window {
    losses: [f64; 3],
    norm: f64,
    count: usize,
}

impl Window {
    fn add(&mut self, losses: Losses, norm: f64) {
        for (sum, loss) in self.losses.iter_mut().zip([losses.total, losses.prediction, losses.sigreg]) {
            *sum += loss;
        }
        self.norm += norm;
        self.count += 1;
    }

    /// The mean losses and gradient norm; begins anew.
    #[allow(clippy::cast_precision_loss)]
    fn take(&mut self) -> ([f64; 3], f64) {
        let Self { losses, norm, count } = std::mem::take(self);
        let count = count.max(1) as f64;
        (losses.map(|sum| sum / count), norm / count)
    }
}

/// A batch of clips as the model wants it.
///
/// # Errors
/// When a column is missing or of another size.
pub fn prepare(
    config: &TrainConfig,
    action: &ActionScale,
    batch: &swm_core::Batch,
    device: &Device,
) -> Result<TrainBatch> {
    let patches = pixels::patches(&config.model, batch.get::<u8>("pixels")?, device)?;
    let mut actions = batch.get::<f32>("action")?.to_vec();
    let dim = action.dim();
    let mut scaled = vec![0.0; dim];
    for one in actions.chunks_exact_mut(dim) {
        action.to_model(one, &mut scaled);
        for (to, &from) in one.iter_mut().zip(&scaled) {
            // The last action of a clip may be missing; the mean stands in for it and nothing sees it.
            *to = if from.is_nan() { 0.0 } else { from };
        }
    }
    let shape = [batch.rows(), config.data.num_steps, config.data.frameskip * dim];
    Ok(TrainBatch { patches, actions: Tensor::from_data(TensorData::new(actions, shape), device) })
}

/// The positions of the episodes a model is trained on: all, or those that are not held out.
///
/// # Errors
/// When every episode is held out.
pub(crate) fn trained_on(hold_out: bool, reader: &dyn Reader) -> Result<Option<Vec<usize>>> {
    if !hold_out {
        return Ok(None);
    }
    let split = Split::default();
    match split.episodes(reader, Part::Train) {
        Ok(episodes) => Ok(Some(episodes)),
        Err(_) => Err(Error::config(
            "hold_out",
            format!("all {} episodes of the dataset are held out", reader.episodes().len()),
            "collect more episodes, or train on all of them with hold_out=false",
        )),
    }
}

/// The scale of a dataset's actions, and the numbers in one.
#[allow(clippy::cast_possible_truncation)]
fn action_scale(reader: &dyn Reader) -> Result<(ActionScale, usize)> {
    let column = reader.schema().column("action")?;
    if column.dtype != DType::Float32 {
        let given = format!("{} actions", column.dtype.name());
        return Err(Error::mismatch("training a LeWM", given, "float32 actions of a continuous action space"));
    }
    let stats = column_stats(reader, "action", None)?;
    // A number that never changes carries nothing: leave its scale alone.
    let std = stats.std.iter().map(|&std| if std > 1e-6 { std as f32 } else { 1.0 }).collect();
    Ok((ActionScale { mean: stats.mean.iter().map(|&mean| mean as f32).collect(), std }, column.len()))
}

/// Checks that a stored run and the one asked for are the same.
fn same_run(path: &Path, stored: &Manifest, wanted: &Manifest) -> Result<()> {
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
