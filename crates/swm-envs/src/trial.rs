//! Trials of experts, for the tests of worlds in which a point goes from place to place.

use swm_core::{Action, Batch, EnvEntry, ExpertEntry, Key, ResetOptions, Schema, VariationRequest};

/// Plays one episode, towards a sampled goal where one is wanted; the places visited, and whether it ended in success.
pub(crate) fn play(
    entry: &EnvEntry,
    expert: &ExpertEntry,
    seed: u64,
    options: &ResetOptions,
    goal: bool,
    steps: usize,
) -> (Vec<[f64; 2]>, bool) {
    let (mut env, mut expert) = (entry.env().expect("an environment"), (expert.make)());
    env.reset(seed, options).expect("a reset");
    if goal {
        env.sample_goal(Key::new(seed)).expect("a goal");
    }
    expert.begin(Key::new(seed));
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("columns"), 1);
    let (mut action, mut places) = ([0.0; 2], vec![]);
    for _ in 0..steps {
        env.observe(&mut row.row_mut(0));
        expert.act(row.row(0), &mut action).expect("an action");
        let state = row.row(0).to_f64("state").expect("a state");
        places.push([state[0], state[1]]);
        #[allow(clippy::cast_possible_truncation)]
        let action = action.map(|a| a as f32);
        if env.step(Action::Continuous(&action)).expect("a step").terminated {
            return (places, true);
        }
    }
    (places, false)
}

/// Lets the expert try 200 seeds. It must reach every goal within `steps` where factors vary as usual, and every sampled one
/// within `patience` where all vary; returns how many goals it reaches that the reset chose with all factors varied.
pub(crate) fn reached_of_200(entry: &EnvEntry, steps: usize, patience: usize) -> u32 {
    let all = VariationRequest { variation: Some(vec!["all".to_owned()]), ..VariationRequest::default() };
    let all = ResetOptions { variation: all, ..ResetOptions::default() };
    let mut reached = 0;
    for seed in 0..200 {
        let reaches =
            |options: &ResetOptions, goal, steps| play(entry, &entry.experts[0], seed, options, goal, steps).1;
        assert!(reaches(&ResetOptions::default(), false, steps), "seed {seed}");
        assert!(reaches(&ResetOptions::default(), true, steps), "seed {seed}, sampled goal");
        assert!(reaches(&all, true, patience), "seed {seed}, everything varied, sampled goal");
        reached += u32::from(reaches(&all, false, patience));
    }
    reached
}
