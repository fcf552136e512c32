//! Speed of DeepMind Control environments compared with MuJoCo's `mj_step` alone on the same states and controls, and
//! of four environments in a pool on two threads: `cargo run --release -p swm-mujoco --example dmc_speed`.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use std::sync::Arc;
use std::time::{Duration, Instant};
use swm_core::policy::{Policy, RandomPolicy};
use swm_core::pool::{EnvPool, Reset, threads};
use swm_core::{Action, Batch, Key, ResetOptions, Schema};
use swm_mujoco::physics::{Physics, compile_file};
use swm_mujoco::{ENVS, assets};

/// The number of rounds. The fastest round counts, because other load on the machine only slows rounds.
const ROUNDS: usize = 15;

/// The CPU time of this thread, which does not include time spent waiting for other processes.
fn cpu_time() -> std::io::Result<Duration> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat")?;
    Ok(Duration::from_nanos(text.split(' ').next().and_then(|first| first.parse().ok()).unwrap_or(0)))
}

/// Environment ids, model files, steps per round, and physics time steps per step.
const TASKS: [(&str, &str, u32, u32); 2] =
    [("swm/CheetahDMControl-v0", "cheetah.xml", 10_000, 2), ("swm/HumanoidDMControl-v0", "humanoid.xml", 400, 10)];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let suite = assets::path("dm_control")?.join("dm_control/suite");
    for (id, file, steps, substeps) in TASKS {
        let entry = ENVS.get(id)?;
        let mut env = entry.env()?;
        let space = env.spec().action_space.clone();
        let actions: Vec<Vec<f32>> = (0..steps)
            .map(|t| space.sample(&mut Key::new(1).at(t.into()).rng()).iter().map(|&v| v as f32).collect())
            .collect();
        let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
        env.reset(0, &ResetOptions::default())?;
        env.observe(&mut row.row_mut(0));
        let (start, start_state) = (env.snapshot(), row.row(0).to_f64("state")?);

        let mut physics = Physics::new(Arc::new(compile_file(&suite.join(file))?))?;
        let [mut env_time, mut mujoco_time] = [Duration::MAX; 2];
        for _ in 0..ROUNDS {
            env.restore(&start)?;
            let clock = cpu_time()?;
            for action in &actions {
                env.step(Action::Continuous(action))?;
                env.observe(&mut row.row_mut(0));
            }
            env_time = env_time.min(cpu_time()? - clock);

            physics.set_state(&start_state[..physics.state_len()])?;
            let clock = cpu_time()?;
            for action in &actions {
                let data = physics.data_mut();
                data.ctrl_mut().iter_mut().zip(action).for_each(|(control, &action)| *control = f64::from(action));
                (0..substeps).for_each(|_| data.step());
            }
            mujoco_time = mujoco_time.min(cpu_time()? - clock);
        }
        let rate = |time: Duration| f64::from(steps) / time.as_secs_f64();
        let overhead = (env_time.as_secs_f64() / mujoco_time.as_secs_f64() - 1.0) * 100.0;
        println!(
            "{id}: {:.0} steps/s, mj_step alone {:.0}; {overhead:.1} % overhead",
            rate(env_time),
            rate(mujoco_time)
        );

        let envs = (0..4).map(|_| entry.env()).collect::<Result<Vec<_>, _>>()?;
        let mut pool = EnvPool::new(envs, None, Some(usize::MAX), threads(2)?)?;
        let mut policy = RandomPolicy::new(pool.spec(), 4);
        let resets: Vec<Reset> =
            (0..4).map(|slot| Reset { slot, seed: slot as u64, options: ResetOptions::default() }).collect();
        let (mut actions, active) = (Batch::zeros(&Schema::new([pool.spec().action_column()])?, 4), [true; 4]);
        let mut best = Duration::MAX;
        for _ in 0..ROUNDS {
            pool.reset(&resets)?;
            (0..4).for_each(|slot| policy.begin(slot, Key::new(slot as u64)));
            let clock = Instant::now();
            for _ in 0..steps {
                policy.act(pool.infos(), &active, &mut actions)?;
                pool.step(&actions, &active)?;
            }
            best = best.min(clock.elapsed());
        }
        println!("{id}: a pool of 4 on 2 threads, random actions: {:.0} steps/s", 4.0 * rate(best));
    }
    Ok(())
}
