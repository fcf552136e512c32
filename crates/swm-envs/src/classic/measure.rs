//! Measures the success counts of experts that the READMEs report.

use swm_core::{Action, Batch, EnvEntry, Key, ResetOptions, Schema, Space, VariationRequest};

/// The results of the episodes of seeds 0 to 199.
#[derive(Debug, Default)]
pub struct Tally {
    /// Episodes in which the goal was reached.
    pub successes: usize,
    /// Steps until the goal was reached, ascending.
    pub steps: Vec<usize>,
    /// The sum of all rewards.
    pub reward: f64,
}

/// Plays 200 episodes with the first expert, each until it terminates or is truncated. `all` varies all factors. The
/// goal is drawn by `sample_goal` if `sampled` is set, otherwise by the reset.
pub fn tally(entry: &EnvEntry, all: bool, sampled: bool) -> Tally {
    let variation = VariationRequest { variation: all.then(|| vec!["all".to_owned()]), ..VariationRequest::default() };
    let options = ResetOptions { variation, ..ResetOptions::default() };
    let (mut env, mut expert) = (entry.env().expect("creating the environment"), (entry.experts[0].make)());
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("the schema of the columns"), 1);
    let mut tally = Tally::default();
    for seed in 0..200 {
        env.reset(seed, &options).expect("resetting the environment");
        if sampled {
            env.sample_goal(Key::new(seed)).expect("sampling a goal");
        }
        expert.begin(Key::new(seed));
        let mut reached = None;
        for step in 1..=env.spec().max_episode_steps {
            let mut action = [0.0];
            env.observe(&mut row.row_mut(0));
            expert.act(row.row(0), &mut action).expect("the expert's action");
            let transition = match env.spec().action_space {
                Space::Box { .. } => env.step(Action::Continuous(&action.map(|v| v as f32))),
                _ => env.step(Action::Discrete(&action.map(|v| v as i64))),
            };
            let transition = transition.expect("stepping the environment");
            tally.reward += transition.reward;
            if reached.is_none() && env.is_success() {
                reached = Some(step);
            }
            if transition.terminated {
                break;
            }
        }
        tally.successes += usize::from(reached.is_some());
        tally.steps.extend(reached);
    }
    tally.steps.sort_unstable();
    tally
}
