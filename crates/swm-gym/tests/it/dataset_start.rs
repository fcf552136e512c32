//! Tests of episodes that start at a row of a dataset.

use crate::play::{RecordedEnv, make};
use crate::robust::kill_process;
use crate::{config, id};
use swm_core::batch::{Batch, ColumnSpec, DType, Schema};
use swm_core::{
    Action, Callable, DatasetStart, Env, FrameMut, ResetOptions, Snapshot, VariationRequest, dataset_start,
};
use swm_gym::{GymEnv, WorkerTransport};

const FIELD: &str = "tests.it.environments:Field-v0";
const EAST: Action<'static> = Action::Continuous(&[0.5, 0.0]);

/// A start row and a goal row.
fn rows() -> Batch {
    let schema = Schema::new([
        ColumnSpec::new("state", DType::Float64, [3]),
        ColumnSpec::new("observation", DType::Float64, [2]),
        ColumnSpec::new("x", DType::Float32, []),
        ColumnSpec::new("variation_agent_size", DType::Float32, [1]),
        ColumnSpec::new("episode_seed", DType::Int32, [3]),
        ColumnSpec::image("pixels", 2, 2),
    ]);
    let mut rows = Batch::zeros(&schema.expect("creating the schema"), 2);
    for (row, x) in [(0, -0.3), (1, 1.2)] {
        let mut row = rows.row_mut(row);
        row.set(0, &[x, 0.25, 7.0]);
        row.set(1, &[x, 0.25]);
        row.set(2, &[x as f32]);
        row.set(3, &[1.5f32]);
        row.set(4, &[11, 0, 0]);
        row.set(5, &[if x > 0.0 { 200u8 } else { 3 }; 12]);
    }
    rows
}

fn calls(json: &str) -> Vec<Callable> {
    serde_json::from_str(json).expect("parsing the callables")
}

fn start(env: &mut dyn Env, options: &ResetOptions, callables: &[Callable]) -> swm_core::Result<()> {
    let rows = rows();
    dataset_start::required_columns(env, rows.schema(), callables)?;
    let from = DatasetStart { start: rows.row(0), goal: rows.row(1), callables };
    dataset_start::reset(env, 5, options, from)
}

