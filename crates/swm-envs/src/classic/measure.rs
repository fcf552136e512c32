//! What the experts' READMEs report.

use swm_core::{Action, Batch, EnvEntry, Key, ResetOptions, Schema, Space, VariationRequest};

/// Episodes of seeds 0 to 199.
#[derive(Debug, Default)]
pub struct Tally {
    /// In how many the goal was reached.
    pub successes: usize,
    /// Steps until then, the shortest first.
    pub steps: Vec<usize>,
    /// All rewards.
    pub reward: f64,
}

/// Lets the first expert play 200 episodes of full length or until they terminate, with the default factors or with all
/// varied, towards the goal of the reset or one of `sample_goal`.
#[allow(clippy::cast_possible_truncation)]
pub fn tally(entry: &EnvEntry, all: bool, sampled: bool) -> Tally {
    let variation = VariationRequest { variation: all.then(|| vec!["all".to_owned()]), ..VariationRequest::default() };
    let options = ResetOptions { variation, ..ResetOptions::default() };
    let (mut env, mut expert) = (entry.env().expect("an environment"), (entry.experts[0].make)());
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("columns"), 1);
    let mut tally = Tally::default();
    for seed in 0..200 {
        env.reset(seed, &options).expect("a reset");
        if sampled {
            env.sample_goal(Key::new(seed)).expect("a goal");
        }
        expert.begin(Key::new(seed));
        let mut reached = None;
        for step in 1..=env.spec().max_episode_steps {
            let mut action = [0.0];
            env.observe(&mut row.row_mut(0));
            expert.act(row.row(0), &mut action).expect("an action");
            let transition = match env.spec().action_space {
                Space::Box { .. } => env.step(Action::Continuous(&action.map(|v| v as f32))),
                _ => env.step(Action::Discrete(&action.map(|v| v as i64))),
            };
            let transition = transition.expect("a step");
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
