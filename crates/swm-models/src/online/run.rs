//! The loop: play, learn, evaluate, save.

use super::collector::{Collector, Place};
use super::learner::Learner;
use super::{Agent, OnlineConfig, SharedModel, evaluation, world};
use crate::checkpoint::Checkpoint;
use crate::nn::parameters;
use crate::train::run::{BEST, Window, due, same_run};
use crate::train::{Observer, Progress, TrainConfig, TrainOptions, log};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use swm_core::{ColumnSpec, EnvPool, Error, Key, Manifest, Policy, RandomPolicy, Result, Schema};
use swm_data::{LoaderConfig, ReplayBuffer, ReplayConfig, ReplayLoader, WriteOptions};

/// How a run ended.
#[derive(Clone, Debug, Serialize)]
pub struct OnlineSummary {
    /// The checkpoint.
    pub checkpoint: PathBuf,
    /// The hash of its weights.
    pub weights: String,
    /// Gradient steps done.
    pub steps: usize,
    /// Environment steps played.
    pub env_steps: usize,
    /// Whether it was stopped before its end; training again with `resume` continues it.
    pub interrupted: bool,
    /// The mean return of the last evaluation.
    pub evaluated: Option<f64>,
    /// The gradient step and the mean return of the best evaluation; its weights are in `best`.
    pub best: Option<(usize, f64)>,
    /// Parameters trained.
    pub parameters: usize,
    /// Seconds in all.
    pub seconds: f64,
    /// The share of them that playing took.
    pub playing: f64,
}

/// Trains a model by playing in the worlds that `worlds` makes, as many as it is asked for; the checkpoint, the best
/// checkpoint so far and the logs go to `out`.
///
/// `stop` ends the run after the current round; what was learnt and played is saved, and `options.resume` goes on with it.
///
/// # Errors
/// When the configuration contradicts itself or the worlds, `out` holds a run that may not or cannot be continued, a loss is
/// not finite, a world fails, or the disk refuses.
pub fn train_online<M: Agent>(
    config: &TrainConfig<M>,
    worlds: &dyn Fn(usize) -> Result<EnvPool>,
    out: &Path,
    options: &TrainOptions,
    observer: &mut dyn Observer,
    stop: &AtomicBool,
) -> Result<OnlineSummary> {
    config.check()?;
    let Some(settings) = &config.online else {
        let fix = "choose a preset that has one (`--print-config` shows it), or train on a dataset with --data";
        return Err(Error::config("online", "the configuration has no such table", fix));
    };
    settings.check()?;
    if config.data.num_steps > settings.part + 1 {
        let given = format!("parts of {} steps hold no clip of {} frames", settings.part, config.data.num_steps);
        return Err(Error::config("online.part", given, "choose longer parts, or lower data.num_steps"));
    }
    let (play, judge) = (worlds(settings.envs)?, worlds(settings.envs.min(settings.evaluate_episodes))?);
    let threads = swm_core::pool::threads(options.threads)?;
    // Worlds are not shared between threads, but may move to those that compute.
    threads.install(|| Run::new(config, settings, play, judge, out, options)?.go(observer, stop))
}

/// A run in progress.
struct Run<'a, M: Agent> {
    settings: &'a OnlineConfig,
    out: &'a Path,
    learner: Learner<'a, M>,
    live: SharedModel<M>,
    collector: Collector,
    replay: ReplayBuffer,
    loader: ReplayLoader,
    /// Who plays until there is something to learn from, and who plays then.
    novice: Box<dyn Policy>,
    player: Box<dyn Policy>,
    judge: EnvPool,
    judged: Box<dyn Policy>,
    log: log::Log,
    key: Key,
}

const REPLAY: &str = "replay.lance";
const PLACE: &str = "place.json";

