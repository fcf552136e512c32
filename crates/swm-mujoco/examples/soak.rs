//! Steps every environment in short episodes with all factors varied, and reports memory use: `soak [STEPS]`. The
//! steps (a million by default) are divided among the environments, which run in parallel pools.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use swm_core::policy::{Policy as _, RandomPolicy};
use swm_core::pool::{Reset, threads};
use swm_core::{Batch, EnvPool, Key, ResetOptions, Result, Schema, VariationRequest};
use swm_mujoco::ENVS;

/// The number of steps of an episode; each episode starts with new factors.
const EPISODE: usize = 25;
/// The number of environments in a pool.
const SLOTS: usize = 8;

fn main() -> Result<()> {
    let requested: usize = std::env::args().nth(1).and_then(|text| text.parse().ok()).unwrap_or(1_000_000);
    let workers = threads(std::thread::available_parallelism().map_or(1, usize::from))?;
    let steps_per_env = requested.div_ceil(ENVS.rows.len());
    let variation = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let mut total = 0;
    for entry in ENVS.rows {
        let envs = (0..SLOTS).map(|_| entry.env()).collect::<Result<Vec<_>>>()?;
        let mut pool = EnvPool::new(envs, None, Some(EPISODE), workers.clone())?;
        let mut policy = RandomPolicy::new(pool.spec(), SLOTS);
        let mut actions = Batch::zeros(&Schema::new([pool.spec().action_column()])?, SLOTS);
        let (mut steps, mut episode, mut unstable, mut early) = (0, 0, 0, 0);
        while steps < steps_per_env {
            let resets: Vec<Reset> = (0..SLOTS)
                .map(|slot| {
                    let options = ResetOptions { variation: variation.clone(), ..ResetOptions::default() };
                    Reset { slot, seed: episode + slot as u64, options }
                })
                .collect();
            resets.iter().for_each(|reset| policy.begin(reset.slot, Key::new(reset.seed)));
            episode += SLOTS as u64;
            pool.reset(&resets)?;
            let mut active = [true; SLOTS];
            for _ in 0..EPISODE {
                policy.act(pool.infos(), &active, &mut actions)?;
                pool.step(&actions, &active)?;
                steps += active.iter().filter(|&&active| active).count();
                for slot in (0..SLOTS).filter(|&slot| active[slot]) {
                    let row = pool.infos().row(slot);
                    for column in pool.infos().schema().columns() {
                        let value = row.to_f64(&column.name)?;
                        assert!(value.iter().all(|v| v.is_finite()), "{}: {} = {value:?}", entry.id, column.name);
                    }
                }
                for (slot, active) in active.iter_mut().enumerate().filter(|(_, active)| **active) {
                    let ended = |name: &str| pool.infos().row(slot).to_f64(name).is_ok_and(|value| value[0] != 0.0);
                    if ended("terminated") {
                        *active = false;
                        (early, unstable) = (early + 1, unstable + usize::from(ended("unstable")));
                    }
                }
            }
            if early == 0 && steps == SLOTS * EPISODE {
                println!("{}: {} MB after the first episodes", entry.id, resident());
            }
        }
        total += steps;
        println!(
            "{}: {steps} steps, {early} episodes ended early, {unstable} of them unstable, {} MB",
            entry.id,
            resident()
        );
    }
    println!("{total} steps");
    Ok(())
}

/// The resident memory of this process, in megabytes; 0 where the system does not report it.
fn resident() -> usize {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|line| line.split_whitespace().next()).and_then(|kb| kb.parse::<usize>().ok()).unwrap_or(0) / 1024
}
