//! Evaluations: whole episodes without exploration, always the same ones.

use swm_core::pool::Reset;
use swm_core::{Batch, EnvPool, Key, Policy, ResetOptions, Result, Schema};

/// The returns of `episodes` episodes, in their order. Each is decided by `key` and its number.
pub(super) fn returns(pool: &mut EnvPool, policy: &mut dyn Policy, episodes: usize, key: Key) -> Result<Vec<f64>> {
    let slots = pool.len();
    let mut actions = Batch::zeros(&Schema::new(vec![pool.spec().action_column()])?, slots);
    let mut returns = vec![0.0; episodes];
    // The episode of every slot, while it has one.
    let mut playing: Vec<Option<usize>> = vec![None; slots];
    let mut next = 0;
    loop {
        let mut resets = vec![];
        for (slot, playing) in playing.iter_mut().enumerate() {
            if playing.is_none() && next < episodes {
                let key = key.at(next as u64);
                // The highest bit is left out, as in evaluations elsewhere.
                resets.push(Reset { slot, seed: key.seed() >> 1, options: ResetOptions::default() });
                policy.begin(slot, key);
                *playing = Some(next);
                next += 1;
            }
        }
        if !resets.is_empty() {
            pool.reset(&resets)?;
        }
        let active: Vec<bool> = playing.iter().map(Option::is_some).collect();
        if active.iter().all(|&active| !active) {
            return Ok(returns);
        }
        policy.observe_envs(pool, &active)?;
        policy.act(pool.infos(), &active, &mut actions)?;
        pool.step(&actions, &active)?;
        let infos = pool.infos();
        let (rewards, terminated, truncated) =
            (infos.get::<f32>("reward")?, infos.get::<u8>("terminated")?, infos.get::<u8>("truncated")?);
        for (slot, playing) in playing.iter_mut().enumerate() {
            if let Some(episode) = *playing {
                returns[episode] += f64::from(rewards[slot]);
                if terminated[slot] + truncated[slot] > 0 {
                    *playing = None;
                }
            }
        }
    }
}