impl<'a, M: Agent> Run<'a, M> {
    fn new(
        config: &'a TrainConfig<M>,
        settings: &'a OnlineConfig,
        pool: EnvPool,
        judge: EnvPool,
        out: &'a Path,
        options: &'a TrainOptions,
    ) -> Result<Self> {
        let spec = pool.spec().clone();
        // Everything a world shows; of it, what the model wants.
        let shown: Vec<ColumnSpec> =
            pool.infos().schema().columns().iter().cloned().chain([spec.action_column()]).collect();
        let shown = Schema::new(shown)?;
        let LoaderConfig { clip, goals, .. } = M::loader_config(config, &shown)?;
        let dataset_info = world::dataset_info(&spec, &clip.columns)?;
        let columns: Result<Vec<ColumnSpec>> = clip.columns.iter().map(|name| shown.column(name).cloned()).collect();
        let schema = Schema::new(columns?)?;

        let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
        manifest.libraries = pool.env(0).libraries();
        manifest.libraries.insert("burn".to_owned(), "0.22.1".to_owned());
        manifest.hashes.insert("dataset".to_owned(), format!("played in {}", spec.id));
        manifest.device = crate::device::name(&options.device);

        let key = Key::new(config.seed).with("online");
        let mut learner = Learner::new(config, dataset_info, manifest, &options.device)?;
        let mut replay = ReplayBuffer::new(&schema, settings.capacity)?;
        let mut place = None;
        if Checkpoint::<M>::exists(out) {
            if !options.resume {
                return Err(Error::config(
                    out.display().to_string(),
                    "holds a training run already",
                    "continue it with `resume`, or choose another folder",
                ));
            }
            let (checkpoint, state) = Checkpoint::<M>::load_to_resume(out, &options.device)?;
            same_run(out, &checkpoint.manifest, &learner.manifest)?;
            let folder = played(out, state.position.step);
            place = Some(read_place(&folder)?);
            replay = ReplayBuffer::restore(&*swm_data::open(folder.join(REPLAY))?, settings.capacity)?;
            learner.restore(checkpoint, state);
        } else {
            std::fs::create_dir_all(out).map_err(|error| Error::io(out, "creating a folder", error))?;
        }
        let mut collector = Collector::new(pool, &replay, &schema, settings.part, key.with("episode"))?;
        match &place {
            Some(place) => collector.go_to(place)?,
            None => collector.start()?,
        }
        let loader = replay.loader(ReplayConfig {
            clip,
            goals,
            batch_size: config.data.batch_size,
            seed: config.seed,
            threads: 0,
            ..ReplayConfig::default()
        })?;
        let live = SharedModel::new(learner.model.clone());
        let policy = |slots, explore| M::policy(config, &learner.dataset_info, live.clone(), &spec, slots, explore);
        Ok(Self {
            settings,
            out,
            collector,
            replay,
            loader,
            novice: Box::new(RandomPolicy::new(&spec, settings.envs)),
            player: policy(settings.envs, true)?,
            judged: policy(judge.len(), false)?,
            judge,
            log: log::Log::new(out, learner.state.step > 0)?,
            live,
            learner,
            key,
        })
    }

