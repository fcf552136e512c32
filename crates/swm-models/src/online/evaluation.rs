//! Evaluation during online training: whole episodes without exploration, the same episodes in every evaluation.

use swm_core::columns::{REWARD, TERMINATED, TRUNCATED};
use swm_core::pool::Reset;
use swm_core::{Batch, EnvPool, Key, Policy, ResetOptions, Result, Schema};

/// Runs `episodes` episodes and returns the undiscounted returns in order. `key` and the index of an episode
/// determine the episode.
pub(super) fn returns(pool: &mut EnvPool, policy: &mut dyn Policy, episodes: usize, key: Key) -> Result<Vec<f64>> {
    let slots = pool.len();
    let mut actions = Batch::zeros(&Schema::new(vec![pool.spec().action_column()])?, slots);
    let mut returns = vec![0.0; episodes];
    // The episode that runs in each slot, if any.
    let mut running: Vec<Option<usize>> = vec![None; slots];
    let mut next = 0;
    loop {
        let mut resets = vec![];
        for (slot, running) in running.iter_mut().enumerate() {
            if running.is_none() && next < episodes {
                let key = key.at(next as u64);
                // Reset seeds do not use the highest bit.
                resets.push(Reset { slot, seed: key.seed() >> 1, options: ResetOptions::default() });
                policy.begin(slot, key);
                *running = Some(next);
                next += 1;
            }
        }
        if !resets.is_empty() {
            pool.reset(&resets)?;
        }
        let active: Vec<bool> = running.iter().map(Option::is_some).collect();
        if active.iter().all(|&active| !active) {
            return Ok(returns);
        }
        policy.observe_envs(pool, &active)?;
        policy.act(pool.infos(), &active, &mut actions)?;
        pool.step(&actions, &active)?;
        let infos = pool.infos();
        let (rewards, terminated, truncated) =
            (infos.get::<f32>(REWARD)?, infos.get::<u8>(TERMINATED)?, infos.get::<u8>(TRUNCATED)?);
        for (slot, running) in running.iter_mut().enumerate() {
            if let Some(episode) = *running {
                returns[episode] += f64::from(rewards[slot]);
                if terminated[slot] + truncated[slot] > 0 {
                    *running = None;
                }
            }
        }
    }
}
