//! `bench render`: frames per second of one environment, by environment, size and renderer.
//!
//! Measurements of the renderers alternate within one run, and the report contains the median for each renderer. The
//! environment steps between two frames; the time of the step is not counted.

use serde::Serialize;
use std::time::{Duration, Instant};
use swm_core::results::Summary;
use swm_core::run::Control;
use swm_core::{Action, Env, EnvChoice, FrameMut, Key, ResetOptions, Result, Space, thread_budget};
use swm_eval::episode_key;

/// Settings of the benchmark.
#[derive(Clone, Debug)]
pub struct RenderBenchConfig {
    /// The side lengths of the square frames, in pixels.
    pub sizes: Vec<usize>,
    /// The number of measurements of every renderer.
    pub turns: usize,
    /// The duration of a measurement, in seconds.
    pub seconds: f64,
    /// The number of threads that may render one frame together.
    pub threads: usize,
}

impl Default for RenderBenchConfig {
    fn default() -> Self {
        Self { sizes: vec![64, 224], turns: 5, seconds: 0.5, threads: 1 }
    }
}

/// A renderer: a function that calls the given closure, whose frames are rendered by this renderer.
pub type Drawing<'a> = dyn Fn(&mut dyn FnMut() -> Result<()>) -> Result<()> + 'a;

/// The rate of one renderer in one environment at one frame size.
#[derive(Clone, Debug, Serialize)]
pub struct RenderRow {
    /// The environment.
    pub env: String,
    /// The side length of the frames, in pixels.
    pub size: usize,
    /// The renderer.
    pub renderer: String,
    /// The number of threads that may render one frame together.
    pub threads: usize,
    /// Frames per second, the median over measurements.
    #[serde(rename = "pictures_per_second")]
    pub frames_per_second: f64,
}

/// Measures environments with every renderer.
///
/// # Errors
/// When an environment cannot be created, fails, or does not render, or `control` stops the run.
pub fn bench_render(
    envs: &[EnvChoice],
    renderers: &[(String, &Drawing<'_>)],
    config: &RenderBenchConfig,
    control: &mut Control<'_>,
) -> Result<Vec<RenderRow>> {
    let mut rows = vec![];
    for choice in envs {
        let mut env = choice.env()?;
        let space = env.spec().action_space.clone();
        for &size in &config.sizes {
            let mut rgb = vec![0; 3 * size * size];
            let mut speeds = vec![vec![]; renderers.len()];
            for measurement in 0..config.turns.max(1) {
                for ((_, draw), speeds) in renderers.iter().zip(&mut speeds) {
                    let seed = episode_key(0, measurement).seed() >> 1;
                    env.reset(seed, &ResetOptions::default())?;
                    let (mut spent, mut frames, mut step) = (Duration::ZERO, 0u32, 0);
                    // The first frame fills caches, so its time is not counted.
                    let mut render = |env: &mut dyn Env| {
                        let mut frame = || env.render(FrameMut::new(size, size, &mut rgb));
                        thread_budget::with(config.threads, || draw(&mut frame))
                    };
                    render(&mut *env)?;
                    let begun = Instant::now();
                    while begun.elapsed().as_secs_f64() < config.seconds {
                        control.check()?;
                        act(&mut *env, &space, step)?;
                        step += 1;
                        let before = Instant::now();
                        render(&mut *env)?;
                        spent += before.elapsed();
                        frames += 1;
                    }
                    speeds.push(f64::from(frames) / spent.as_secs_f64().max(1e-9));
                }
            }
            for ((renderer, _), speeds) in renderers.iter().zip(&speeds) {
                let median = Summary::of(speeds).map_or(0.0, |summary| summary.median);
                rows.push(RenderRow {
                    env: choice.id(),
                    size,
                    renderer: renderer.clone(),
                    threads: config.threads,
                    frames_per_second: median,
                });
            }
        }
    }
    Ok(rows)
}

/// Steps the environment with a random action, and resets it at the end of an episode.
fn act(env: &mut dyn Env, space: &Space, step: u64) -> Result<()> {
    let drawn = space.sample(&mut Key::new(1).at(step).rng());
    let values: Vec<f32> = drawn.iter().map(|&x| x as f32).collect();
    let choices: Vec<i64> = drawn.iter().map(|&x| x as i64).collect();
    let continuous = matches!(space, Space::Box { .. });
    let taken = env.step(if continuous { Action::Continuous(&values) } else { Action::Discrete(&choices) })?;
    if taken.terminated {
        env.reset(step, &ResetOptions::default())?;
    }
    Ok(())
}
