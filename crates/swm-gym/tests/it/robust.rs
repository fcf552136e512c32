//! Workers that die, hang, raise and print.

use crate::config;
use crate::play::{ROOM, Seen, make, play};
use std::time::Duration;
use swm_core::{Action, PendingCall, ResetOptions};
use swm_gym::{GymConfig, GymEnv, WorkerTransport};

const PUSH: Action<'static> = Action::Continuous(&[0.1, -0.2]);

#[test]
fn a_worker_that_dies_in_mid_episode_changes_no_byte() {
    let Some(config) = config() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let marker = folder.path().join("died");
    let wanted = play(ROOM, &config, &[1], 1, 6);
    let dying = format!("{ROOM},die_at=4,marker={}", marker.display());
    assert!(play(&dying, &config, &[1], 1, 6) == wanted);
    assert!(marker.exists(), "it did die");
}

#[test]
fn a_worker_killed_from_outside_changes_no_byte() {
    let Some(config) = config() else { return };
    let run = |kill: Option<u32>| {
        let transport = WorkerTransport::new("CartPole-v1", [].into(), config.clone()).expect("a worker");
        let id = transport.process_id().expect("a process");
        let mut env = Seen::of(Box::new(GymEnv::new("CartPole-v1", Box::new(transport), 2).expect("a world")));
        env.env.reset(4, &ResetOptions::default()).expect("a reset");
        let mut seen = vec![];
        for t in 0..6 {
            if kill == Some(t) {
                kill_process(id);
            }
            env.env.step(Action::Discrete(&[i64::from(t % 2)])).expect("a step");
            seen.push(env.everything());
        }
        seen
    };
    let wanted = run(None);
    assert!(run(Some(0)) == wanted && run(Some(3)) == wanted);
}

#[test]
fn what_a_killed_worker_was_told_is_told_again() {
    let Some(config) = config() else { return };
    let options = ResetOptions::default();
    let run = |kill: Option<(&str, bool)>| {
        let transport = WorkerTransport::new("CartPole-v1", [].into(), config.clone()).expect("a worker");
        let id = transport.process_id().expect("a process");
        let mut env = Seen::of(Box::new(GymEnv::new("CartPole-v1", Box::new(transport), 2).expect("a world")));
        let tell = |env: &mut Seen, what: &str, next: PendingCall<'_>| {
            if kill == Some((what, false)) {
                kill_process(id);
            }
            env.dispatch(next);
            if kill == Some((what, true)) {
                kill_process(id);
            }
        };
        tell(&mut env, "reset", PendingCall::Reset(4, &options));
        env.env.reset(4, &options).expect("a reset");
        let mut seen = env.everything();
        for what in ["first", "second"] {
            tell(&mut env, what, PendingCall::Step(Action::Discrete(&[1])));
            env.env.step(Action::Discrete(&[1])).expect("a step");
            seen.extend(env.everything());
        }
        seen
    };
    let wanted = run(None);
    for what in ["reset", "first", "second"] {
        assert!(run(Some((what, false))) == wanted && run(Some((what, true))) == wanted, "{what}");
    }
}

pub fn kill_process(id: u32) {
    let killed = std::process::Command::new("kill").args(["-9", &id.to_string()]).status();
    assert!(killed.expect("kill").success());
}

#[test]
fn a_worker_that_always_dies_is_an_error_that_says_how() {
    let Some(config) = config() else { return };
    let mut env = make(&format!("{ROOM},die_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    env.step(PUSH).expect("a step");
    let error = env.step(PUSH).expect_err("it dies").to_string();
    for words in [ROOM, "3 workers", "signal: 9", "about to die"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    assert!(env.step(PUSH).expect_err("over").to_string().contains("reset it first"));
    env.reset(0, &ResetOptions::default()).expect("a reset after an error");
    env.step(PUSH).expect("a step after an error");
}

#[test]
fn an_exception_is_told_and_not_tried_again() {
    let Some(config) = config() else { return };
    let mut env = make(&format!("{ROOM},raise_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    env.step(PUSH).expect("a step");
    let error = env.step(PUSH).expect_err("it raises").to_string();
    for words in [ROOM, "its step raised", "raise ValueError('the room is on fire')", "worlds.py"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    env.reset(0, &ResetOptions::default()).expect("a reset after an error");
    env.step(PUSH).expect("a step after an error");
}

#[test]
fn an_environment_that_hangs_is_stopped() {
    let Some(config) = config() else { return };
    let config = GymConfig { call_timeout: Duration::from_millis(1500), restarts: 1, ..config };
    let mut env = make(&format!("{ROOM},hang_at=2"), &config);
    env.reset(0, &ResetOptions::default()).expect("a reset");
    env.step(PUSH).expect("a step");
    let error = env.step(PUSH).expect_err("it hangs").to_string();
    for words in ["2 workers", "did not answer within 1.5s", "about to hang"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    env.reset(0, &ResetOptions::default()).expect("a reset after an error");
}
