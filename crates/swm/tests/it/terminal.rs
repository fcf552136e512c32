//! Tests of what the terminal offers beside the pipeline: completions, manual pages, curves, records of runs, and datasets
//! recognised by their content.

use crate::{Swm, text};
use std::path::Path;

/// Collects a dataset and trains a model of a few steps on it.
fn trained(swm: &Swm) {
    let rooms =
        ["collect", "swm/TwoRoom-v1", "-o", "rooms", "--policy", "explore", "--episodes", "10", "--image", "64"];
    swm.json(&rooms);
    let settings = ["schedule.steps=4", "data.batch_size=8", "log_every=1"];
    swm.json(&[&["train", "pldm", "--data", "rooms", "-o", "model"], &settings[..]].concat());
}

#[test]
fn a_run_continues_from_its_folder_alone() {
    let swm = Swm::new();
    trained(&swm);
    let summary = swm.json(&["train", "--output", "model", "--resume"]);
    assert_eq!(summary["steps"], 4, "{summary}");
    let record = std::fs::read(swm.path("checkpoints/model/run.json")).expect("reading run.json");
    let record: serde_json::Value = serde_json::from_slice(&record).expect("run.json is JSON");
    let [first, second] = &record["commands"].as_array().expect("a list")[..] else { panic!("{record}") };
    assert!(first["command"].to_string().contains("rooms") && second["command"].to_string().contains("--resume"));
    assert!(first["started"].as_str().is_some_and(|date| date.ends_with('Z')) && first["version"].is_string());
    swm.fails(&["train", "--output", "nothing", "--resume"], 2, &["unknown checkpoint 'nothing'"]);
    swm.fails(&["train", "--resume"], 2, &["--output"]);
    options_of_a_continued_run_are_followed_or_refused(&swm);
    // A record names no connection that the user has not chosen.
    let record = record.to_string().replace("\"rooms\"", "\"s3://bucket/rooms.lance\"");
    std::fs::write(swm.path("checkpoints/model/run.json"), record).expect("writing run.json");
    swm.fails(&["train", "--output", "model", "--resume"], 2, &["s3://bucket/rooms.lance", "--data"]);
    let config = swm.json(&["train", "--output", "model", "--resume", "--print-config"]);
    assert_eq!(config["schedule"]["steps"], 4, "printing opens no connection: {config}");
}

/// Options beside `--output` of a run that is continued without its model.
fn options_of_a_continued_run_are_followed_or_refused(swm: &Swm) {
    let before = std::fs::read(swm.path("checkpoints/model/run.json")).expect("reading run.json");
    let resume = ["train", "--output", "model", "--resume"];
    let fails = |more: &[&str], code: i32, parts: &[&str]| swm.fails(&[&resume[..], more].concat(), code, parts);
    fails(&["--data", "nowhere.lance"], 2, &["nowhere.lance"]);
    fails(&["--device", "abacus:0"], 2, &["unknown device 'abacus'"]);
    fails(&["--encoder", "nowhere"], 2, &["--encoder", "trains its own encoder"]);
    let online = ["--preset", "nonsense", "--env", "swm/PendulumControl-v1", "--max-steps", "3"];
    fails(&online, 2, &["--preset, --env", "keeps its configuration, and trains on a dataset", "swm train MODEL"]);
    fails(&["--env", "swm/PendulumControl-v1"], 2, &["model trains on a dataset"]);
    let config = swm.json(&[&resume[..], &["--print-config"]].concat());
    assert_eq!(config["schedule"]["steps"], 4, "{config}");
    let after = std::fs::read(swm.path("checkpoints/model/run.json")).expect("reading run.json");
    assert!(before == after, "a command line that trained nothing is in the record");
    swm.json(&[&resume[..], &["--data", "rooms", "--device", "cpu"]].concat());
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "other", "--policy", "random", "--episodes", "10", "--image", "64"]);
    let before = std::fs::read(swm.path("checkpoints/model/run.json")).expect("reading run.json");
    fails(&["--data", "other"], 2, &["other data"]);
    let after = std::fs::read(swm.path("checkpoints/model/run.json")).expect("reading run.json");
    assert!(before == after, "the command line of a refused continuation is in the record");
    // The same data under another name.
    std::fs::rename(swm.path("datasets/rooms.lance"), swm.path("datasets/moved.lance")).expect("moving the dataset");
    fails(&[], 2, &["rooms"]);
    swm.json(&[&resume[..], &["--data", "moved"]].concat());
}

