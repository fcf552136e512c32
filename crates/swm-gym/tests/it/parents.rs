//! Tests that a worker process ends when its parent process ends in any way.

use crate::play::ROOM;
use crate::robust::kill_process;
use crate::{config, id};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use swm_core::{Action, Env, ResetOptions};
use swm_gym::{GymEnv, WorkerTransport};

/// Returns whether a process runs. A zombie process does not.
fn is_running(id: u32) -> bool {
    let stat = std::fs::read_to_string(Path::new("/proc").join(id.to_string()).join("stat"));
    stat.is_ok_and(|stat| stat.rsplit(')').next().is_some_and(|rest| !rest.trim_start().starts_with('Z')))
}

/// Returns whether a process ends within ten seconds.
fn ends_in_time(id: u32) -> bool {
    let begun = Instant::now();
    while is_running(id) {
        if begun.elapsed() > Duration::from_secs(10) {
            return false;
        }
        std::thread::yield_now();
    }
    true
}

/// Makes an environment whose fourth step hangs, and returns it with the id of its process.
fn hanging_env() -> Option<(GymEnv, u32)> {
    let transport = WorkerTransport::new(&id(&format!("{ROOM},hang_at=4")), config()?).expect("starting the worker");
    let id = transport.process_id().expect("the worker has a process id");
    Some((GymEnv::new(ROOM, Box::new(transport), 2).expect("creating the environment"), id))
}

#[test]
fn dropping_an_environment_ends_its_worker() {
    let Some((env, id)) = hanging_env() else { return };
    assert!(is_running(id));
    drop(env);
    assert!(!is_running(id));
}

#[test]
fn panic_of_the_owning_thread_ends_the_worker() {
    let Some((mut env, id)) = hanging_env() else { return };
    let panicked = std::thread::spawn(move || {
        env.reset(0, &ResetOptions::default()).expect("resetting the environment");
        // `panic!` would print a message that looks like a failed test.
        std::panic::resume_unwind(Box::new("a panic"));
    });
    assert!(panicked.join().is_err());
    assert!(ends_in_time(id));
}

/// The kernel kills a child when the thread that started it ends, so a permanent thread must start the workers.
#[test]
fn a_worker_outlives_the_thread_that_made_its_environment() {
    if config().is_none() {
        return;
    }
    let (mut env, id) = std::thread::spawn(|| hanging_env().expect("starting the hanging environment"))
        .join()
        .expect("joining the thread");
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    assert!(is_running(id));
}

#[test]
fn killing_the_process_ends_busy_workers() {
    if config().is_none() {
        return;
    }
    let program = std::env::current_exe().expect("finding the test executable");
    let mut child = Command::new(program)
        .args(["--exact", "parents::child_that_hangs_with_a_worker", "--nocapture"])
        .env(HANG, "1")
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("starting the child process");
    let lines = BufReader::new(child.stdout.take().expect("standard output of the child")).lines();
    let worker = lines.map_while(Result::ok).find_map(|line| line.split("worker=").nth(1)?.trim().parse().ok());
    let worker = worker.expect("the child prints the id of its worker");
    assert!(is_running(worker));
    kill_process(child.id());
    child.wait().expect("waiting for the child process");
    assert!(ends_in_time(worker), "worker process {worker} still runs");
}

/// The environment variable that [`killing_the_process_ends_busy_workers`] sets for its child process.
const HANG: &str = "SWM_TEST_HANG";

/// The program of the child process of [`killing_the_process_ends_busy_workers`]; does nothing unless [`HANG`] is set.
#[test]
#[expect(clippy::print_stdout, reason = "the parent test reads the id of the worker from standard output")]
fn child_that_hangs_with_a_worker() {
    if std::env::var_os(HANG).is_none() {
        return;
    }
    let (mut env, id) = hanging_env().expect("starting the hanging environment");
    env.reset(0, &ResetOptions::default()).expect("resetting the environment");
    for t in 0..4 {
        if t == 3 {
            println!("worker={id}");
        }
        env.step(Action::Continuous(&[0.0, 0.0])).expect("stepping the environment");
    }
}
