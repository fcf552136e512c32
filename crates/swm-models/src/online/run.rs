//! [`train_online`]: the loop that alternates interaction, learning, evaluation and saving.

use super::agent::{Agent, AgentPolicy};
use super::collector::{Collector, CollectorState};
use super::config::OnlineConfig;
use super::evaluation;
use super::shared_model::SharedModel;
use crate::run_folder::{self, COLLECTOR, PLAYED, REPLAY};
use crate::train::config::LoopConfig;
use crate::train::learner::{self, DynLearner, Learner, Update};
use crate::train::metrics::Metrics;
use crate::train::run::STAGE;
use crate::train::run_state::is_due;
use crate::train::{DatasetInfo, TrainConfig, TrainOptions, failed_batch, log, resume};
use serde::Serialize;
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::files::{self, Lock};
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{ColumnSpec, EnvPool, Error, Key, Policy, RandomPolicy, Result, Schema, manifest};
use swm_data::{LoaderConfig, ReplayBuffer, ReplayConfig, ReplayLoader, WriteOptions};

/// The result of an online run.
#[derive(Clone, Debug, Serialize)]
pub struct OnlineSummary {
    /// The run folder, which holds the checkpoint.
    #[serde(serialize_with = "files::serialize_path")]
    pub checkpoint: PathBuf,
    /// The hash of the weights.
    pub weights: String,
    /// Optimizer steps done.
    pub steps: usize,
    /// Environment steps done.
    pub env_steps: usize,
    /// Whether the run was interrupted; training again with `resume` continues the run.
    pub interrupted: bool,
    /// The mean return of the last evaluation.
    pub evaluated: Option<f64>,
    /// The optimizer step and the mean return of the best evaluation, whose weights are in `best/`.
    pub best: Option<(usize, f64)>,
    /// The number of trained scalars.
    pub parameters: usize,
    /// Duration of the run in seconds.
    pub seconds: f64,
    /// The fraction of the time spent on interaction.
    #[serde(rename = "playing")]
    pub interaction: f64,
}

/// Trains a model by interaction with environments; the checkpoint, the best checkpoint so far and the logs go to the
/// folder `out`. `make_pool` creates a pool of the given number of environments.
///
/// `control` is checked before every round. An interrupted run saves the weights and the replay buffer and returns a
/// summary with `interrupted`; `options.resume` continues the run. The progress events have the metrics of the model,
/// then `env_steps`, `return` (of the last episodes), `evaluation_return`, `lr`, `gradient_norm`, `clips_per_second`
/// and `data_wait`, the fraction of the time spent on interaction.
///
/// # Errors
/// When the configuration contradicts itself or the environments, `out` holds a run that cannot be continued, a loss is
/// not finite, an environment fails, `control` returns an error (after saving), or writing fails.
pub fn train_online<M: Agent>(
    config: &TrainConfig<M>,
    make_pool: &dyn Fn(usize) -> Result<EnvPool>,
    out: &Path,
    options: &TrainOptions,
    control: &mut Control<'_>,
) -> Result<OnlineSummary> {
    config.check()?;
    let Some(online) = &config.online else {
        let fix = "choose a preset with this table (`--print-config` shows it), or train on a dataset with --data";
        return Err(Error::config("online", "the configuration has no table `online`", fix));
    };
    online.check()?;
    check_effects(&config.loop_config())?;
    if config.data.num_steps > online.segment + 1 {
        let given = format!("segments of {} steps hold no clip of {} frames", online.segment, config.data.num_steps);
        return Err(Error::config("online.part", given, "raise online.part, or lower data.num_steps"));
    }
    let pool = make_pool(online.envs)?;
    let evaluation_pool = make_pool(online.envs.min(online.evaluate_episodes))?;
    let threads = swm_core::pool::threads(options.threads)?;
    // A pool of environments cannot be shared between threads, but can be moved to a compute thread.
    let _lock = Lock::folder(out)?;
    threads.install(|| start(config, online, pool, evaluation_pool, out, options)?(control))
}