#[test]
fn environment_with_setters_starts_at_the_recorded_state() {
    let Some(config) = config() else { return };
    let mut field = RecordedEnv::of(make(FIELD, &config));
    start(&mut *field.env, &ResetOptions::default(), &[]).expect("starting the episode at the dataset row");
    assert_eq!(field.column("state"), [-0.3, 0.25, 7.0]);
    assert_eq!(field.column("observation"), [-0.3, 0.25]);
    assert_eq!(field.column("goal_state"), [1.2, 0.25, 7.0]);
    assert_eq!(field.env.factors().scalar("agent.size"), 1.5, "the factors have the recorded values");
    assert!(!field.env.is_success() && field.env.goal_distance().is_infinite());
    let wind = field.column("wind");
    let frame = field.frame(16, 16);
    assert_eq!(frame[3 * (9 * 16 + 6)], 255, "the frame shows the recorded position");
    let mut goal = vec![0; 12];
    field.env.render_goal(FrameMut::new(2, 2, &mut goal)).expect("rendering the goal");
    assert_eq!(goal, [200; 12]);
    let transition = field.env.step(EAST).expect("stepping the environment");
    let state = field.column("state");
    assert!((state[0] - (-0.3 + 0.75 + wind[0])).abs() < 1e-12 && state[2] == 8.0, "{state:?}");
    assert!(!transition.terminated);
    assert_eq!(field.column("goal_state"), [1.2, 0.25, 7.0], "the goal stays after a step");
    // Values that are not part of the state follow from the seed of the recorded episode.
    let mut other = RecordedEnv::of(make(FIELD, &config));
    other.env.reset(11, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!(other.column("wind"), wind);
    // A plain reset discards the recorded state.
    field.env.reset(11, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!(field.column("goal_state"), other.column("goal_state"));
}

#[test]
fn start_with_requested_variation_takes_random_values_from_the_reset_seed() {
    let Some(config) = config() else { return };
    let mut field = RecordedEnv::of(make(FIELD, &config));
    let variation = VariationRequest { variation: Some(vec!["agent".to_owned()]), ..VariationRequest::default() };
    start(&mut *field.env, &ResetOptions { variation, ..ResetOptions::default() }, &[])
        .expect("starting the episode at the dataset row");
    let wind = field.column("wind");
    field.env.reset(5, &ResetOptions::default()).expect("resetting the environment");
    assert_eq!(field.column("wind"), wind);
}

#[test]
fn dataset_start_calls_the_methods_that_callables_name() {
    let Some(config) = config() else { return };
    let mut field = RecordedEnv::of(make(FIELD, &config));
    let place =
        r#"[{"method": "place", "args": {"x": {"value": "goal_x"}, "label": {"value": "abc", "in_dataset": false}}}]"#;
    start(&mut *field.env, &ResetOptions::default(), &calls(place)).expect("starting the episode at the dataset row");
    field.env.step(Action::Continuous(&[0.0, 0.0])).expect("stepping the environment");
    let (position, wind) = (field.column("observation"), field.column("wind"));
    assert!((position[0] - f64::from(1.2f32) - wind[0]).abs() < 1e-12 && position[1] == wind[1], "{position:?}");
    assert_eq!(field.column("set"), [3.0]);

    let mut wrong = |json: &str| {
        start(&mut *field.env, &ResetOptions::default(), &calls(json)).expect_err("an invalid callable").to_string()
    };
    let error = wrong(r#"[{"method": "set_place"}]"#);
    assert!(error.contains("Field has no method 'set_place'") && error.contains("place"), "{error}");
    let error = wrong(r#"[{"method": "place", "args": {"x": {"value": "goal_y"}}}]"#);
    assert!(error.contains("'goal_y'") && error.contains("state, observation, x"), "{error}");
    let error = wrong(r#"[{"method": "place", "args": {"x": {"value": 3}}}]"#);
    assert!(error.contains("a column's name"), "{error}");
    let error = wrong(r#"[{"method": "place", "args": {"z": {"value": "x"}}}]"#);
    assert!(error.contains("its reset raised") && error.contains("'z'"), "{error}");
    start(&mut *field.env, &ResetOptions::default(), &[]).expect("starting the episode after errors");
    let error = start(&mut *make("CartPole-v1", &config), &ResetOptions::default(), &[])
        .expect_err("an environment without a state setter")
        .to_string();
    assert!(error.contains("CartPole-v1") && error.contains("set_state(state)"), "{error}");
}

#[test]
fn environment_can_declare_the_method_that_sets_its_state() {
    let Some(config) = config() else { return };
    let mut declared = RecordedEnv::of(make("tests.it.environments:Declared-v0", &config));
    start(&mut *declared.env, &ResetOptions::default(), &[]).expect("starting the episode at the dataset row");
    declared.env.step(EAST).expect("stepping the environment");
    assert_eq!(declared.column("set"), [2.0]);
    // A `set_state` with other arguments is not used.
    let mut jointed = make("tests.it.environments:Jointed-v0", &config);
    let error =
        start(&mut *jointed, &ResetOptions::default(), &[]).expect_err("a setter with two arguments").to_string();
    assert!(error.contains("the environment has no method known to set a state"), "{error}");
}

#[test]
fn killed_worker_is_replayed_from_the_recorded_state() {
    let Some(config) = config() else { return };
    let run = |kill: Option<usize>| {
        let transport = WorkerTransport::new(&id(FIELD), config.clone()).expect("starting the worker");
        let id = transport.process_id().expect("the worker has a process id");
        let mut field =
            RecordedEnv::of(Box::new(GymEnv::new(FIELD, Box::new(transport), 2).expect("creating the environment")));
        start(&mut *field.env, &ResetOptions::default(), &[]).expect("starting the episode at the dataset row");
        let mut outputs = vec![field.all_outputs()];
        for t in 0..4 {
            if kill == Some(t) {
                kill_process(id);
            }
            field.env.step(EAST).expect("stepping the environment");
            outputs.push(field.all_outputs());
        }
        outputs
    };
    let expected = run(None);
    assert!(run(Some(0)) == expected && run(Some(2)) == expected);
}

#[test]
fn restored_snapshot_continues_from_the_dataset_start() {
    let Some(config) = config() else { return };
    let mut field = RecordedEnv::of(make(FIELD, &config));
    start(&mut *field.env, &ResetOptions::default(), &[]).expect("starting the episode at the dataset row");
    field.env.step(EAST).expect("stepping the environment");
    let snapshot = field.env.snapshot();
    let mut other = RecordedEnv::of(make(FIELD, &config));
    other.env.restore(&snapshot).expect("restoring the snapshot");
    for env in [&mut field, &mut other] {
        env.env.step(EAST).expect("stepping the environment");
    }
    assert!(field.all_outputs() == other.all_outputs());
    let goals = [&mut field, &mut other].map(|env| {
        let mut goal = vec![0; 27];
        env.env.render_goal(FrameMut::new(3, 3, &mut goal)).expect("rendering the goal");
        goal
    });
    assert_eq!(goals, [[200; 27], [200; 27]]);
}

#[test]
fn snapshot_calls_only_methods_that_set_a_state() {
    let Some(config) = config() else { return };
    let mut field = make(FIELD, &config);
    start(&mut *field, &ResetOptions::default(), &[]).expect("a start");
    let hostile = replace(&field.snapshot().0, b"_set_state", b"seed_evil_");
    let error = field.restore(&Snapshot(hostile)).expect_err("another method").to_string();
    assert!(error.contains("calls the method 'seed_evil_'"), "{error}");
}

/// Replaces the first occurrence of `from` by a text of the same length.
fn replace(bytes: &[u8], from: &[u8], to: &[u8]) -> Vec<u8> {
    let at = bytes.windows(from.len()).position(|part| part == from).expect("the text occurs");
    [&bytes[..at], to, &bytes[at + from.len()..]].concat()
}
