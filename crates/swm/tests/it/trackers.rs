//! `swm train --log`: metrics go to the packages of trackers, here to one that writes what it receives.

use crate::Swm;

/// A package with the interface of trackers.
const PACKAGE: &str = r#"
import json, os
out = open(os.environ["TRACKED"], "a")
def write(**fields):
    out.write(json.dumps(fields) + "\n")
    out.flush()
def init(project, name, config):
    print("a line of its own")
    write(project=project, name=name, seed=config["seed"])
    return None or __import__(__name__)
def log(metrics, step=None):
    write(step=step, loss="loss" in metrics)
def finish():
    write(finished=True)
"#;

#[test]
fn metrics_go_to_the_package_of_a_tracker() {
    let python = std::env::var("SWM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !std::process::Command::new(&python).arg("--version").output().is_ok_and(|output| output.status.success()) {
        println!("skipped: there is no Python");
        return;
    }
    let swm = Swm::new();
    swm.json(&[
        "collect",
        "swm/TwoRoom-v1",
        "--output",
        "rooms",
        "--episodes",
        "12",
        "--max-steps",
        "20",
        "--image",
        "64",
    ]);
    // Files of the current folder are no modules.
    for name in ["json", "importlib", "wandb", "trackio"] {
        let source = "import pathlib; pathlib.Path(__file__).with_name('imported').touch(); raise SystemExit(3)";
        std::fs::write(swm.path(&format!("{name}.py")), source).expect("a module");
    }
    std::fs::create_dir(swm.path("packages")).expect("a folder");
    std::fs::write(swm.path("packages/trackio.py"), PACKAGE).expect("a package");
    let train = |log: &str| {
        let quick = ["schedule.steps=4", "log_every=2", "data.batch_size=4", "validation.every=0", "seed=7"];
        let args = [&["train", "lewm", "--data", "rooms", "--output", "run", "--log", log], &quick[..]].concat();
        let mut command = swm.command(&args);
        command.env("PYTHONPATH", swm.path("packages")).env("TRACKED", swm.path("tracked"));
        command.output().expect("swm starts")
    };
    let missing = train("jsonl,wandb");
    let error = crate::text(&missing.stderr);
    assert!(missing.status.code() == Some(2) && error.contains("pip install wandb"), "{error}");
    let output = train("tensorboard,trackio");
    assert!(!swm.path("imported").exists());
    assert!(output.status.success(), "{}", crate::text(&output.stderr));
    let tracked = std::fs::read_to_string(swm.path("tracked")).expect("what was tracked");
    let lines: Vec<serde_json::Value> =
        tracked.lines().map(|line| serde_json::from_str(line).expect("a line of JSON")).collect();
    assert_eq!(lines[0], serde_json::json!({"project": "stable-worldmodel", "name": "run", "seed": 7}));
    let steps: Vec<u64> = lines.iter().filter_map(|line| line["step"].as_u64()).collect();
    assert_eq!(steps, [2, 4]);
    assert!(
        lines[1]["loss"].as_bool().expect("a metric") && lines[lines.len() - 1]["finished"].as_bool() == Some(true)
    );
}

/// A package that hangs.
const HANGING: &str = r#"
import os, time
def hang(when):
    while os.environ["HANG"] == when:
        time.sleep(0.1)
def init(project, name, config):
    hang("init")
def log(metrics, step=None):
    hang("log")
def finish():
    hang("finish")
"#;

#[test]
fn packages_that_hang_are_ended() {
    let python = std::env::var("SWM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    if !std::process::Command::new(&python).arg("--version").output().is_ok_and(|output| output.status.success()) {
        println!("skipped: there is no Python");
        return;
    }
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "12", "--max-steps", "20", "--image", "64"]);
    std::fs::create_dir(swm.path("packages")).expect("a folder");
    std::fs::write(swm.path("packages/trackio.py"), HANGING).expect("a package");
    let train = |when: &str, seconds: &str| {
        let quick = ["schedule.steps=2", "log_every=1", "data.batch_size=4", "validation.every=0"];
        let args = [&["train", "lewm", "--data", "rooms", "-o", when, "--log", "trackio"], &quick[..]].concat();
        let mut command = swm.command(&args);
        command.env("PYTHONPATH", swm.path("packages")).env("HANG", when).env("SWM_TRACKER_TIMEOUT", seconds);
        command.stderr(std::process::Stdio::piped()).spawn().expect("swm starts").wait_with_output().expect("swm ends")
    };
    let started = train("init", "1");
    let error = crate::text(&started.stderr);
    assert!(started.status.code() == Some(1) && error.contains("did not start within 1 s"), "{error}");
    for when in ["log", "finish"] {
        let output = train(when, "1");
        let error = crate::text(&output.stderr);
        assert!(output.status.success() && error.contains("trackio"), "{when}: {error}");
    }
}