/// Refuses settings of trainings on a dataset that have no effect here.
///
/// # Errors
/// The error names the first such setting.
fn check_effects(config: &LoopConfig) -> Result<()> {
    let others = [
        ("optim.accumulate", config.optim.accumulate.to_string(), "1", config.optim.accumulate != 1),
        ("optim.ema", config.optim.ema.to_string(), "0", config.optim.ema != 0.0),
        ("data.hold_out", config.data.hold_out.to_string(), "false", config.data.hold_out),
        ("validation.every", config.validation.every.to_string(), "0", config.validation.every != 0),
    ];
    match others.into_iter().find(|(.., given)| *given) {
        None => Ok(()),
        Some((name, value, neutral, _)) => {
            let given = format!("{value} has no effect when a model learns in an environment");
            Err(Error::config(name, given, format!("leave it at {neutral}, or train on a dataset with --data")))
        }
    }
}

type Loop<'a> = Box<dyn FnOnce(&mut Control<'_>) -> Result<OnlineSummary> + 'a>;

/// Prepares a new run, or continues the run in `out`.
fn start<'a, M: Agent>(
    config: &'a TrainConfig<M>,
    online: &'a OnlineConfig,
    pool: EnvPool,
    evaluation_pool: EnvPool,
    out: &'a Path,
    options: &'a TrainOptions,
) -> Result<Loop<'a>> {
    let spec = pool.spec().clone();
    let offered = pool.infos().schema().columns().iter().cloned().chain([spec.action_column()]);
    let offered = Schema::new(offered.collect::<Vec<_>>())?;
    let loader_config = M::loader_config(config, &offered)?;
    let columns = &loader_config.clip.columns;
    let dataset_info = DatasetInfo::from_env(&spec, columns)?;
    let recorded: Result<Vec<ColumnSpec>> = columns.iter().map(|name| offered.column(name).cloned()).collect();
    let recorded = Schema::new(recorded?)?;

    let mut manifest = learner::manifest(config, format!("played in {}", spec.id), &options.device);
    let burn = std::mem::replace(&mut manifest.libraries, pool.env(0).libraries());
    manifest.libraries.extend(burn);
    let resumed = Learner::resume(config, &dataset_info, &manifest, out, options)?;
    let saved = resumed.as_ref().map(|learner| saved_data(out, learner.state().step));
    let (data, memory) = Data::new(&config.loop_config(), online, loader_config, pool, &recorded, saved)?;
    let saved = resumed.as_ref().map(|learner| (learner.state().step, data.collector.steps));
    let learner = match resumed {
        Some(learner) => learner,
        None => Learner::start(config, dataset_info, manifest, &options.device)?,
    };
    let shared = SharedModel::new(learner.model().clone());
    let policy = |slots, explore| M::policy(config, learner.dataset_info(), shared.clone(), &spec, slots, explore);
    let run = Run {
        config: config.loop_config(),
        online,
        out,
        data,
        random: Box::new(RandomPolicy::new(&spec, online.envs)),
        explorer: policy(online.envs, true)?,
        evaluator: policy(evaluation_pool.len(), false)?,
        evaluation_pool,
        log: log::Log::new(out, learner.state().step)?,
        key: Key::new(config.seed).with("online"),
        memory,
        saved,
        learner: Box::new(OnlineLearner { learner, shared }),
    };
    Ok(Box::new(move |control| run.go(M::FAMILY, control)))
}

/// A learner of any family whose weights the policies share.
trait DynOnlineLearner {
    fn learner(&self) -> &dyn DynLearner;
    fn learner_mut(&mut self) -> &mut dyn DynLearner;
    /// Copies the present weights to the policies.
    fn publish(&self);
}

struct OnlineLearner<'a, M: Agent> {
    learner: Learner<'a, M>,
    shared: SharedModel<M>,
}

