//! Pictures a second on one thread, in one world after the other, and steps with a picture each: `render_speed RENDERER SIZE SECONDS
//! ENV…`, for profilers. But for OpenGL, which draws on threads of its own, the time is the thread's, so that it holds on a busy
//! machine.

use std::time::{Duration, Instant};
use swm_core::{Action, FrameMut, ResetOptions};
use swm_mujoco::ENVS;
use swm_mujoco::render;

/// How long this thread has been running.
fn busy() -> Duration {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    Duration::from_nanos(text.split(' ').next().and_then(|first| first.parse().ok()).unwrap_or(0))
}

#[allow(clippy::print_stdout, reason = "what it is for")]
fn main() -> swm_core::Result<()> {
    let words: Vec<String> = std::env::args().skip(1).collect();
    let [renderer, size, seconds, envs @ ..] = &words[..] else {
        println!("render_speed auto|cpu|egl SIZE SECONDS ENV…");
        return Ok(());
    };
    render::choose(renderer.parse()?);
    let (size, seconds) = (size.parse().unwrap_or(64), seconds.parse().unwrap_or(1.0));
    for env in envs {
        let mut world = ENVS.choose(env)?.env()?;
        world.reset(0, &ResetOptions::default())?;
        let mut rgb = vec![0; size * size * 3];
        let still = vec![0.1; world.spec().action_dim()];
        world.render(FrameMut::new(size, size, &mut rgb))?;
        let (begun, mut spent, mut stepping, mut count) = (Instant::now(), Duration::ZERO, Duration::ZERO, 0);
        while begun.elapsed().as_secs_f64() < seconds {
            let before = busy();
            world.step(Action::Continuous(&still))?;
            stepping += busy() - before;
            let (before, clock) = (busy(), Instant::now());
            world.render(FrameMut::new(size, size, &mut rgb))?;
            spent += if renderer == "egl" { clock.elapsed() } else { busy() - before };
            count += 1;
        }
        let speed = |time: Duration| f64::from(count) / time.as_secs_f64();
        let name = render::name()?;
        println!("{env} {size} {name}: {:.0} pictures/s, {:.0} steps/s", speed(spent), speed(spent + stepping));
    }
    Ok(())
}