#[test]
fn a_run_continues_with_the_files_of_the_folder_where_it_was_started() {
    let swm = Swm::new();
    let run_in = |folder: &str, args: &[&str]| {
        std::fs::create_dir_all(swm.path(folder)).expect("making a folder");
        swm.command(args).current_dir(swm.path(folder)).output().expect("swm runs")
    };
    for (folder, seed) in [("a", "1"), ("b", "2")] {
        let collect = ["collect", "swm/TwoRoom-v1", "-o", "d.lance", "--policy", "explore", "--episodes", "10"];
        assert!(run_in(folder, &[&collect[..], &["--image", "64", "--seed", seed]].concat()).status.success());
        let settings = ["schedule.steps=4", "data.batch_size=8", &format!("seed={seed}")];
        let print = ["train", "pldm", "--data", "./d.lance", "--print-config"];
        let preset = run_in(folder, &[&print[..], &settings].concat());
        std::fs::write(swm.path(folder).join("p.toml"), preset.stdout).expect("writing a preset");
    }
    let start = ["train", "pldm", "--data", "d.lance", "--preset", "p.toml", "-o", "../run"];
    let started = run_in("a", &start);
    assert!(started.status.success(), "{}", text(&started.stderr));
    let manifest = || std::fs::read_to_string(swm.path("run/checkpoint/manifest.json")).expect("reading the manifest");
    let first = manifest();
    // As if it had been killed before its first checkpoint.
    let begin_again = || {
        std::fs::remove_dir_all(swm.path("run/checkpoint")).expect("removing the checkpoint");
        std::fs::remove_file(swm.path("run/train.jsonl")).expect("removing the log");
    };
    begin_again();
    let resume = ["train", "-o", "../run", "--resume"];
    let resumed = run_in("b", &resume);
    assert!(resumed.status.success() && manifest() == first, "{}", text(&resumed.stderr));
    begin_again();
    // A training that prepares its data keeps others away.
    let record = || std::fs::read(swm.path("run/run.json")).expect("reading run.json");
    let before = record();
    let lock = swm_core::files::Lock::file(&swm.path("run/run.json")).expect("locking run.json");
    let refused = run_in("a", &start);
    assert!(text(&refused.stderr).contains("another process writes to it"), "{}", text(&refused.stderr));
    drop(lock);
    for (name, option) in [("p.toml", "--preset p.toml"), ("d.lance", "--data d.lance")] {
        std::fs::rename(swm.path("a").join(name), swm.path("a/moved")).expect("moving a file");
        let refused = run_in("b", &resume);
        let error = text(&refused.stderr);
        assert!(!refused.status.success() && error.contains(option) && error.contains("not any more"), "{error}");
        std::fs::rename(swm.path("a/moved"), swm.path("a").join(name)).expect("moving a file");
    }
    assert!(record() == before, "a command line that trained nothing is in the record");
    // A named dataset is no file of that folder.
    std::fs::create_dir_all(swm.path("datasets")).expect("making a folder");
    std::fs::rename(swm.path("a/d.lance"), swm.path("datasets/rooms.lance")).expect("moving the dataset");
    let renamed = String::from_utf8(before).expect("text").replace("\"d.lance\"", "\"rooms\"");
    std::fs::write(swm.path("run/run.json"), renamed).expect("writing run.json");
    std::fs::create_dir(swm.path("b/rooms")).expect("making a folder");
    let resumed = run_in("b", &resume);
    assert!(resumed.status.success() && manifest() == first, "{}", text(&resumed.stderr));
}