    #[allow(clippy::cast_precision_loss)]
    fn go(mut self, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<OnlineSummary> {
        let config = self.learner.config;
        let steps = config.schedule.steps;
        let begun = Instant::now();
        let first = self.learner.state.step;
        let (mut playing, mut interrupted, mut evaluated) = (0.0, false, None);
        let mut window = Window::default();
        let mut played = None;
        let mut skilled = false;
        self.collector.introduce(&mut *self.novice);
        while self.learner.state.step < steps {
            if stop.load(Ordering::Relaxed) {
                interrupted = true;
                break;
            }
            let learns = self.collector.steps >= self.settings.warmup && self.replay.episodes() > 0;
            if learns && !skilled {
                skilled = true;
                self.collector.introduce(&mut *self.player);
            }
            let asked = Instant::now();
            self.collector.play(if skilled { &mut *self.player } else { &mut *self.novice })?;
            playing += asked.elapsed().as_secs_f64();
            if !self.collector.returns.is_empty() {
                let returns = std::mem::take(&mut self.collector.returns);
                played = Some(mean(&returns));
            }
            if !learns {
                continue;
            }
            for _ in 0..self.settings.updates.min(steps - self.learner.state.step) {
                let step = self.learner.state.step;
                let batch = self.loader.sample(self.key.with("batch").at(step as u64))?;
                let learnt = self.learner.learn(&batch, self.out)?;
                window.add(&learnt.metrics, learnt.gradient_norm);
                let done = self.learner.state.step;
                let elapsed = begun.elapsed().as_secs_f64();
                let rate = ((done - first) * config.data.batch_size) as f64 / elapsed;
                if due(self.settings.evaluate_every, done, steps) {
                    evaluated = Some(self.evaluate()?);
                }
                let mut metrics = learnt.metrics;
                metrics.push(("env_steps", self.collector.steps as f64));
                metrics.extend(played.map(|value| ("return", value)));
                observer.progress(&Progress {
                    step: done,
                    steps,
                    epoch: 0,
                    metrics,
                    validation: evaluated,
                    lr: config.optim.lr * config.schedule.share(step),
                    gradient_norm: learnt.gradient_norm,
                    clips_per_second: rate,
                    data_wait: playing / elapsed,
                });
                if due(config.log_every, done, steps) {
                    let (mut line, norm) = window.take();
                    line.extend([("gradient_norm", norm), ("env_steps", self.collector.steps as f64)]);
                    line.extend(played.map(|value| ("return", value)));
                    line.extend([("clips_per_second", rate), ("playing", playing / elapsed), ("seconds", elapsed)]);
                    self.log.write(done, &line)?;
                }
            }
            self.live.set(self.learner.model.clone());
            let done = self.learner.state.step;
            // Between rounds only: a round that was interrupted could not be continued.
            let save = config.save_every;
            if save > 0 && done / save > (done - self.settings.updates.min(done)) / save && done < steps {
                self.save()?;
            }
        }
        let weights = self.save()?;
        let seconds = begun.elapsed().as_secs_f64();
        Ok(OnlineSummary {
            checkpoint: self.out.to_owned(),
            weights,
            steps: self.learner.state.step,
            env_steps: self.collector.steps,
            interrupted,
            evaluated,
            best: self.learner.state.best.map(|(step, loss)| (step, -loss)),
            parameters: parameters::trained_count(&self.learner.model),
            seconds,
            playing: if seconds > 0.0 { playing / seconds } else { 0.0 },
        })
    }

    /// The mean return of an evaluation; keeps the best weights so far.
    fn evaluate(&mut self) -> Result<f64> {
        self.live.set(self.learner.model.clone());
        let episodes = self.settings.evaluate_episodes;
        let key = self.key.with("evaluation");
        let returns = evaluation::returns(&mut self.judge, &mut *self.judged, episodes, key)?;
        let mean = mean(&returns);
        let (low, high) =
            returns.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
        let step = self.learner.state.step;
        self.log.write(
            step,
            &[
                ("evaluation/return", mean),
                ("evaluation/lowest", low),
                ("evaluation/highest", high),
                ("env_steps", self.collector.steps as f64),
            ],
        )?;
        // The loop's position keeps a loss, of which less is better.
        if self.learner.state.best.is_none_or(|(_, best)| -mean < best) {
            self.learner.state.best = Some((step, -mean));
            self.learner.checkpoint().save(&self.out.join(BEST), None)?;
        }
        Ok(mean)
    }

    /// Saves what was played, then what was learnt: a checkpoint in place always finds its episodes.
    fn save(&mut self) -> Result<String> {
        let folder = played(self.out, self.learner.state.step);
        if folder.exists() {
            std::fs::remove_dir_all(&folder).map_err(|error| Error::io(&folder, "removing an older save", error))?;
        }
        std::fs::create_dir_all(&folder).map_err(|error| Error::io(&folder, "creating a folder", error))?;
        self.replay.save(folder.join(REPLAY), WriteOptions::default())?;
        let place = folder.join(PLACE);
        std::fs::write(&place, json!(self.collector.place()).to_string())
            .map_err(|error| Error::io(&place, "saving what was played", error))?;
        let weights = self.learner.save(self.out)?;
        let entries = std::fs::read_dir(self.out).map_err(|error| Error::io(self.out, "listing a run", error))?;
        for path in entries.filter_map(|entry| Some(entry.ok()?.path())) {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            if name.starts_with(PLAYED) && path != folder {
                std::fs::remove_dir_all(&path).map_err(|error| Error::io(&path, "removing an older save", error))?;
            }
        }
        Ok(weights)
    }
}

const PLAYED: &str = "played-";

/// Where the episodes and the running worlds of a gradient step are kept.
fn played(out: &Path, step: usize) -> PathBuf {
    out.join(format!("{PLAYED}{step}"))
}

fn read_place(folder: &Path) -> Result<Place> {
    let path = folder.join(PLACE);
    let text = std::fs::read(&path).map_err(|error| Error::io(&path, "reading what was played", error))?;
    serde_json::from_slice(&text)
        .map_err(|error| Error::corrupt(&path, error.to_string(), "train again from the beginning"))
}

#[allow(clippy::cast_precision_loss)]
fn mean(numbers: &[f64]) -> f64 {
    numbers.iter().sum::<f64>() / numbers.len().max(1) as f64
}
