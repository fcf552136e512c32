//! Tests of workers that die, hang, raise exceptions and print.

use crate::play::{ROOM, RecordedEnv, make, play};
use crate::{config, id};
use std::time::Duration;
use swm_core::{Action, PendingCall, ResetOptions};
use swm_gym::{GymConfig, GymEnv, WorkerTransport};

const PUSH: Action<'static> = Action::Continuous(&[0.1, -0.2]);

#[test]
fn outputs_are_the_same_when_a_worker_dies_in_an_episode() {
    let Some(config) = config() else { return };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let marker = folder.path().join("died");
    let expected = play(ROOM, &config, &[1], 1, 6);
    let dying = format!("{ROOM},die_at=4,marker={}", marker.display());
    assert!(play(&dying, &config, &[1], 1, 6) == expected);
    assert!(marker.exists(), "the worker did not die");
}

#[test]
fn outputs_are_the_same_when_a_worker_is_killed() {
    let Some(config) = config() else { return };
    let run = |kill: Option<u32>| {
        let transport = WorkerTransport::new(&id("CartPole-v1"), config.clone()).expect("starting the worker");
        let id = transport.process_id().expect("the worker has a process id");
        let mut env = RecordedEnv::of(Box::new(
            GymEnv::new("CartPole-v1", Box::new(transport), 2).expect("creating the environment"),
        ));
        env.env.reset(4, &ResetOptions::default()).expect("resetting the environment");
        let mut outputs = vec![];
        for t in 0..6 {
            if kill == Some(t) {
                kill_process(id);
            }
            env.env.step(Action::Discrete(&[i64::from(t % 2)])).expect("stepping the environment");
            outputs.push(env.all_outputs());
        }
        outputs
    };
    let expected = run(None);
    assert!(run(Some(0)) == expected && run(Some(3)) == expected);
}

#[test]
fn dispatched_calls_are_repeated_in_a_new_worker() {
    let Some(config) = config() else { return };
    let options = ResetOptions::default();
    let run = |kill: Option<(&str, bool)>| {
        let transport = WorkerTransport::new(&id("CartPole-v1"), config.clone()).expect("starting the worker");
        let id = transport.process_id().expect("the worker has a process id");
        let mut env = RecordedEnv::of(Box::new(
            GymEnv::new("CartPole-v1", Box::new(transport), 2).expect("creating the environment"),
        ));
        let dispatch = |env: &mut RecordedEnv, call: &str, next: PendingCall<'_>| {
            if kill == Some((call, false)) {
                kill_process(id);
            }
            env.dispatch(next);
            if kill == Some((call, true)) {
                kill_process(id);
            }
        };
        dispatch(&mut env, "reset", PendingCall::Reset(4, &options));
        env.env.reset(4, &options).expect("resetting the environment");
        let mut outputs = env.all_outputs();
        for call in ["first", "second"] {
            dispatch(&mut env, call, PendingCall::Step(Action::Discrete(&[1])));
            env.env.step(Action::Discrete(&[1])).expect("stepping the environment");
            outputs.extend(env.all_outputs());
        }
        outputs
    };
    let expected = run(None);
    for call in ["reset", "first", "second"] {
        assert!(run(Some((call, false))) == expected && run(Some((call, true))) == expected, "{call}");
    }
}

pub fn kill_process(id: u32) {
    let killed = std::process::Command::new("kill").args(["-9", &id.to_string()]).status();
    assert!(killed.expect("the program `kill`").success());
}

#[test]
fn repeated_worker_deaths_are_an_error_with_the_last_output() {
    let Some(config) = config() else { return };
    let mut env = make(&format!("{ROOM},die_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    env.step(PUSH).expect("stepping the environment");
    let error = env.step(PUSH).expect_err("the worker dies").to_string();
    for words in [ROOM, "3 workers", "signal: 9", "about to die"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    assert!(env.step(PUSH).expect_err("stepping without an episode").to_string().contains("reset it first"));
    env.reset(0, &ResetOptions::default()).expect("resetting the environment after an error");
    env.step(PUSH).expect("stepping the environment after an error");
}

#[test]
fn an_exception_is_reported_without_a_retry() {
    let Some(config) = config() else { return };
    let mut env = make(&format!("{ROOM},raise_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    env.step(PUSH).expect("stepping the environment");
    let error = env.step(PUSH).expect_err("a step that raises an exception").to_string();
    for words in [ROOM, "its step 2 raised", "raise ValueError('the room is on fire')", "environments.py"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    env.reset(0, &ResetOptions::default()).expect("resetting the environment after an error");
    env.step(PUSH).expect("stepping the environment after an error");
}

#[test]
fn environment_that_exceeds_the_call_timeout_is_an_error() {
    let Some(config) = config() else { return };
    let config = GymConfig { call_timeout: Duration::from_millis(1500), restarts: 1, ..config };
    let mut env = make(&format!("{ROOM},hang_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    env.step(PUSH).expect("stepping the environment");
    let error = env.step(PUSH).expect_err("a step that exceeds the timeout").to_string();
    for words in ["2 workers", "did not answer within 1.5s", "about to hang"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    env.reset(0, &ResetOptions::default()).expect("resetting the environment after an error");
}

#[test]
fn environment_that_blocks_while_it_is_made_is_given_up() {
    let Some(config) = config() else { return };
    let config = GymConfig { start_timeout: Duration::from_millis(2500), ..config };
    let hanging = swm_gym::make(&id(&format!("{ROOM},hang_at=1")), config).err();
    let error = hanging.expect("the first step blocks while the environment is made").to_string();
    for words in ["making the environment", "did not answer within 2.5s"] {
        assert!(error.contains(words), "{words}: {error}");
    }
}
