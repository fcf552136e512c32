//! `mode=play` of the tables: one goal after another, the same from a restored state.

use swm_core::{Action, Batch, Env, Key, ResetOptions, Result, Schema};
use swm_mujoco::ENVS;

/// Steps of an episode.
const STEPS: usize = 400;

/// The step at which each new goal appears and its position, for an expert by id; `before` is called before each step.
fn goals(expert: &str, mut before: impl FnMut(&mut dyn Env, usize) -> Result<()>) -> Result<Vec<(usize, Vec<f64>)>> {
    let choice = ENVS.choose("swm/OGBCube-v0,mode=play")?;
    let mut env = choice.env()?;
    let mut expert = (choice.entry.experts.iter().find(|entry| entry.id == expert).expect("the expert").make)();
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone())?, 1);
    let mut action = vec![0.0; env.spec().action_dim()];
    env.reset(3, &ResetOptions::default())?;
    expert.begin(Key::new(3));
    let mut goals: Vec<(usize, Vec<f64>)> = vec![];
    for step in 0..STEPS {
        before(&mut *env, step)?;
        env.observe(&mut row.row_mut(0));
        let goal = row.row(0).to_f64("goal/block_pos")?;
        if goals.last().is_none_or(|(_, last)| *last != goal) {
            goals.push((step, goal));
        }
        expert.act(row.row(0), &mut action)?;
        let action: Vec<f32> = action.iter().map(|&value| value as f32).collect();
        assert!(!env.step(Action::Continuous(&action))?.terminated, "play does not end at a goal");
    }
    Ok(goals)
}

#[test]
fn a_goal_follows_each_reached_one() -> Result<()> {
    let fast = goals("expert", |_, _| Ok(()))?;
    let slow = goals("paper-speed", |_, _| Ok(()))?;
    assert!(slow.len() >= 4, "{slow:?}");
    assert!(fast.len() > slow.len(), "{fast:?}");
    Ok(())
}

#[test]
fn a_restored_state_has_the_same_next_goals() -> Result<()> {
    let straight = goals("paper-speed", |_, _| Ok(()))?;
    let restored = goals("paper-speed", |env, step| {
        if step % 7 == 0 {
            let snapshot = env.snapshot();
            env.step(Action::Continuous(&[1.0, -1.0, 1.0, 0.0, -1.0]))?;
            env.restore(&snapshot)?;
        }
        Ok(())
    })?;
    assert_eq!(straight, restored);
    Ok(())
}
