//! `mode=play` of the tables: one goal after another, the same from a restored state.

use swm_core::{Action, Batch, Env, Key, ResetOptions, Schema};
use swm_mujoco::ENVS;

/// Steps of an episode.
const STEPS: usize = 400;

/// The step at which each new goal appears and its position, for an expert by id; `before` is called before each step.
fn goals(expert: &str, mut before: impl FnMut(&mut dyn Env, usize)) -> Vec<(usize, Vec<f64>)> {
    let choice = ENVS.choose("swm/OGBCube-v0,mode=play").unwrap();
    let mut env = choice.env().unwrap();
    let mut expert = (choice.entry.experts.iter().find(|entry| entry.id == expert).unwrap().make)();
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).unwrap(), 1);
    let mut action = vec![0.0; env.spec().action_dim()];
    env.reset(3, &ResetOptions::default()).unwrap();
    expert.begin(Key::new(3));
    let mut goals: Vec<(usize, Vec<f64>)> = vec![];
    for step in 0..STEPS {
        before(&mut *env, step);
        env.observe(&mut row.row_mut(0));
        let goal = row.row(0).to_f64("goal/block_pos").unwrap();
        if goals.last().is_none_or(|(_, last)| *last != goal) {
            goals.push((step, goal));
        }
        expert.act(row.row(0), &mut action).unwrap();
        let action: Vec<f32> = action.iter().map(|&value| value as f32).collect();
        assert!(!env.step(Action::Continuous(&action)).unwrap().terminated, "play does not end at a goal");
    }
    goals
}

#[test]
fn a_goal_follows_each_reached_one() {
    let fast = goals("expert", |_, _| {});
    let slow = goals("paper-speed", |_, _| {});
    println!("goals at steps: expert {fast:?}, paper-speed {slow:?}");
    assert!(slow.len() >= 4, "{slow:?}");
    assert!(fast.len() > slow.len(), "{fast:?}");
}

#[test]
fn a_restored_state_has_the_same_next_goals() {
    let straight = goals("paper-speed", |_, _| {});
    let restored = goals("paper-speed", |env, step| {
        if step % 7 == 0 {
            let snapshot = env.snapshot();
            env.step(Action::Continuous(&[1.0, -1.0, 1.0, 0.0, -1.0])).unwrap();
            env.restore(&snapshot).unwrap();
        }
    });
    assert_eq!(straight, restored);
}
