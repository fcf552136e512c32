//! `bench envs`: environment steps per second of stepping, of stepping with rendering, and of collecting.

use crate::reference::{Reference, Size, not_compared, reference_python};
use serde::Serialize;
use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::pool::Reset;
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{
    Action, ColumnIndices, EnvChoice, Error, Key, RandomPolicy, ResetOptions, Result, Space, VariationRequest, limits,
};
use swm_data::{ImageCodec, WriteOptions, create};
use swm_eval::{CollectConfig, World, WorldConfig, episode_key, reset_seed};

/// Settings of the benchmark.
#[derive(Clone, Debug)]
pub struct BenchConfig {
    /// The number of environments that are stepped together.
    pub envs: usize,
    /// The side lengths of the square frames, in pixels.
    pub sizes: Vec<usize>,
    /// Whether to measure stepping without frames in addition to stepping with frames.
    pub bare: bool,
    /// The number of worker threads; 0 for the number of cores. The reference steps on one thread.
    pub threads: usize,
    /// The number of measurement pairs. A pair is one measurement of this implementation and one of the reference.
    pub pairs: usize,
    /// The duration of a measurement of stepping, in seconds.
    pub seconds: f64,
    /// The number of steps of an episode.
    pub episode_steps: usize,
    /// The number of episodes that the reference collects in a measurement; 0 skips collecting. This implementation
    /// collects `EPISODE_FACTOR` times as many episodes, so that both measurements are long enough.
    pub episodes: usize,
    /// The Python interpreter of the reference implementation, if any.
    pub python: Option<PathBuf>,
}

/// The number of episodes that this implementation collects for each episode of the reference, so that both
/// measurements take about the same time.
const EPISODE_FACTOR: usize = 32;

impl Default for BenchConfig {
    /// The settings of the reference's published rates: 8 environments at 224 pixels. The Python of the reference is
    /// the value of the environment variable [`REFERENCE_PYTHON`](crate::REFERENCE_PYTHON).
    fn default() -> Self {
        Self {
            envs: 8,
            sizes: vec![224],
            bare: true,
            threads: 0,
            pairs: 5,
            seconds: 1.0,
            episode_steps: 50,
            episodes: 8,
            python: reference_python(),
        }
    }
}

/// The result of the benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// The number of environments that are stepped together.
    pub envs: usize,
    /// The number of worker threads of this implementation.
    pub threads: usize,
    /// The version of the reference, or the reason why it is not compared.
    pub reference: String,
    /// One entry for each environment, frame size and kind of work.
    pub rows: Vec<BenchRow>,
}

/// The rate of one environment at one frame size and one kind of work.
#[derive(Clone, Debug, Serialize)]
pub struct BenchRow {
    /// The environment.
    pub env: String,
    /// The kind of work: `step` (without frames), `step, one thread` (a single environment), `step + render`, or
    /// `collect, CODEC` (to a Lance dataset).
    pub what: &'static str,
    /// The side length of the frames, in pixels; `None` without frames.
    pub size: Option<usize>,
    /// Environment steps per second in each measurement of this implementation.
    pub ours: Vec<f64>,
    /// Environment steps per second in each measurement of the reference; empty without a reference.
    pub reference: Vec<f64>,
    /// The median of `ours`.
    pub steps_per_second: f64,
    /// The median over measurement pairs of the rate of this implementation divided by the reference's rate.
    pub ratio: Option<f64>,
}