#[test]
fn a_run_with_a_checkpoint_continues_in_a_folder_that_was_moved() {
    let swm = Swm::new();
    trained(&swm);
    let project = swm.path("project");
    std::fs::create_dir(&project).expect("making a folder");
    std::fs::rename(swm.path("datasets/rooms.lance"), project.join("d.lance")).expect("moving the dataset");
    let run_in = |folder: &Path, args: &[&str]| swm.command(args).current_dir(folder).output().expect("swm runs");
    let print = ["train", "pldm", "--data", "d.lance", "--print-config", "schedule.steps=2", "data.batch_size=8"];
    std::fs::write(project.join("p.toml"), run_in(&project, &print).stdout).expect("writing a preset");
    let train = ["train", "pldm", "--data", "d.lance", "--preset", "p.toml", "-o", "./run"];
    let started = run_in(&project, &train);
    assert!(started.status.success(), "{}", text(&started.stderr));
    let moved = swm.path("moved");
    std::fs::rename(&project, &moved).expect("moving the folder");
    let resume = ["train", "-o", "./run", "--resume"];
    let resumed = run_in(&moved, &resume);
    assert!(resumed.status.success(), "{}", text(&resumed.stderr));
    // Its content tells the dataset from another one.
    let collect = ["collect", "swm/TwoRoom-v1", "-o", "d.lance", "--episodes", "10", "--image", "64", "--overwrite"];
    assert!(run_in(&moved, &collect).status.success());
    let refused = run_in(&moved, &resume);
    assert!(text(&refused.stderr).contains("other data"), "{}", text(&refused.stderr));
    std::fs::remove_dir_all(moved.join("run/checkpoint")).expect("removing the checkpoint");
    let refused = run_in(&moved, &resume);
    assert!(text(&refused.stderr).contains("has no checkpoint yet"), "{}", text(&refused.stderr));
}

#[test]
fn curves_are_drawn_and_written() {
    let swm = Swm::new();
    trained(&swm);
    let drawn = swm.run(&["plot", "model", "--output", "curves.svg"]);
    assert!(text(&drawn.stdout).contains("loss over step"), "{}", text(&drawn.stderr));
    let svg = std::fs::read_to_string(swm.path("curves.svg")).expect("reading the figure");
    assert!(svg.starts_with("<svg ") && svg.contains("loss over step"));
    swm.fails(&["plot", "model", "--metric", "los"], 2, &["did you mean loss", "--list"]);
    std::fs::write(swm.path("notes.svg"), "mine").expect("writing a file");
    swm.fails(&["plot", "model", "--output", "notes.svg"], 2, &["notes.svg"]);
}

#[test]
fn datasets_are_recognised_by_their_content() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--policy", "expert", "--episodes", "3", "--image", "32"]);
    for (format, name) in [("hdf5", "./one"), ("lance", "./two"), ("lerobot", "./three"), ("folder", "./four")] {
        swm.json(&["convert", "rooms", name, "--format", format]);
        let found = swm.json(&["inspect", name]);
        assert_eq!(found["episodes"], 3, "{format}");
        assert_eq!(found["ranges"]["action"]["max"].as_f64().map(|most| most <= 1.0), Some(true), "{found}");
    }
    assert_eq!(swm.json(&["inspect", "rooms"])["successful_episodes"], 3);
    swm.fails(&["convert", "rooms", "rooms.xyz"], 2, &[".lance", ".h5", "--format"]);
}

#[test]
fn shells_and_man_know_the_commands() {
    let swm = Swm::new();
    for shell in ["bash", "zsh", "fish"] {
        let script = text(&swm.run(&["completions", shell]).stdout);
        assert!(script.contains("goal-offset"), "{shell}");
    }
    let written = text(&swm.run(&["man", "--output", "pages"]).stdout);
    assert!(written.contains("swm-study-run.1") && swm.path("pages/swm-eval.1").is_file(), "{written}");
    let help = text(&swm.run(&["--help"]).stdout);
    for group in ["Data:", "Train:", "Evaluate:", "System:"] {
        assert!(help.contains(group), "{help}");
    }
}
