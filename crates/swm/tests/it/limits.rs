//! Tests of absurd counts and of runs with little memory (docs/security.md).

use crate::{Swm, text};
use std::process::Command;

const ROOMS: &[&str] = &["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "1", "--image", "32"];
const EVAL: &[&str] = &["eval", "random", "--env", "swm/TwoRoom-v1", "--image", "32"];

#[test]
fn absurd_counts_are_refused_before_work_starts() {
    let swm = Swm::new();
    let huge = "1000000000000000";
    for (args, option, value, what) in [
        (ROOMS, "--envs", "1000000", "number of environments"),
        (ROOMS, "--threads", "100000", "number of threads"),
        (&ROOMS[..4], "--episodes", huge, "number of episodes"),
        (ROOMS, "--max-steps", huge, "number of steps"),
        (ROOMS, "--shard", "0/1000000000000000", "number of shards"),
        (EVAL, "--budget", huge, "number of steps"),
        (EVAL, "--threads", huge, "number of threads"),
    ] {
        swm.fails(&[args, &[option, value]].concat(), 2, &[what, "too large", "choose at most"]);
    }
    swm.fails(&[&ROOMS[..6], &["--image", "100000"]].concat(), 2, &["100000", "4096"]);
    swm.fails(&[&ROOMS[..6], &["--image", "4096", "--envs", "10000"]].concat(), 2, &["bytes of a batch"]);
    swm.fails(&[EVAL, &["--episodes", huge]].concat(), 2, &[huge, "from 1 to 1000000"]);
    assert!(!swm.path("datasets/rooms.lance").exists());
}

/// With little memory, threads cannot be started and allocations fail anywhere. With backtraces on, the program waited
/// forever for the lock of the backtrace of another panic.
#[cfg(target_os = "linux")]
#[test]
#[ignore = "a thread that cannot be started still makes a run wait for ever, once in some tens of runs"]
fn run_without_memory_ends_with_an_error() {
    let swm = Swm::new();
    for (i, kilobytes) in (300..=700).step_by(40).enumerate() {
        let name = format!("rooms-{i}");
        let collect = ["collect", "swm/TwoRoom-v1", "-o", &name, "--image", "96", "--episodes", "12", "--threads", "2"];
        let program = env!("CARGO_BIN_EXE_swm");
        let limited = format!("ulimit -v {}; exec timeout -k 5 20 '{program}' \"$@\"", kilobytes * 1000);
        let output = Command::new("sh")
            .args(["-c", &limited, "sh"])
            .args(collect)
            .env("STABLEWM_HOME", swm.home())
            .env("RUST_BACKTRACE", "1")
            .output()
            .expect("sh starts");
        let code = output.status.code();
        assert!(matches!(code, Some(0 | 1)), "{kilobytes} MB: {code:?}: {}", text(&output.stderr));
    }
}