impl<M: Agent> DynOnlineLearner for OnlineLearner<'_, M> {
    fn learner(&self) -> &dyn DynLearner {
        &self.learner
    }

    fn learner_mut(&mut self) -> &mut dyn DynLearner {
        &mut self.learner
    }

    fn publish(&self) {
        self.shared.set(self.learner.model().clone());
    }
}

/// The source of batches: environments, replay buffer, and the loader that draws from the buffer.
struct Data {
    collector: Collector,
    replay: ReplayBuffer,
    loader: ReplayLoader,
}

/// A run in progress.
struct Run<'a> {
    config: LoopConfig,
    online: &'a OnlineConfig,
    out: &'a Path,
    learner: Box<dyn DynOnlineLearner + 'a>,
    data: Data,
    /// The policy of the warm-up.
    random: Box<dyn Policy>,
    /// The policy after the warm-up.
    explorer: Box<dyn AgentPolicy>,
    evaluation_pool: EnvPool,
    /// The policy of evaluations, which does not explore.
    evaluator: Box<dyn AgentPolicy>,
    log: log::Log,
    key: Key,
    /// What the explorer of an interrupted run remembered.
    memory: Vec<Vec<f32>>,
    /// The optimizer steps and the environment steps of the data in the folder of the run.
    saved: Option<(usize, usize)>,
}

/// Measurements of a run.
struct Meter {
    start: Instant,
    /// The optimizer step at which the run began or continued.
    first_step: usize,
    /// Seconds spent on interaction.
    interaction_seconds: f64,
    /// The mean return of the last evaluation.
    evaluated_return: Option<f64>,
}

impl Data {
    /// Creates the data of a new run, or restores the data that an earlier run saved in the folder `saved`. Also returns the
    /// memory of that run's policy.
    fn new(
        config: &LoopConfig,
        online: &OnlineConfig,
        loader_config: LoaderConfig,
        pool: EnvPool,
        schema: &Schema,
        saved: Option<PathBuf>,
    ) -> Result<(Self, Vec<Vec<f32>>)> {
        let replay = match &saved {
            Some(folder) => ReplayBuffer::restore(&*swm_data::open(folder.join(REPLAY))?, online.capacity)?,
            None => ReplayBuffer::new(schema, online.capacity)?,
        };
        let key = Key::new(config.seed).with("online").with("episode");
        let mut collector = Collector::new(pool, &replay, schema, online.segment, key)?;
        let mut memory = vec![];
        match &saved {
            Some(folder) => {
                let state = read_collector(folder)?;
                let run = folder.parent().unwrap_or(folder);
                resume::check_same_time_limit(run, state.max_steps, collector.max_episode_steps())?;
                collector.restore(&state)?;
                memory = state.memory;
            }
            None => collector.start()?,
        }
        let loader = replay.loader(ReplayConfig {
            clip: loader_config.clip,
            goals: loader_config.goals,
            batch_size: config.data.batch_size,
            seed: config.seed,
            threads: 0,
            ..ReplayConfig::default()
        })?;
        Ok((Self { collector, replay, loader }, memory))
    }
}

