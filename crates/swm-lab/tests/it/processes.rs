//! Trainings, collections and evaluations that pages start and stop, with a shell in place of the program.

use super::TestLab;
use serde_json::{Value, json};
use std::ffi::OsString;
use std::path::Path;
use std::process::{Child, Command};
use swm_core::{Error, Result};
use swm_lab::processes::{Family, Program};

/// Writes a log, and runs until it is asked to stop. The preset `broken` fails at once, `early` stores nothing, `failing` fails
/// when it is asked to stop. Collections and evaluations write their arguments into the file `given`.
pub struct Shell;

impl Program for Shell {
    fn families(&self) -> Vec<Family> {
        let presets = ["tiny", "broken", "early", "failing"].map(|id| (id.to_owned(), String::new())).to_vec();
        vec![Family { id: "gcbc".to_owned(), summary: String::new(), presets }]
    }

    fn command(&self, arguments: &[OsString]) -> Result<Command> {
        let texts: Vec<_> = arguments.iter().map(|argument| argument.to_string_lossy()).collect();
        let after = |option: &str| texts.iter().position(|text| text == option).map_or("", |at| &texts[at + 1]);
        let seed = texts.iter().find_map(|text| text.strip_prefix("seed=")).unwrap_or_default();
        let mut command = Command::new("sh");
        let script = match (&*texts[0], after("--preset")) {
            ("collect" | "eval", _) => {
                r#"mkdir -p "$2"; shift 3; printf '%s\n' "$@" > "$0.tmp"; mv "$0.tmp" "$0"; echo done >&2"#
            }
            (_, "tiny") => {
                r#"trap 'echo "{\"step\": 2, \"loss\": 1.0}" >> "$2/train.jsonl"; exit 130' INT
                mkdir -p "$2"; echo "{\"step\": 1, \"loss\": 2.0, \"seed\": $3}" > "$2/train.jsonl"
                [ -d "$1" ] || exit 1
                echo "train: 1/10" >&2
                while :; do sleep 0.02; done"#
            }
            (_, "early") => "trap 'exit 130' INT; while :; do sleep 0.02; done",
            (_, "failing") => {
                r#"trap 'echo "error: the disk is full" >&2; exit 1' INT
                mkdir -p "$2"; echo "{\"step\": 1}" > "$2/train.jsonl"
                while :; do sleep 0.02; done"#
            }
            _ => "echo 'error: the data is broken' >&2; exit 1",
        };
        let given = format!("{}/given", after("--output"));
        command.args(["-c", script, &given, after("--data"), after("--output"), seed]).args(arguments);
        Ok(command)
    }

    fn interrupt(&self, process: &Child) -> Result<()> {
        let done = Command::new("kill").args(["-INT", &process.id().to_string()]).status();
        done.map(drop).map_err(|error| Error::external("stopping", error))
    }

    fn can_continue(&self, output: &Path) -> bool {
        output.join("train.jsonl").is_file()
    }
}

/// The body of a request to train on recorded demonstrations.
fn request(change: Value) -> String {
    let mut body = json!({
        "command": "train", "family": "gcbc", "preset": "tiny", "folder": 0, "dataset": "rooms.lance", "name": "cloned", "steps": 10, "seed": 5,
    });
    for (key, value) in change.as_object().expect("fields") {
        body[key] = value.clone();
    }
    body.to_string()
}

/// Waits until a training has this state; returns it.
fn wait_for(lab: &TestLab, name: &str, state: &str) -> Value {
    let until = std::time::Instant::now() + super::PATIENCE;
    loop {
        let listed = lab.json("api/processes");
        let all = listed["processes"].as_array().expect("processes");
        if let Some(found) = all.iter().find(|one| one["name"] == name && one["state"] == state) {
            return found.clone();
        }
        assert!(std::time::Instant::now() < until, "{listed}");
        std::thread::yield_now();
    }
}

fn wait_for_log(lab: &TestLab, name: &str, lines: usize) {
    let log = lab.home.path().join("checkpoints").join(name).join("train.jsonl");
    let until = std::time::Instant::now() + super::PATIENCE;
    while std::fs::read_to_string(&log).map_or(0, |text| text.lines().count()) < lines {
        assert!(std::time::Instant::now() < until, "no {lines} lines");
        std::thread::yield_now();
    }
}

