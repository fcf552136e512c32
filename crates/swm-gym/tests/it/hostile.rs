//! Tests of environments that fork, close descriptors, replace their process or write to the connection.

use crate::config;
use crate::play::make;
use std::time::{Duration, Instant};
use swm_core::batch::{Batch, Schema};
use swm_core::{Action, Env, ResetOptions};
use swm_gym::GymConfig;

/// Returns the error of an environment that fails in its second step or later. All observations before it are right.
fn error_of(fault: &str) -> Option<String> {
    let config = GymConfig { call_timeout: Duration::from_millis(1000), restarts: 0, ..config()? };
    let mut env = make(&format!("tests.it.environments:Counter-v0,fault={fault}"), &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    let start = Instant::now();
    for t in 1.. {
        if let Err(error) = env.step(Action::Discrete(&[0])) {
            assert!(t > 1, "{fault}: {error}");
            env.reset(0, &ResetOptions::default()).expect("a reset after an error");
            return Some(error.to_string());
        }
        assert_eq!(observation(&*env), t as f32, "{fault}");
        assert!(start.elapsed() < Duration::from_secs(20), "{fault}: no error");
    }
    None
}

fn observation(env: &dyn Env) -> f32 {
    let mut row = Batch::zeros(&Schema::new(env.spec().columns.clone()).expect("a schema"), 1);
    env.observe(&mut row.row_mut(0));
    row.get::<f32>("observation").expect("a column")[0]
}

fn check(fault: &str, words: &[&str]) {
    let Some(error) = error_of(fault) else { return };
    for part in words {
        assert!(error.contains(part), "{fault}: no '{part}' in {error}");
    }
}

#[test]
fn forked_process_that_returns_is_an_error_and_doubles_no_row() {
    check("fork", &["tests.it.environments:Counter-v0", "forked a process"]);
    check("fork_and_raise", &["forked a process"]);
}

#[test]
fn process_that_leaves_its_work_to_a_child_is_lost() {
    check("fork_and_end", &["ended with exit status: 3"]);
}

#[test]
fn closed_connection_is_an_error() {
    check("close_descriptors", &["worker process"]);
    check("exec", &["worker process"]);
}

#[test]
fn malformed_answers_are_errors() {
    check("answer", &["4294967295 bytes"]);
    check("answer_unknown", &["an answer of unknown kind 0"]);
}

/// Before its size was sealed, the memory ended where the engine read the next observation, which is a SIGBUS.
#[cfg(target_os = "linux")]
#[test]
fn environment_cannot_shrink_the_shared_memory() {
    let Some(config) = config() else { return };
    let mut env = make("tests.it.environments:Counter-v0,fault=shrink", &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    for t in 1..4 {
        env.step(Action::Discrete(&[0])).expect("a step");
        assert_eq!(observation(&*env), t as f32);
    }
}

/// numpy would repeat one number along an axis, drop imaginary parts and parse strings.
#[test]
fn observations_of_another_shape_or_type_are_errors() {
    let Some(config) = config() else { return };
    let shaped = ["scalar", "one", "column"].map(|value| (value, "shape"));
    for (value, shown) in shaped
        .into_iter()
        .chain([("complex", "complex"), ("text", "<U1")])
        .chain([
            ("success", "info['success'] is 'no'"),
            ("nan", "info['success'] is nan"),
            ("success-list", "info['success'] is (False, False)"),
            ("success-nan", "info['success'] is [nan]"),
            ("success-minus", "info['success'] is -1"),
            ("success-part", "info['success'] is 0.01"),
            ("success-two", "info['success'] is 2"),
            ("is-success", "info['is_success'] is (True, True)"),
            ("success-gone", "info['success'] is None at the end of an episode"),
        ])
        .chain([
            ("end-nan", "terminated is nan"),
            ("end-text", "terminated is 'False'"),
            ("end-none", "terminated is None"),
            ("end-minus", "terminated is -1"),
            ("reward", "the reward is '1'"),
            ("reward-none", "the reward is None: return a number"),
            ("reward-pair", "the reward is array([0., 0.]): return a number"),
        ])
    {
        let mut env = make(&format!("tests.it.environments:Loose-v0,value={value}"), &config);
        env.reset(0, &ResetOptions::default()).expect("a reset");
        env.step(Action::Discrete(&[0])).expect("three numbers");
        let error = env.step(Action::Discrete(&[0])).expect_err(value).to_string();
        assert!(error.contains(shown) && error.contains("Loose-v0,value="), "{value}: {error}");
        assert!(error.contains("its step 2 raised"), "{value}: {error}");
    }
    let mut env = make("tests.it.environments:Loose-v0,value=row", &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    for _ in 0..3 {
        env.step(Action::Discrete(&[0])).expect("a leading axis of one element is left out");
    }
    let mut env = make("tests.it.environments:Loose-v0,value=reward-one", &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    let rewards = [0, 1].map(|_| env.step(Action::Discrete(&[0])).expect("an array of one element").reward);
    assert_eq!(rewards, [0.0, 1.0]);
}

#[test]
fn success_is_one_truth_value() {
    let Some(config) = config() else { return };
    for (value, solved) in [("one-false", false), ("one-true", true), ("numpy", true), ("missing", false)] {
        let mut env = make(&format!("tests.it.environments:Loose-v0,value={value}"), &config);
        env.reset(0, &ResetOptions::default()).expect("a reset");
        for _ in 0..2 {
            env.step(Action::Discrete(&[0])).expect("a step");
        }
        assert_eq!(env.is_success(), solved, "{value}");
    }
}

#[test]
fn values_that_a_column_cannot_hold_are_errors() {
    let Some(config) = config() else { return };
    for (value, shown) in [("large", "9223372036854775813"), ("fraction", "1.5"), ("nan", "nan")] {
        let mut env = make(&format!("tests.it.environments:Wide-v0,value={value}"), &config);
        env.reset(0, &ResetOptions::default()).expect("a reset");
        env.step(Action::Discrete(&[0])).expect("a whole number");
        let error = env.step(Action::Discrete(&[0])).expect_err("a value that int64 cannot hold").to_string();
        assert!(error.contains(shown) && error.contains("int64"), "{error}");
    }
}
