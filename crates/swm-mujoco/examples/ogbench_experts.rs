//! Measures success rates of OGBench's experts: `ogbench_experts [SEEDS] [ID …]` runs SEEDS episodes (default 200) with
//! default factors and as many with all factors varied, towards the goals of resets and towards sampled goals.
#![allow(clippy::print_stdout, reason = "a command-line program")]

use swm_core::{Action, Batch, Key, ResetOptions, Result, Schema, VariationRequest};
use swm_mujoco::ENVS;

/// The environments that are measured if no ID is given.
const DEFAULT_IDS: [&str; 7] = [
    "swm/OGBCube-v0",
    "swm/OGBCube-v0,env_type=double",
    "swm/OGBCube-v0,env_type=triple",
    "swm/OGBCube-v0,env_type=quadruple",
    "swm/OGBCube-v0,env_type=octuple",
    "swm/OGBScene-v0",
    "swm/OGBMaze-v0",
];

/// Returns the sorted numbers of steps of the episodes that reach their goals.
fn trial(id: &str, varied: bool, sampled: bool, seeds: u64) -> Result<Vec<usize>> {
    let choice = ENVS.choose(id)?;
    let (mut env, mut expert) = (choice.env()?, (choice.entry.experts[0].make)());
    let variation = VariationRequest { variation: varied.then(|| vec!["all".to_owned()]), ..Default::default() };
    let options = ResetOptions { variation, ..ResetOptions::default() };
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
    let mut action = vec![0.0; env.spec().action_dim()];
    let mut steps = vec![];
    for seed in 0..seeds {
        env.reset(seed, &options)?;
        if sampled {
            env.sample_goal(Key::new(seed))?;
        }
        expert.begin(Key::new(seed));
        for step in 1..=env.spec().max_episode_steps {
            env.observe(&mut row.row_mut(0));
            expert.act(row.row(0), &mut action)?;
            let action: Vec<f32> = action.iter().map(|&value| value as f32).collect();
            env.step(Action::Continuous(&action))?;
            if env.is_success() {
                steps.push(step);
                break;
            }
        }
    }
    steps.sort_unstable();
    Ok(steps)
}

fn main() -> Result<()> {
    let mut ids: Vec<String> = std::env::args().skip(1).collect();
    let seeds = match ids.first().and_then(|first| first.parse().ok()) {
        Some(seeds) => {
            ids.remove(0);
            seeds
        }
        None => 200,
    };
    if ids.is_empty() {
        ids = DEFAULT_IDS.map(str::to_owned).to_vec();
    }
    for id in ids {
        for (varied, sampled) in [(false, false), (true, false), (false, true), (true, true)] {
            let steps = trial(&id, varied, sampled, seeds)?;
            let median = steps.get(steps.len() / 2).copied().unwrap_or(0);
            let (factors, goals) = (if varied { "all" } else { "default" }, if sampled { "sampled" } else { "reset" });
            println!("{id}: {factors} factors, {goals} goals: {} of {seeds}, median {median} steps", steps.len());
        }
    }
    Ok(())
}
