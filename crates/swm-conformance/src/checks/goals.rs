//! Checks of sampled goals and goal distances.

use super::experts::follow_expert;
use super::probe::{Probe, all_varied, frame_difference};
use crate::Suite;
use swm_core::columns::{GOAL_STATE, STATE};
use swm_core::{Batch, ColumnSpec, DType, Key, ResetOptions, Schema};

/// Checks that a sampled goal is not reached yet, depends on the key only, and matches the goal frame, and that the
/// goal state is a success.
pub fn sampled_goals_are_not_reached_yet_and_goal_states_succeed(suite: &Suite) {
    for entry in suite.rows {
        let mut distinct = 0;
        for seed in 0..suite.goals {
            let options = if seed % 2 == 0 { ResetOptions::default() } else { all_varied() };
            let mut probe = Probe::reset(suite, entry, seed, &options);
            let (id, key) = (entry.id, Key::new(seed).with("goal"));
            let (state, snapshot) = (probe.column(STATE), probe.env.snapshot());
            probe.env.sample_goal(key).unwrap_or_else(|error| panic!("{id}, seed {seed}: {error}"));
            assert_eq!(probe.column(STATE), state, "{id}: sampling a goal changes the state");
            assert!(!probe.env.is_success(), "{id}, seed {seed}: the goal is reached at once");
            assert!(probe.env.snapshot() != snapshot, "{id}: the snapshot lacks the goal");
            let goal = probe.column(GOAL_STATE);
            probe.env.sample_goal(key).expect("sampling a goal with the same key");
            assert_eq!(probe.column(GOAL_STATE), goal, "{id}: one key gives two goals");
            let goal_frame = probe.goal_frame();
            probe.env.sample_goal(key.at(1)).expect("sampling a goal with another key");
            distinct += u64::from(probe.column(GOAL_STATE) != goal);

            // The goal state is a success after a reset and after a restore, and its frame equals the goal frame.
            let options = ResetOptions { state: Some(goal.clone()), goal_state: Some(goal.clone()), ..options };
            let mut at_goal = Probe::reset(suite, entry, seed, &options);
            assert!(at_goal.env.is_success(), "{id}, seed {seed}: a reset to the goal does not succeed");
            let schema =
                Schema::new([ColumnSpec::new(STATE, DType::Float64, [goal.len()])]).expect("creating the schema");
            let mut row = Batch::zeros(&schema, 1);
            row.get_mut(STATE).expect("accessing the state").copy_from_slice(&goal);
            at_goal.env.restore_from(row.row(0), row.row(0)).expect("restoring the row");
            assert!(at_goal.env.is_success(), "{id}, seed {seed}: a restore to the goal does not succeed");
            let difference = frame_difference(&at_goal.frame(), &goal_frame);
            assert!(difference < 1.0, "{id}, seed {seed}: the goal frame differs by {difference} of 255");
        }
        let goals = suite.goals;
        assert!(distinct * 20 >= goals * 19, "{}: only {distinct} of {goals} keys give different goals", entry.id);
    }
}

/// Checks that the goal distance is positive at the start, near 0 at the goal, and smaller than at the start after an
/// expert reached the goal.
pub fn goal_distance_decreases_to_the_goal(suite: &Suite) {
    for entry in suite.rows {
        let seeks_goals = entry.experts.first().is_some_and(|expert| expert.tasks.is_empty());
        let mut reached = 0;
        for seed in 0..6.min(suite.goals) {
            let (id, key) = (entry.id, Key::new(seed).with("goal"));
            let options = if seed < 4 { ResetOptions::default() } else { all_varied() };
            let mut probe = Probe::reset(suite, entry, seed, &options);
            probe.env.sample_goal(key).unwrap_or_else(|error| panic!("{id}, seed {seed}: {error}"));
            let before = probe.env.goal_distance();
            assert!(before.is_finite() && before > 0.0, "{id}, seed {seed}: distance {before} to a goal not reached");
            let goal = probe.column(GOAL_STATE);
            let options = ResetOptions { state: Some(goal.clone()), goal_state: Some(goal), ..options };
            let at_goal = Probe::reset(suite, entry, seed, &options).env.goal_distance();
            assert!(
                (0.0..=0.05 * before).contains(&at_goal),
                "{id}, seed {seed}: distance {at_goal} at the goal, {before} at the start"
            );
            if seeks_goals && follow_expert(entry, &mut probe, seed) {
                reached += 1;
                let after = probe.env.goal_distance();
                assert!(
                    after < before,
                    "{id}, seed {seed}: distance {after} after the expert reached the goal, {before} at the start"
                );
            }
        }
        assert!(reached > 0 || !seeks_goals, "{}: the expert reaches no goal", entry.id);
    }
}