impl Run<'_> {
    fn go(mut self, family: &'static str, control: &mut Control<'_>) -> Result<OnlineSummary> {
        let steps = self.config.schedule.steps;
        control.emit(Event::Started(Stage { name: STAGE, subject: &[family], total: steps, unit: "steps" }));
        let mut meter = Meter::new(self.step());
        let (mut stop, mut warm) = (None, false);
        self.data.collector.begin_policy(&mut *self.random);
        while self.step() < steps {
            if let Err(error) = control.check() {
                stop = Some(error);
                break;
            }
            let learns = self.data.collector.steps >= self.online.warmup && self.data.replay.episodes() > 0;
            if learns && !warm {
                warm = true;
                self.data.collector.begin_policy(&mut *self.explorer);
                self.explorer.recall(&std::mem::take(&mut self.memory))?;
            }
            let start = Instant::now();
            self.data.collector.step(if warm { &mut *self.explorer } else { &mut *self.random })?;
            meter.interaction_seconds += start.elapsed().as_secs_f64();
            if !learns {
                continue;
            }
            for _ in 0..self.online.updates.min(steps - self.step()) {
                self.train_step(&mut meter, control)?;
            }
            self.learner.publish();
            let (done, save_every) = (self.step(), self.config.save_every);
            // Runs are saved between rounds only, because an interrupted round cannot be continued.
            let before = done - self.online.updates.min(done);
            if save_every > 0 && done / save_every > before / save_every && done < steps {
                self.save()?;
                control.emit(Event::Saved(self.out));
            }
        }
        let weights = self.save()?;
        control.emit(Event::Saved(self.out));
        let interrupted = match stop {
            None => false,
            Some(Error::Interrupted) => true,
            Some(error) => return Err(error),
        };
        if !interrupted {
            let metrics = meter.evaluated_return.map(|value| ("evaluation_return", value));
            control.emit(Event::Finished { stage: STAGE, metrics: metrics.as_slice() });
        }
        Ok(self.summary(weights, interrupted, &meter))
    }

    fn step(&self) -> usize {
        self.learner.learner().state().step
    }

    /// Makes one optimizer step, evaluates if an evaluation is due, and reports the metrics.
    fn train_step(&mut self, meter: &mut Meter, control: &mut Control<'_>) -> Result<()> {
        let Update { metrics, lr, gradient_norm } = self.update()?;
        self.learner.learner_mut().state_mut().window.add(&metrics, gradient_norm);
        let (done, steps) = (self.step(), self.config.schedule.steps);
        let elapsed = meter.start.elapsed().as_secs_f64();
        let clips_per_second = ((done - meter.first_step) * self.config.data.batch_size) as f64 / elapsed;
        if is_due(self.online.evaluate_every, done, steps) {
            meter.evaluated_return = Some(self.evaluate()?);
        }
        let env_steps = self.data.collector.steps as f64;
        let returns = &self.data.collector.returns;
        let collected_return = (!returns.is_empty()).then(|| ("return", mean(returns)));
        let interaction = meter.interaction_seconds / elapsed;
        let mut shown = metrics;
        shown.push(("env_steps", env_steps));
        shown.extend(collected_return);
        shown.extend(meter.evaluated_return.map(|value| ("evaluation_return", value)));
        shown.extend([("lr", lr), ("gradient_norm", gradient_norm)]);
        shown.extend([("clips_per_second", clips_per_second), ("data_wait", interaction)]);
        control.progress(Progress { stage: STAGE, done, total: steps, unit: "steps", metrics: &shown });
        if is_due(self.config.log_every, done, steps) {
            let (mut line, norm) = self.learner.learner_mut().state_mut().window.take();
            line.extend([("gradient_norm", norm), ("env_steps", env_steps)]);
            line.extend(collected_return);
            line.extend([("clips_per_second", clips_per_second), ("playing", interaction), ("seconds", elapsed)]);
            self.log.write(done, &line)?;
        }
        Ok(())
    }

    /// Draws a batch from the replay buffer, makes one optimizer step, and checks that loss and gradient are finite.
    fn update(&mut self) -> Result<Update> {
        let step = self.step() as u64;
        let batch = self.data.loader.sample(self.key.with("batch").at(step))?;
        let key = Key::new(self.config.seed).with("step").at(step);
        let learner = self.learner.learner_mut();
        let output = learner.loss_and_gradients(&batch, key, true)?;
        let loss = output.loss();
        let update = learner.update(output, key);
        if loss.is_finite() && update.gradient_norm.is_finite() {
            return Ok(update);
        }
        let what = format!("the loss or the gradient at training step {}", step + 1);
        let values = format!("{}, gradient norm {}", failed_batch::describe(&update.metrics), update.gradient_norm);
        let fix = "lower optim.lr; the last checkpoint, if any, is kept";
        let repair = "the environment returned NaN in these columns: correct it, and train again in another folder";
        Err(failed_batch::error(self.out, &batch, what, &values, repair, fix))
    }

    /// Evaluates the present weights, saves the weights of the best evaluation so far, and returns the mean return.
    fn evaluate(&mut self) -> Result<f64> {
        self.learner.publish();
        let episodes = self.online.evaluate_episodes;
        let key = self.key.with("evaluation");
        let returns = evaluation::returns(&mut self.evaluation_pool, &mut *self.evaluator, episodes, key)?;
        let mean = mean(&returns);
        let (lowest, highest) =
            returns.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &v| (low.min(v), high.max(v)));
        let line: Metrics = vec![
            ("evaluation/return", mean),
            ("evaluation/lowest", lowest),
            ("evaluation/highest", highest),
            ("env_steps", self.data.collector.steps as f64),
        ];
        self.log.write(self.step(), &line)?;
        // The run state stores a loss, for which lower is better, so the return is negated.
        self.learner.learner_mut().save_if_best(-mean, self.out)?;
        Ok(mean)
    }

    /// Saves the replay buffer and the collector, then the checkpoint, so that the data of every checkpoint
    /// exist. Data that the checkpoint in the folder has already stay, because a kill could come before they are written again.
    /// Returns the hash of the weights.
    fn save(&mut self) -> Result<String> {
        let folder = saved_data(self.out, self.step());
        let present = Some((self.step(), self.data.collector.steps));
        if self.saved != present {
            run_folder::remove_saved_data(&folder)?;
            std::fs::create_dir_all(&folder).map_err(|error| Error::io(&folder, "creating a folder", error))?;
            self.data.replay.save(folder.join(REPLAY), WriteOptions::default())?;
            let path = folder.join(COLLECTOR);
            let state = self.data.collector.state(self.explorer.memory());
            let text = json!(state).to_string();
            std::fs::write(&path, format!("{text}\n{}", manifest::hash(text.as_bytes())))
                .map_err(|error| Error::io(&path, "saving the state of the episodes", error))?;
        }
        let weights = self.learner.learner().save(self.out)?;
        self.saved = present;
        for path in run_folder::saved_data(self.out)?.into_iter().filter(|path| *path != folder) {
            run_folder::remove_saved_data(&path)?;
        }
        Ok(weights)
    }

    fn summary(self, weights: String, interrupted: bool, meter: &Meter) -> OnlineSummary {
        let seconds = meter.start.elapsed().as_secs_f64();
        let learner = self.learner.learner();
        OnlineSummary {
            checkpoint: self.out.to_owned(),
            weights,
            steps: learner.state().step,
            env_steps: self.data.collector.steps,
            interrupted,
            evaluated: meter.evaluated_return,
            best: learner.state().best.map(|(step, loss)| (step, -loss)),
            parameters: learner.parameter_count(),
            seconds,
            interaction: if seconds > 0.0 { meter.interaction_seconds / seconds } else { 0.0 },
        }
    }
}

impl Meter {
    fn new(first_step: usize) -> Self {
        Self { start: Instant::now(), first_step, interaction_seconds: 0.0, evaluated_return: None }
    }
}

/// Returns the folder with the replay buffer and the running episodes of an optimizer step.
fn saved_data(out: &Path, step: usize) -> PathBuf {
    out.join(format!("{PLAYED}{step}"))
}

/// The limit of the size of the file with the running episodes, in bytes.
const LARGEST_STATE: u64 = 1 << 30;

/// Reads the state of the running episodes, with its hash in the second line, which earlier programs did not write.
fn read_collector(folder: &Path) -> Result<CollectorState> {
    let path = folder.join(COLLECTOR);
    let damaged = |problem: String| Error::corrupt(&path, problem, "train again from the beginning");
    let bytes = files::read(&path, LARGEST_STATE)?;
    let mut lines = bytes.split(|byte| *byte == b'\n');
    let text = lines.next().unwrap_or_default();
    match lines.next() {
        Some(hash) if hash != manifest::hash(text).as_bytes() => Err(damaged("its hash differs".to_owned())),
        _ => serde_json::from_slice(text).map_err(|error| damaged(error.to_string())),
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}