/// Measures stepping with rendering and collecting to Lance for every environment and size, and stepping without frames
/// for every environment.
///
/// # Errors
/// When a setting is invalid, an environment fails, `control` stops the run, or the reference fails after its start. A
/// reference that does not start is not an error: [`BenchReport::reference`] contains the reason.
#[allow(clippy::too_many_lines, reason = "the list of all measurements, in order")]
pub fn bench_envs(choices: &[EnvChoice], config: &BenchConfig, control: &mut Control<'_>) -> Result<BenchReport> {
    crate::check_measurements(config.pairs, config.seconds)?;
    for &size in &config.sizes {
        let sizes = [config.episodes, EPISODE_FACTOR, config.episode_steps, size, size, 3];
        limits::BENCHMARK_BYTES.check(limits::product(sizes))?;
    }
    let mut report = BenchReport {
        envs: config.envs,
        threads: swm_core::pool::threads(config.threads)?.current_num_threads(),
        reference: not_compared(),
        rows: vec![],
    };
    for env in choices {
        if config.bare {
            let mut reference = report.start_reference(env, 64, config);
            let mut ours = Ours::new(env, None, config)?;
            ours.step(config.seconds / 4.0, control)?;
            report.rows.push(BenchRow::measure(
                env,
                None,
                "step",
                config.pairs,
                |_, control| ours.step(config.seconds, control),
                reference.as_mut().map(|reference| |_| reference.bare(config.seconds)),
                control,
            )?);
            report.rows.push(BenchRow::measure(
                env,
                None,
                "step, one thread",
                config.pairs,
                |pair, control| single(env, pair as u64, config, control),
                reference.as_mut().map(|reference| |_| reference.bare(config.seconds)),
                control,
            )?);
        }
        for &size in &config.sizes {
            let mut reference = report.start_reference(env, size, config);
            let mut ours = Ours::new(env, Some(size), config)?;
            // The first measurements of this implementation and of the reference are warm-ups and are not counted.
            ours.step(config.seconds / 4.0, control)?;
            reference.as_mut().map(|reference| reference.step(config.seconds / 4.0)).transpose()?;
            report.rows.push(BenchRow::measure(
                env,
                Some(size),
                "step + render",
                config.pairs,
                |_, control| ours.step(config.seconds, control),
                reference.as_mut().map(|reference| |_| reference.step(config.seconds)),
                control,
            )?);
            if config.episodes == 0 {
                continue;
            }
            let folder = tempfile::tempdir().map_err(|e| Error::io("a temporary folder", "creating the folder", e))?;
            let path = |side: &str, pair: usize| folder.path().join(format!("{side}-{pair}.lance"));
            let collect = CollectConfig {
                episodes: config.episodes * EPISODE_FACTOR,
                policy: "random".into(),
                ..CollectConfig::default()
            };
            // The reference stores JPEG of quality 95; the default codec of this implementation is lossless.
            let codecs =
                [("qoi", "collect, qoi", ImageCodec::Qoi), ("jpeg", "collect, jpeg", ImageCodec::Jpeg { quality: 95 })];
            for (name, what, codec) in codecs {
                report.rows.push(BenchRow::measure(
                    env,
                    Some(size),
                    what,
                    config.pairs,
                    |pair, control| {
                        let config = CollectConfig { seed: pair as u64, ..collect.clone() };
                        ours.collect(&path(&format!("ours-{name}"), pair), codec, config, control)
                    },
                    reference.as_mut().map(|reference| {
                        |pair| {
                            let path = path(&format!("reference-{name}"), pair);
                            reference.collect(&path, config.episodes, pair as u64)
                        }
                    }),
                    control,
                )?);
            }
        }
    }
    Ok(report)
}

/// This implementation in the benchmark: a [`World`] and a random policy.
struct Ours {
    world: World,
    policy: RandomPolicy,
    active: Vec<bool>,
    /// The number of episodes started so far.
    episodes: usize,
    done: Vec<Reset>,
}

impl Ours {
    fn new(env: &EnvChoice, size: Option<usize>, config: &BenchConfig) -> Result<Self> {
        let mut world = World::new(
            env.clone(),
            WorldConfig {
                envs: config.envs,
                image: size.map(|size| (size, size)),
                views: vec![],
                max_episode_steps: Some(config.episode_steps),
                threads: config.threads,
            },
        )?;
        world.reset(0, &VariationRequest::default())?;
        let policy = RandomPolicy::new(world.spec(), config.envs);
        Ok(Self { world, policy, active: vec![true; config.envs], episodes: config.envs, done: vec![] })
    }

    /// Steps with random actions for about `seconds`; returns environment steps per second.
    fn step(&mut self, seconds: f64, control: &mut Control<'_>) -> Result<f64> {
        let columns = ColumnIndices::of(self.world.pool().infos().schema())?;
        let ended = [columns.terminated, columns.truncated];
        let begun = Instant::now();
        let mut steps = 0;
        let elapsed = loop {
            control.check()?;
            self.world.step(&mut self.policy, &self.active)?;
            steps += self.active.len();
            self.done.clear();
            for slot in 0..self.active.len() {
                let row = self.world.pool().infos().row(slot);
                if ended.iter().any(|&column| row.at::<u8>(column)[0] > 0) {
                    let seed = reset_seed(episode_key(0, self.episodes));
                    self.done.push(Reset { slot, seed, options: ResetOptions::default() });
                    self.episodes += 1;
                }
            }
            if !self.done.is_empty() {
                self.world.restart(&self.done)?;
            }
            let elapsed = begun.elapsed().as_secs_f64();
            if elapsed >= seconds {
                break elapsed;
            }
        };
        Ok(steps as f64 / elapsed)
    }

