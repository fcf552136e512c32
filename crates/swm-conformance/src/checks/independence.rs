//! Checks that results depend on seeds and actions only: not on threads, slots, other environments or earlier episodes.

use super::probe::{Probe, all_varied};
use crate::Suite;
use swm_core::pool::{Reset, threads};
use swm_core::{Batch, EnvEntry, EnvPool, Key, Policy, RandomPolicy, ResetOptions, Schema};

/// Plays episodes with random actions in a pool and returns all infos of each episode as bytes.
fn play(suite: &Suite, entry: &EnvEntry, episodes: &[u64], workers: usize, steps: usize) -> Vec<Vec<u8>> {
    let envs = episodes.iter().map(|_| entry.env().expect("creating the environment")).collect();
    let mut pool =
        EnvPool::new(envs, Some(suite.frame_size), Some(steps), threads(workers).expect("creating the thread pool"))
            .expect("creating the environment pool");
    let mut policy = RandomPolicy::new(pool.spec(), episodes.len());
    let mut actions =
        Batch::zeros(&Schema::new([pool.spec().action_column()]).expect("creating the schema"), episodes.len());
    let resets: Vec<Reset> = episodes
        .iter()
        .enumerate()
        .map(|(slot, &episode)| {
            policy.begin(slot, Key::new(episode));
            // Episodes with odd numbers vary all factors.
            let options = if episode % 2 == 0 { ResetOptions::default() } else { all_varied() };
            Reset { slot, seed: episode, options }
        })
        .collect();
    pool.reset(&resets).expect("resetting the environment");
    let mut recorded = vec![vec![]; episodes.len()];
    let mut record = |pool: &EnvPool| {
        for (slot, bytes) in recorded.iter_mut().enumerate() {
            for (column, spec) in pool.infos().schema().columns().iter().enumerate() {
                let n = spec.row_bytes();
                bytes.extend_from_slice(&pool.infos().bytes(column)[slot * n..(slot + 1) * n]);
            }
        }
    };
    record(&pool);
    for _ in 0..steps {
        let active = vec![true; episodes.len()];
        policy.act(pool.infos(), &active, &mut actions).expect("choosing random actions");
        pool.step(&actions, &active).expect("stepping the environment");
        record(&pool);
    }
    recorded
}

/// Checks that infos have the same bytes for any number of threads and in any slot.
pub fn results_are_independent_of_threads_and_slots(suite: &Suite) {
    for entry in suite.rows {
        let episodes = [0, 1, 2, 3, 4];
        let steps = usize::try_from(suite.steps).expect("a few steps");
        let one_thread = play(suite, entry, &episodes, 1, steps);
        assert!(one_thread == play(suite, entry, &episodes, 4, steps), "{}: four threads differ from one", entry.id);
        assert!(one_thread[0] != one_thread[2], "{}: two seeds give the same episode", entry.id);
        let reversed = play(suite, entry, &[4, 3, 2, 1, 0], 2, steps);
        for (i, &episode) in episodes.iter().enumerate() {
            assert!(
                one_thread[i] == play(suite, entry, &[episode], 1, steps)[0],
                "{}: episode {episode} differs when played alone",
                entry.id
            );
            assert!(one_thread[i] == reversed[4 - i], "{}: episode {episode} differs in another slot", entry.id);
        }
    }
}

/// Checks that environments that are stepped alternately, after earlier episodes, give the same results as new
/// environments.
pub fn environments_do_not_affect_each_other(suite: &Suite) {
    for entry in suite.rows {
        let key = Key::new(7);
        let new_env = |seed| {
            let mut probe = Probe::reset(suite, entry, seed, &all_varied());
            let mut outputs_after = |t| {
                probe.step(key, t);
                probe.all_outputs()
            };
            (0..6).map(&mut outputs_after).collect::<Vec<_>>()
        };
        let expected = [new_env(1), new_env(2)];
        // Both environments have played another episode before.
        let mut pair =
            [Probe::reset(suite, entry, 90, &all_varied()), Probe::reset(suite, entry, 91, &ResetOptions::default())];
        for (i, probe) in pair.iter_mut().enumerate() {
            (0..5).for_each(|t| {
                probe.step(key, 100 + t);
            });
            probe.frame();
            probe.env.reset(i as u64 + 1, &all_varied()).expect("resetting the environment");
        }
        for t in 0..6 {
            for (probe, expected) in pair.iter_mut().zip(&expected) {
                probe.step(key, t as u64);
                assert!(probe.all_outputs() == expected[t], "{}: step {t} differs", entry.id);
            }
        }
    }
}
