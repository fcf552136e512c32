//! Checks of experts, and expert episodes for the checks of goals.

use super::probe::{Probe, all_varied};
use crate::Suite;
use swm_core::columns::ACTION;
use swm_core::policy::ExpertPolicy;
use swm_core::pool::{Reset, threads};
use swm_core::{Batch, EnvEntry, EnvPool, Key, Policy, Schema};

/// Plays one episode with the first expert and returns whether it reached the goal.
pub(super) fn follow_expert(entry: &EnvEntry, probe: &mut Probe, seed: u64) -> bool {
    let mut expert = (entry.experts[0].make)();
    expert.begin(Key::new(seed));
    let spec = probe.env.spec().clone();
    let mut action = vec![0.0; spec.action_dim()];
    (0..spec.max_episode_steps).any(|_| {
        expert.act(probe.observed().row(0), &mut action).expect("choosing an action");
        probe.act(&action);
        let distance = probe.env.goal_distance();
        assert!(distance.is_finite() && distance >= 0.0, "{}, seed {seed}: goal distance {distance}", entry.id);
        probe.env.is_success()
    })
}

/// Checks that actions of experts are in the action space and do not depend on other slots.
pub fn expert_actions_are_in_the_action_space_and_independent_of_other_slots(suite: &Suite) {
    for entry in suite.rows {
        for expert in entry.experts {
            let run = |slots: usize| {
                let envs = (0..slots).map(|_| entry.env().expect("creating the environment")).collect();
                let mut pool = EnvPool::new(envs, None, None, threads(2).expect("creating the thread pool"))
                    .expect("creating the environment pool");
                let spec = pool.spec().clone();
                let mut policy = ExpertPolicy::new(&spec, (0..slots).map(|_| (expert.make)()).collect());
                let mut actions =
                    Batch::zeros(&Schema::new([spec.action_column()]).expect("creating the schema"), slots);
                let mut taken = vec![];
                let resets: Vec<Reset> =
                    (0..slots).map(|slot| Reset { slot, seed: slot as u64, options: all_varied() }).collect();
                pool.reset(&resets).expect("resetting the environment");
                (0..slots).for_each(|slot| policy.begin(slot, Key::new(slot as u64)));
                for _ in 0..30 {
                    policy.act(pool.infos(), &vec![true; slots], &mut actions).expect("choosing an action");
                    for slot in 0..slots {
                        let action = actions.row(slot).to_f64(ACTION).expect("reading the actions");
                        let label = format!("{}, {}", entry.id, expert.id);
                        spec.action_space.check(&label, &action).unwrap_or_else(|error| panic!("{error}"));
                    }
                    taken.push(actions.row(0).to_f64(ACTION).expect("reading the actions"));
                    pool.step(&actions, &vec![true; slots]).expect("stepping the environment");
                }
                taken
            };
            assert_eq!(run(1), run(3), "{}, {}: actions depend on other slots", entry.id, expert.id);
        }
    }
}
