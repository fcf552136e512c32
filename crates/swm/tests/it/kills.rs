//! Every command that writes is killed (SIGKILL) fifty times at keyed random moments. What it had stored stays readable,
//! and the command completes afterwards.
//!
//! `cargo test --release -p swm --test it kills -- --ignored` runs them; `make nightly` does so too.

use crate::{Swm, text};
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};
use swm::core::Key;

/// Kills of each command.
const KILLS: u64 = 50;

/// Kills a command at moments of its duration, checks what it left each time, and completes it.
fn killed(swm: &Swm, args: &[&str], check: impl Fn(&Swm)) {
    let start = Instant::now();
    let whole = swm.run(args);
    assert!(whole.status.success(), "swm {args:?}: {}", text(&whole.stderr));
    let duration = start.elapsed();
    for moment in 0..KILLS {
        kill(swm, args, duration, moment);
        check(swm);
    }
    let last = swm.run(args);
    assert!(last.status.success(), "swm {args:?} after {KILLS} kills: {}", text(&last.stderr));
    check(swm);
}

/// Starts a command and kills it after a keyed random part of `longest`.
fn kill(swm: &Swm, args: &[&str], longest: Duration, moment: u64) {
    let mut child = swm.command(args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("swm starts");
    let part = (Key::new(0).with(args[0]).at(moment).seed() >> 32) as f64 / f64::from(u32::MAX);
    std::thread::sleep(longest.mul_f64(part));
    // The command may have ended already.
    let _ = child.kill();
    child.wait().expect("the process ends");
}

fn collected(name: &str) -> Swm {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", name, "--image", "64", "--episodes", "12", "--max-steps", "60"]);
    swm
}

/// Checks that a file is missing, or whole: JSON, or a page with its end.
fn missing_or_whole(path: &Path) {
    let Ok(bytes) = std::fs::read(path) else { return };
    match path.extension().and_then(|end| end.to_str()) {
        Some("json") => drop(serde_json::from_slice::<serde_json::Value>(&bytes).expect("valid JSON")),
        _ => assert!(text(&bytes).trim_end().ends_with("</html>"), "{} is cut off", path.display()),
    }
}

#[test]
#[ignore = "fifty kills"]
fn fifty_killed_collections_leave_readable_datasets() {
    let swm = collected("rooms");
    let args = ["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "64", "--episodes", "300", "--overwrite"];
    killed(&swm, &args, |swm| {
        swm.json(&["inspect", "rooms"]);
    });
}

#[test]
#[ignore = "fifty kills"]
fn fifty_killed_conversions_leave_their_source() {
    let swm = collected("rooms");
    let source = swm.json(&["inspect", "rooms"])["content_hash"].clone();
    for target in ["rooms-2", "rooms.h5"] {
        killed(&swm, &["convert", "rooms", target, "--mode", "overwrite"], |swm| {
            assert_eq!(swm.json(&["inspect", "rooms"])["content_hash"], source);
        });
        assert_eq!(swm.json(&["inspect", target])["episodes"], 12);
    }
}

#[test]
#[ignore = "fifty kills"]
fn fifty_killed_trainings_resume() {
    let swm = collected("rooms");
    // More steps than fit into fifty runs of a second.
    let begin = ["train", "lewm", "--data", "rooms", "-o", "small", "schedule.steps=1000000", "save_every=1"];
    let resume = [&begin[..], &["--resume"]].concat();
    let longest = Duration::from_secs(1);
    for moment in 0..KILLS {
        let stored = swm.path("checkpoints/small").exists();
        kill(&swm, if stored { &resume } else { &begin }, longest, moment);
        if swm.path("checkpoints/small/checkpoint").exists() || swm.path("checkpoints/small/.checkpoint.old").exists() {
            swm.json(&["checkpoints", "verify", "small"]);
        }
    }
    assert!(swm.path("checkpoints/small/checkpoint").exists(), "no run lived until its first checkpoint");
}

#[test]
#[ignore = "fifty kills"]
fn fifty_killed_evaluations_and_reports_leave_whole_files() {
    let swm = Swm::new();
    let args = ["eval", "random", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "20", "-o", "floor"];
    killed(&swm, &args, |swm| missing_or_whole(&swm.path("floor/results.json")));
    let args = ["report", "floor", "-o", "page"];
    killed(&swm, &args, |swm| missing_or_whole(&swm.path("page/index.html")));
}
