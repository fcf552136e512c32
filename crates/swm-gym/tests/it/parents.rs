//! No worker outlives us, however we end.

use crate::config;
use crate::play::ROOM;
use crate::robust::kill_process;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use swm_core::{Action, Env, ResetOptions};
use swm_gym::{GymEnv, WorkerTransport};

/// Whether a process still runs; one that nobody has buried does not.
fn runs(id: u32) -> bool {
    let stat = std::fs::read_to_string(Path::new("/proc").join(id.to_string()).join("stat"));
    stat.is_ok_and(|stat| stat.rsplit(')').next().is_some_and(|rest| !rest.trim_start().starts_with('Z')))
}

/// Whether a process ends within ten seconds.
fn ends(id: u32) -> bool {
    let begun = Instant::now();
    while runs(id) {
        if begun.elapsed() > Duration::from_secs(10) {
            return false;
        }
        std::thread::yield_now();
    }
    true
}

/// A world whose fourth step hangs, and its process.
fn world() -> Option<(GymEnv, u32)> {
    let options = [("hang_at".to_owned(), "4".to_owned())];
    let transport = WorkerTransport::new(ROOM, options.into(), config()?).expect("a worker");
    let id = transport.process_id().expect("a process");
    Some((GymEnv::new(ROOM, Box::new(transport), 2).expect("a world"), id))
}

#[test]
fn a_dropped_world_takes_its_worker_along() {
    let Some((env, id)) = world() else { return };
    assert!(runs(id));
    drop(env);
    assert!(!runs(id));
}

#[test]
fn a_panic_takes_the_worker_along() {
    let Some((mut env, id)) = world() else { return };
    let panicked = std::thread::spawn(move || {
        env.reset(0, &ResetOptions::default()).expect("a reset");
        // Not `panic!`, whose message would look like a failure.
        std::panic::resume_unwind(Box::new("a panic"));
    });
    assert!(panicked.join().is_err());
    assert!(ends(id));
}

/// The kernel's promise counts from a thread: that of the starter, not of whoever asked.
#[test]
fn a_worker_outlives_the_thread_that_asked_for_it() {
    if config().is_none() {
        return;
    }
    let (mut env, id) = std::thread::spawn(|| world().expect("a world")).join().expect("no panic");
    env.reset(0, &ResetOptions::default()).expect("a reset");
    assert!(runs(id));
}

#[test]
fn a_killed_process_takes_busy_workers_along() {
    if config().is_none() {
        return;
    }
    let test = std::env::current_exe().expect("a program");
    let mut child = Command::new(test)
        .args(["--exact", "parents::hang_with_a_worker", "--nocapture"])
        .env(HANG, "1")
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("a child");
    let lines = BufReader::new(child.stdout.take().expect("a pipe")).lines();
    let worker = lines.map_while(Result::ok).find_map(|line| line.split("worker=").nth(1)?.trim().parse().ok());
    let worker = worker.expect("the child tells its worker");
    assert!(runs(worker));
    kill_process(child.id());
    child.wait().expect("an end");
    assert!(ends(worker), "process {worker} is an orphan");
}

/// Set for the child of the test above.
const HANG: &str = "SWM_TEST_HANG";

/// Not a test: the child of the one above, and nothing without its variable.
#[test]
#[allow(clippy::print_stdout)]
fn hang_with_a_worker() {
    if std::env::var_os(HANG).is_none() {
        return;
    }
    let (mut env, id) = world().expect("a world");
    env.reset(0, &ResetOptions::default()).expect("a reset");
    for t in 0..4 {
        if t == 3 {
            println!("worker={id}");
        }
        env.step(Action::Continuous(&[0.0, 0.0])).expect("a step");
    }
}
