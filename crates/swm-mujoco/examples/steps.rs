//! Steps and observes an environment, for a profile of instruction counts, which do not depend on the load of the
//! machine.
//!
//! ```text
//! cargo build --release -p swm-mujoco --example steps
//! valgrind --tool=callgrind --toggle-collect='*play*' --callgrind-out-file=OUT \
//!     target/release/examples/steps swm/CheetahDMControl-v0 200
//! callgrind_annotate --inclusive=yes OUT
//! ```
#![allow(clippy::print_stdout, reason = "a command-line program")]

use swm_core::{Action, Batch, Env, Key, ResetOptions, Result, Schema};
use swm_mujoco::ENVS;

/// The profiled function.
#[inline(never)]
fn play(env: &mut dyn Env, actions: &[Vec<f32>], row: &mut Batch) -> Result<f64> {
    let mut total = 0.0;
    for action in actions {
        total += env.step(Action::Continuous(action))?.reward;
        env.observe(&mut row.row_mut(0));
        total += f64::from(u8::from(env.is_success()));
    }
    Ok(total)
}

fn main() -> Result<()> {
    let id = std::env::args().nth(1).unwrap_or_else(|| "swm/CheetahDMControl-v0".to_owned());
    let steps: u64 = std::env::args().nth(2).and_then(|text| text.parse().ok()).unwrap_or(200);
    let mut env = ENVS.choose(&id)?.env()?;
    let space = env.spec().action_space.clone();
    let draw = |t| space.sample(&mut Key::new(1).at(t).rng()).iter().map(|&v| v as f32).collect();
    let actions: Vec<Vec<f32>> = (0..steps).map(draw).collect();
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
    env.reset(0, &ResetOptions::default())?;
    println!("{id}: {steps} steps, rewards and successes {:.3}", play(&mut *env, &actions, &mut row)?);
    Ok(())
}
