//! Trial episodes of experts, for the tests of point-agent environments.

use super::position::Position64;
use swm_core::{Action, Batch, EnvEntry, ExpertEntry, Key, ResetOptions, Schema, VariationRequest};

/// Plays one episode, towards a sampled goal if `sampled_goal` is set. Returns the positions that the agent visited,
/// and true if it reached the goal.
pub fn play(
    entry: &EnvEntry,
    expert: &ExpertEntry,
    seed: u64,
    options: &ResetOptions,
    sampled_goal: bool,
    steps: usize,
) -> (Vec<Position64>, bool) {
    let (mut env, mut expert) = (entry.env().expect("creating the environment"), (expert.make)());
    env.reset(seed, options).expect("resetting the environment");
    if sampled_goal {
        env.sample_goal(Key::new(seed)).expect("sampling a goal");
    }
    expert.begin(Key::new(seed));
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("the schema of the columns"), 1);
    let (mut action, mut positions) = ([0.0; 2], vec![]);
    for _ in 0..steps {
        env.observe(&mut row.row_mut(0));
        expert.act(row.row(0), &mut action).expect("the expert's action");
        let state = row.row(0).to_f64("state").expect("reading the state");
        positions.push([state[0], state[1]]);
        let action = action.map(|a| a as f32);
        if env.step(Action::Continuous(&action)).expect("stepping the environment").terminated {
            return (positions, true);
        }
    }
    (positions, false)
}

/// Plays the first expert over seeds 0 to 199 and asserts that it reaches every goal within `steps` with the default
/// variation, and every sampled goal within `varied_steps` with all factors varied. Returns the number of
/// goals of the reset that it reaches with all factors varied.
pub fn reached_of_200(entry: &EnvEntry, steps: usize, varied_steps: usize) -> u32 {
    let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let all = ResetOptions { variation: all, ..ResetOptions::default() };
    let mut reached = 0;
    for seed in 0..200 {
        let reaches =
            |options: &ResetOptions, sampled, steps| play(entry, &entry.experts[0], seed, options, sampled, steps).1;
        assert!(reaches(&ResetOptions::default(), false, steps), "seed {seed}");
        assert!(reaches(&ResetOptions::default(), true, steps), "seed {seed}, sampled goal");
        assert!(reaches(&all, true, varied_steps), "seed {seed}, all factors varied, sampled goal");
        reached += u32::from(reaches(&all, false, varied_steps));
    }
    reached
}
