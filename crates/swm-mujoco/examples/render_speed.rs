//! Measures frames per second, and steps with a rendered frame per second, of several environments on one thread:
//! `render_speed RENDERER SIZE SECONDS ENV…`. Speeds are per CPU time of the thread; for OpenGL, which renders on other
//! threads, the elapsed time of rendering is measured.

use std::time::{Duration, Instant};
use swm_core::{Action, FrameMut, ResetOptions};
use swm_mujoco::ENVS;
use swm_mujoco::render;

/// The CPU time of this thread.
fn cpu_time() -> Duration {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    Duration::from_nanos(text.split(' ').next().and_then(|first| first.parse().ok()).unwrap_or(0))
}

#[allow(clippy::print_stdout, reason = "a command-line program")]
fn main() -> swm_core::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [renderer, size, seconds, ids @ ..] = &arguments[..] else {
        println!("render_speed auto|cpu|egl SIZE SECONDS ENV…");
        return Ok(());
    };
    render::choose(renderer.parse()?);
    let (size, seconds) = (size.parse().unwrap_or(64), seconds.parse().unwrap_or(1.0));
    for id in ids {
        let mut env = ENVS.choose(id)?.env()?;
        env.reset(0, &ResetOptions::default())?;
        let mut rgb = vec![0; size * size * 3];
        let action = vec![0.1; env.spec().action_dim()];
        env.render(FrameMut::new(size, size, &mut rgb))?;
        let (start, mut rendering, mut stepping, mut count) = (Instant::now(), Duration::ZERO, Duration::ZERO, 0);
        while start.elapsed().as_secs_f64() < seconds {
            let before = cpu_time();
            env.step(Action::Continuous(&action))?;
            stepping += cpu_time() - before;
            let (before, clock) = (cpu_time(), Instant::now());
            env.render(FrameMut::new(size, size, &mut rgb))?;
            rendering += if renderer == "egl" { clock.elapsed() } else { cpu_time() - before };
            count += 1;
        }
        let speed = |time: Duration| f64::from(count) / time.as_secs_f64();
        let name = render::name()?;
        println!("{id} {size} {name}: {:.0} frames/s, {:.0} steps/s", speed(rendering), speed(rendering + stepping));
    }
    Ok(())
}
