//! The baseline that repeats the actions of the nearest recorded rows.

use crate::memory::{Memory, MemoryReader};
use crate::requesting::{TestResolver, request};
use swm_core::results::Run;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, Result, Results, Schema};
use swm_data::{Part, Split, Writer as _};
use swm_eval::{EvalRequest, HeldOut, PolicyKind, PolicyRequest, RunOptions, StartsRequest};

/// The length of an episode, from 0 to its goal, in steps.
const STEPS: usize = 4;

/// A dataset of episodes that start at 0 and move by these distances at every step.
fn moving(by: &[f64]) -> MemoryReader {
    let columns = vec![ColumnSpec::new("state", DType::Float64, [1]), ColumnSpec::new("action", DType::Float32, [1])];
    let schema = Schema::new(columns).expect("a schema");
    let mut memory = Memory::default();
    for by in by {
        let mut episode = Batch::zeros(&schema, STEPS + 1);
        for step in 0..=STEPS {
            let action = if step < STEPS { *by as f32 } else { f32::NAN };
            episode.row_mut(step).set(0, &[step as f64 * by]);
            episode.row_mut(step).set(1, &[action]);
        }
        memory.write_episode_with(&episode, &Default::default()).expect("writing to memory");
    }
    memory.reader()
}

/// Evaluates `nearest` and `replay` from every start of a dataset.
fn evaluate(data: &[f64], held_out: Option<HeldOut>, episodes: usize, envs: usize) -> Result<Results> {
    let kinds = [("nearest", PolicyKind::Nearest), ("replay", PolicyKind::Replay)];
    let conditions = request().conditions;
    let request = EvalRequest {
        policies: kinds.map(|(name, kind)| PolicyRequest { name: name.to_owned(), kind }).to_vec(),
        starts: StartsRequest::Dataset {
            dataset: "line".to_owned(),
            goal_offset: STEPS,
            held_out,
            one_per_episode: false,
        },
        conditions: conditions[..1].to_vec(),
        episodes,
        ..request()
    };
    let options = RunOptions { envs, threads: 2, ..RunOptions::default() };
    request.run(&TestResolver::of(moving(data)), &options, &mut Control::new())
}

fn successes(results: &Results) -> Vec<(&str, usize)> {
    results.runs[1..].iter().map(|run: &Run| (run.policy.as_str(), run.success.successes)).collect()
}

#[test]
fn the_episode_of_the_start_is_not_searched() {
    // The only other episode moves away from the goal; the start's own one, which replay repeats, reaches it.
    let found = evaluate(&[1.0, -1.0], None, 2, 2).expect("the evaluation succeeds");
    assert_eq!(successes(&found), [("nearest", 0), ("replay", 2)]);
    let error = evaluate(&[1.0], None, 1, 1).expect_err("there is no other episode");
    assert!(error.is_usage() && error.to_string().contains("collect more episodes"), "{error}");
}

#[test]
fn the_nearest_recorded_actions_are_repeated() {
    // Every episode has a neighbour with the same direction, whose goal is at most 0.2 away: as far as the goal counts as
    // reached.
    let data = [1.0, -1.0, 0.95, -0.95, 0.5, 0.45];
    let found = evaluate(&data, None, data.len(), 3).expect("the evaluation succeeds");
    assert_eq!(successes(&found), [("nearest", data.len()), ("replay", data.len())]);
    assert!(found.runs[1].episodes.iter().all(|episode| (3..=STEPS).contains(&episode.steps)));
    let other = evaluate(&data, None, data.len(), 1).expect("the evaluation succeeds");
    assert_eq!(found.runs[1].episodes, other.runs[1].episodes, "slots do not matter");
}

#[test]
fn held_out_starts_are_solved_by_the_train_part_only() {
    let split = Split { validation: 0.2, test: 0.3, seed: 1 };
    let held_out = HeldOut { part: Part::Test, split };
    let moves = |of_test: f64, of_train: f64| -> Vec<f64> {
        (0..30).map(|i| if split.part(i) == Part::Train { of_train } else { of_test }).collect()
    };
    let starts = (0..30).filter(|&i| split.part(i) == Part::Test).count();
    let solved = |data: &[f64]| {
        let found = evaluate(data, Some(held_out), starts, 4).expect("the evaluation succeeds");
        successes(&found)[0].1
    };
    assert!(starts > 3);
    assert_eq!([solved(&moves(1.0, -1.0)), solved(&moves(1.0, 1.0))], [0, starts]);
}

#[test]
fn starts_that_the_environment_draws_have_no_recordings() {
    let policies = vec![PolicyRequest { name: "nearest".to_owned(), kind: PolicyKind::Nearest }];
    let request = EvalRequest { policies, ..request() };
    let error = request.run(&TestResolver::new(), &RunOptions::default(), &mut Control::new());
    let error = error.expect_err("episodic starts");
    assert!(error.is_usage() && error.to_string().contains("take starts from a dataset"), "{error}");
}