#[test]
fn trainings_start_stop_and_end_with_the_lab() {
    let mut lab = TestLab::start();
    super::data::collect(&lab, 2);
    assert_eq!(lab.json("api/processes")["families"][0]["id"], "gcbc");
    assert_eq!(lab.post("api/start", &request(json!({}))), (200, "{}".to_owned()));
    wait_for_log(&lab, "cloned", 1);
    let running = wait_for(&lab, "cloned", "running");
    assert_eq!((&running["kind"], &running["what"]), (&json!("training"), &json!("gcbc")));
    assert_eq!(lab.json("api/lines?name=cloned")["lines"][0]["seed"], 5);
    let (status, message) = lab.post("api/start", &request(json!({})));
    assert!(status == 400 && message.contains("choose another name"), "{message}");
    assert_eq!(lab.post("api/start", &request(json!({"name": "broken", "preset": "broken"}))).0, 200);
    assert_eq!(wait_for(&lab, "broken", "failed")["message"], "error: the data is broken");
    assert_eq!(lab.post("api/start", &request(json!({"name": "second"}))).0, 200);
    let (status, message) = lab.post("api/start", &request(json!({"name": "third"})));
    assert!(status == 400 && message.contains("2 run already"), "{message}");
    wait_for_log(&lab, "second", 1);
    assert_eq!(lab.post("api/stop", r#"{"kind": "training", "name": "cloned"}"#).0, 200);
    assert_eq!(wait_for(&lab, "cloned", "stopped")["message"], "", "it can be continued");
    assert_eq!(lab.json("api/lines?name=cloned")["lines"][1]["step"], 2, "it stopped at a safe point");
    assert_eq!(lab.post("api/stop", r#"{"kind": "training", "name": "cloned"}"#).0, 400);
    // The lab ends, and with it the second training.
    let home = std::mem::replace(&mut lab.home, tempfile::tempdir().expect("a folder"));
    drop(lab);
    let log = std::fs::read_to_string(home.path().join("checkpoints/second/train.jsonl")).expect("a log");
    assert_eq!(log.lines().count(), 2, "{log}");
}

#[test]
fn second_training_of_a_name_is_refused_before_the_first_has_a_folder() {
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    let early = request(json!({"preset": "early"}));
    let answers: Vec<(u16, String)> = std::thread::scope(|scope| {
        let both = [(), ()].map(|()| scope.spawn(|| lab.post("api/start", &early)));
        both.map(|one| one.join().expect("an answer")).into()
    });
    let refused: Vec<_> = answers.iter().filter(|(status, _)| *status == 400).collect();
    assert!(refused.len() == 1 && refused[0].1.contains("a training of this name runs"), "{answers:?}");
    assert_eq!(lab.json("api/processes")["processes"].as_array().map(Vec::len), Some(1));
    // Nothing was stored, so that the name is free again.
    assert_eq!(lab.post("api/stop", r#"{"kind": "training", "name": "cloned"}"#).0, 200);
    let stopped = wait_for(&lab, "cloned", "stopped");
    assert!(stopped["message"].as_str().is_some_and(|text| text.contains("nothing to continue")), "{stopped}");
    assert_eq!(lab.post("api/start", &early).0, 200);
}

#[test]
fn training_that_fails_after_it_was_asked_to_stop_has_failed() {
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    assert_eq!(lab.post("api/start", &request(json!({"preset": "failing"}))).0, 200);
    wait_for_log(&lab, "cloned", 1);
    assert_eq!(lab.post("api/stop", r#"{"kind": "training", "name": "cloned"}"#).0, 200);
    assert_eq!(wait_for(&lab, "cloned", "failed")["message"], "error: the disk is full");
}

#[test]
fn requests_to_train_reach_no_other_folder_and_no_other_program() {
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    for change in [
        json!({"name": "../escape"}),
        json!({"name": "/tmp/escape"}),
        json!({"name": "-o"}),
        json!({"name": ""}),
        json!({"dataset": "../datasets/rooms.lance"}),
        json!({"dataset": "hf://datasets/a/b"}),
        json!({"folder": 1}),
        json!({"family": "--recipe"}),
        json!({"preset": "/etc/passwd"}),
        json!({"preset": "tiny.toml"}),
        json!({"steps": 0}),
        json!({"steps": 1_000_000_000}),
        json!({"seed": -1}),
        json!({"settings": ["data.path=/etc"]}),
    ] {
        assert_eq!(lab.post("api/start", &request(change.clone())).0, 400, "{change}");
    }
    for body in [
        "",
        "[]",
        r#"{"name": "cloned"}"#,
        r#"{"kind": "training", "name": "cloned", "signal": 9}"#,
        r#"{"kind": "shell", "name": "cloned"}"#,
        r#"{"kind": "training", "name": 1}"#,
    ] {
        assert_eq!(lab.post("api/stop", body).0, 400, "{body}");
    }
    assert!(!lab.home.path().join("checkpoints").exists() && !lab.home.path().join("escape").exists());
    assert_eq!(lab.json("api/processes")["processes"], json!([]));
}

/// The arguments of a collection or an evaluation that has ended.
fn given(lab: &TestLab, name: &str, folder: &str) -> String {
    wait_for(lab, name, "finished");
    let given = std::fs::read_to_string(lab.home.path().join(folder).join("given")).expect("the arguments");
    given.lines().collect::<Vec<_>>().join(" ")
}

/// Asks for a collection, with some fields changed.
fn collect(lab: &TestLab, change: Value) -> (u16, String) {
    let mut body = json!({
        "command": "collect", "env": "swm/TwoRoom-v1", "policy": "expert", "episodes": 20, "image": 64, "seed": 7,
        "pin": "agent.speed=5;target.color=1,2,3", "variation": "none", "name": "walks",
    });
    change.as_object().expect("fields").iter().for_each(|(key, value)| body[key] = value.clone());
    lab.post("api/start", &body.to_string())
}

/// Asks for an evaluation, with some fields changed.
fn evaluate(lab: &TestLab, change: Value) -> (u16, String) {
    let mut body = json!({
        "command": "evaluate", "env": "swm/TwoRoom-v1", "episodes": 10, "seed": 3, "name": "planned",
        "planner": {
            "model": "simulator", "solver": "cem", "settings": {"samples": 16}, "horizon": 5, "receding": 1, "block": 5,
            "score": "terminal", "warm": true,
        },
        "dataset": {"folder": 0, "name": "rooms.lance"},
    });
    change.as_object().expect("fields").iter().for_each(|(key, value)| body[key] = value.clone());
    lab.post("api/start", &body.to_string())
}

#[test]
fn collections_and_evaluations_are_commands() {
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    let home = lab.home.path().display().to_string();
    assert_eq!(collect(&lab, json!({})), (200, "{}".to_owned()));
    assert_eq!(
        given(&lab, "walks", "datasets/walks.lance"),
        format!(
            "collect swm/TwoRoom-v1 --policy expert --episodes 20 --image 64 --seed 7 --variation none --pin agent.speed=5 \
             target.color=1,2,3 --output {home}/datasets/walks.lance --threads 1"
        )
    );
    assert_eq!(evaluate(&lab, json!({})), (200, "{}".to_owned()));
    assert_eq!(
        given(&lab, "planned", "results/planned"),
        format!(
            "eval simulator --env swm/TwoRoom-v1 --solver cem,samples=16 --horizon 5 --receding-horizon 1 --action-block 5 \
             --score terminal --dataset {home}/datasets/rooms.lance --episodes 10 --seed 3 --output {home}/results/planned \
             --threads 1"
        )
    );
    // What exists is not written again.
    for (status, message) in
        [collect(&lab, json!({})), collect(&lab, json!({"name": "rooms"})), evaluate(&lab, json!({}))]
    {
        assert!(status == 400 && message.contains("choose another name"), "{message}");
    }
}

#[test]
fn requests_to_collect_and_to_evaluate_are_checked() {
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    let planner = |model: &str, solver: &str| {
        json!({"planner": {"model": model, "solver": solver, "horizon": 5, "receding": 1, "block": 5, "score": "terminal",
            "warm": true}})
    };
    for change in [
        json!({"name": "../escape"}),
        json!({"name": "/tmp/escape"}),
        json!({"env": "module:Env-v0"}),
        json!({"env": "CartPole-v1"}),
        json!({"policy": "/tmp/checkpoint"}),
        json!({"policy": "--trust"}),
        json!({"episodes": 0}),
        json!({"episodes": 1_000_000_000}),
        json!({"image": 1_000_000}),
        json!({"pin": "agent.colour=1"}),
        json!({"pin": "agent.speed=1e9"}),
        json!({"pin": "agent.speed=5 --trust"}),
        json!({"variation": "--trust"}),
        json!({"output": "/tmp/x"}),
    ] {
        assert_eq!(collect(&lab, change.clone()).0, 400, "{change}");
    }
    for change in [
        json!({"name": ""}),
        json!({"env": "module:Env-v0"}),
        json!({"episodes": 0}),
        json!({"dataset": {"folder": 0, "name": "../rooms.lance"}}),
        json!({"dataset": "s3://bucket/rooms.lance"}),
        planner("/tmp/checkpoint", "cem"),
        planner("simulator", "module:Solver"),
        json!({"command": "demo"}),
    ] {
        assert_eq!(evaluate(&lab, change.clone()).0, 400, "{change}");
    }
    assert_eq!(lab.json("api/processes")["processes"], json!([]));
}

#[test]
fn fuzzed_bodies_start_no_other_training() {
    use rand::Rng as _;
    let lab = TestLab::start();
    super::data::collect(&lab, 1);
    for i in 0..1_000 {
        let mut rng = swm_core::Key::new(i).with("fuzz of bodies").rng();
        let (route, body) = match i % 3 {
            0 => ("start", request(json!({"preset": "broken"}))),
            1 => ("stop", r#"{"kind": "training", "name": "cloned"}"#.to_owned()),
            _ => ("save", r#"{"folder": 0, "name": "rooms.lance", "target": "cut", "episodes": [9]}"#.to_owned()),
        };
        let mut bytes = body.into_bytes();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..bytes.len());
            match rng.random_range(0..3) {
                0 => bytes[at] = rng.random_range(32..127),
                1 => drop(bytes.remove(at)),
                _ => bytes.insert(at, b"{}[],:\"0-9eE./"[rng.random_range(0..14)]),
            }
        }
        let status = lab.post(&format!("api/{route}"), &String::from_utf8_lossy(&bytes)).0;
        assert!([200, 400].contains(&status), "{status}");
    }
    let listed = lab.json("api/processes");
    for training in listed["processes"].as_array().expect("processes") {
        let name = training["name"].as_str().expect("a name");
        assert!(name.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c)), "{name}");
    }
    let names: Vec<_> =
        std::fs::read_dir(lab.home.path()).expect("the home").flatten().map(|e| e.file_name()).collect();
    assert_eq!(names, ["datasets"], "nothing is written beside it");
}