    /// Collects a Lance dataset, including the commit; returns environment steps per second.
    fn collect(
        &mut self,
        path: &Path,
        codec: ImageCodec,
        config: CollectConfig,
        control: &mut Control<'_>,
    ) -> Result<f64> {
        let begun = Instant::now();
        let manifest = Some(self.world.collect_manifest(&config));
        let options = WriteOptions { manifest, codec, ..Default::default() };
        let writer = create(path, &self.world.collect_schema(&config)?, options)?;
        let collected = self.world.collect(&mut self.policy, writer, &config, control)?;
        let rate = collected.steps as f64 / begun.elapsed().as_secs_f64();
        // The next measurement of stepping requires that every slot has a running episode.
        self.world.reset(0, &VariationRequest::default())?;
        Ok(rate)
    }
}

impl BenchReport {
    /// Starts the reference with a `World` of frames of `size` pixels. On failure, stores the reason and returns
    /// `None`.
    fn start_reference(&mut self, env: &EnvChoice, size: usize, config: &BenchConfig) -> Option<Reference> {
        let world_size =
            Size { env: &env.id(), envs: config.envs, image: (size, size), episode_steps: config.episode_steps };
        match Reference::start(config.python.as_ref()?, world_size) {
            Ok(started) => {
                self.reference.clone_from(&started.version);
                Some(started)
            }
            Err(error) => {
                self.reference = format!("not compared: {error}");
                None
            }
        }
    }
}

/// Environment steps per second of a single environment on this thread, without observations, with precomputed random
/// actions.
fn single(env: &EnvChoice, seed: u64, config: &BenchConfig, control: &mut Control<'_>) -> Result<f64> {
    const ACTIONS: usize = 4096;
    /// Steps between two readings of the clock.
    const ROUND: usize = 1000;
    let mut env = env.env()?;
    let space = env.spec().action_space.clone();
    let mut rng = Key::new(seed).with("bench").rng();
    let drawn: Vec<Vec<f64>> = (0..ACTIONS).map(|_| space.sample(&mut rng)).collect();
    let values: Vec<Vec<f32>> = drawn.iter().map(|action| action.iter().map(|&v| v as f32).collect()).collect();
    let choices: Vec<Vec<i64>> = drawn.iter().map(|action| action.iter().map(|&v| v as i64).collect()).collect();
    let continuous = matches!(space, Space::Box { .. });
    let (mut steps, mut episode, mut in_episode) = (0, 0, 0);
    env.reset(seed, &ResetOptions::default())?;
    let begun = Instant::now();
    loop {
        control.check()?;
        for i in 0..ROUND {
            let i = (steps + i) % ACTIONS;
            let action = if continuous { Action::Continuous(&values[i]) } else { Action::Discrete(&choices[i]) };
            in_episode += 1;
            if env.step(action)?.terminated || in_episode == config.episode_steps {
                episode += 1;
                in_episode = 0;
                env.reset(seed + episode, &ResetOptions::default())?;
            }
        }
        steps += ROUND;
        let elapsed = begun.elapsed().as_secs_f64();
        if elapsed >= config.seconds {
            return Ok(steps as f64 / elapsed);
        }
    }
}

impl BenchRow {
    /// Measures this implementation and the reference alternately; `ours` and `reference` receive the index of the
    /// measurement pair.
    fn measure(
        env: &EnvChoice,
        size: Option<usize>,
        what: &'static str,
        pairs: usize,
        mut ours: impl FnMut(usize, &mut Control<'_>) -> Result<f64>,
        mut reference: Option<impl FnMut(usize) -> Result<f64>>,
        control: &mut Control<'_>,
    ) -> Result<Self> {
        let (mut our_rates, mut their_rates) = (vec![], vec![]);
        for pair in 0..pairs {
            control.check()?;
            our_rates.push(ours(pair, control)?);
            if let Some(reference) = &mut reference {
                their_rates.push(reference(pair)?);
            }
        }
        let ratios: Vec<f64> = our_rates.iter().zip(&their_rates).map(|(ours, theirs)| ours / theirs).collect();
        Ok(Self {
            env: env.id(),
            what,
            size,
            steps_per_second: Summary::of(&our_rates).map_or(0.0, |summary| summary.median),
            ratio: Summary::of(&ratios).map(|ratios| ratios.median),
            ours: our_rates,
            reference: their_rates,
        })
    }
}

impl fmt::Display for BenchReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} environments, {} threads; reference: {}", self.envs, self.threads, self.reference)?;
        for row in &self.rows {
            let size = row.size.map_or("-".to_owned(), |size| format!("{size} px"));
            write!(f, "{:<20} {:<18} {size:>7} {:>10.0} steps/s", row.env, row.what, row.steps_per_second)?;
            match row.ratio {
                Some(ratio) => writeln!(f, " {ratio:>8.1} x the reference (median of {})", row.ours.len())?,
                None => writeln!(f)?,
            }
        }
        Ok(())
    }
}
