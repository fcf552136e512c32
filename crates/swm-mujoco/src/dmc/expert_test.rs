//! Plays scripted experts in tests.

use swm_core::{Action, Batch, EnvEntry, Key, ResetOptions, Schema};

/// Plays an episode of each seed with the first expert; returns the rewards of the last of `steps` steps.
pub fn last_rewards(entry: &EnvEntry, seeds: u64, steps: usize) -> Vec<f64> {
    let mut env = entry.env().expect("creating the environment");
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("creating the schema"), 1);
    let mut expert = (entry.experts[0].make)();
    let mut action = vec![0.0; env.spec().action_dim()];
    let play = |seed| {
        env.reset(seed, &ResetOptions::default()).expect("resetting the environment");
        expert.begin(Key::new(seed));
        let mut last = 0.0;
        for _ in 0..steps {
            env.observe(&mut row.row_mut(0));
            expert.act(row.row(0), &mut action).expect("choosing an action");
            let action: Vec<f32> = action.iter().map(|&value| value as f32).collect();
            last = env.step(Action::Continuous(&action)).expect("stepping the environment").reward;
        }
        last
    };
    (0..seeds).map(play).collect()
}
