//! How many pictures a second worlds draw, by environment, size and renderer.
//!
//! One environment, on one thread unless more are asked for: what a core draws, or what one gets where there is but one environment.
//! Renderers take turns within one run, so that all meet the same machine, and
//! the median of the turns counts. The world takes a step between two pictures, whose time is not counted.

use serde::Serialize;
use std::time::{Duration, Instant};
use swm_core::results::Summary;
use swm_core::{Action, Env, EnvChoice, FrameMut, Key, ResetOptions, Result, Space, thread_budget};
use swm_eval::world::episode_key;

/// What to measure.
#[derive(Clone, Debug)]
pub struct RenderBenchConfig {
    /// Sides of the square pictures, in pixels.
    pub sizes: Vec<usize>,
    /// Turns of every renderer.
    pub turns: usize,
    /// Seconds of a turn.
    pub seconds: f64,
    /// Threads that a picture may be drawn on.
    pub threads: usize,
}

impl Default for RenderBenchConfig {
    fn default() -> Self {
        Self { sizes: vec![64, 224], turns: 5, seconds: 0.5, threads: 1 }
    }
}

/// A way to draw: runs what it is given so that pictures are drawn in this way.
pub type Drawing<'a> = dyn Fn(&mut dyn FnMut() -> Result<()>) -> Result<()> + 'a;

/// Pictures a second.
#[derive(Clone, Debug, Serialize)]
pub struct RenderRow {
    /// The environment.
    pub env: String,
    /// The side of the pictures.
    pub size: usize,
    /// What drew them.
    pub renderer: String,
    /// On so many threads.
    pub threads: usize,
    /// The median of the turns.
    pub pictures_per_second: f64,
}

/// Measures environments with every renderer.
///
/// # Errors
/// When an environment cannot be made, fails, or draws no pictures.
pub fn bench_render(
    envs: &[EnvChoice],
    renderers: &[(String, &Drawing<'_>)],
    config: &RenderBenchConfig,
) -> Result<Vec<RenderRow>> {
    let mut rows = vec![];
    for choice in envs {
        let mut env = choice.env()?;
        let space = env.spec().action_space.clone();
        for &size in &config.sizes {
            let mut rgb = vec![0; 3 * size * size];
            let mut speeds = vec![vec![]; renderers.len()];
            for turn in 0..config.turns.max(1) {
                for ((_, draw), speeds) in renderers.iter().zip(&mut speeds) {
                    let seed = episode_key(0, turn).seed() >> 1;
                    env.reset(seed, &ResetOptions::default())?;
                    let (mut spent, mut pictures, mut step) = (Duration::ZERO, 0u32, 0);
                    // The first picture prepares what is kept.
                    let mut picture = |env: &mut dyn Env| {
                        let mut drawn = || env.render(FrameMut::new(size, size, &mut rgb));
                        thread_budget::with(config.threads, || draw(&mut drawn))
                    };
                    picture(&mut *env)?;
                    let begun = Instant::now();
                    while begun.elapsed().as_secs_f64() < config.seconds {
                        act(&mut *env, &space, step)?;
                        step += 1;
                        let before = Instant::now();
                        picture(&mut *env)?;
                        spent += before.elapsed();
                        pictures += 1;
                    }
                    speeds.push(f64::from(pictures) / spent.as_secs_f64().max(1e-9));
                }
            }
            for ((renderer, _), speeds) in renderers.iter().zip(&speeds) {
                let median = Summary::of(speeds).map_or(0.0, |summary| summary.median);
                rows.push(RenderRow {
                    env: choice.id(),
                    size,
                    renderer: renderer.clone(),
                    threads: config.threads,
                    pictures_per_second: median,
                });
            }
        }
    }
    Ok(rows)
}

/// Takes a random step; begins again where an episode ends.
#[allow(clippy::cast_possible_truncation)]
fn act(env: &mut dyn Env, space: &Space, step: u64) -> Result<()> {
    let drawn = space.sample(&mut Key::new(1).at(step).rng());
    let numbers: Vec<f32> = drawn.iter().map(|&x| x as f32).collect();
    let choices: Vec<i64> = drawn.iter().map(|&x| x as i64).collect();
    let continuous = matches!(space, Space::Box { .. });
    let taken = env.step(if continuous { Action::Continuous(&numbers) } else { Action::Discrete(&choices) })?;
    if taken.terminated {
        env.reset(step, &ResetOptions::default())?;
    }
    Ok(())
}
