//! Tests that commands delete only files that the program wrote (docs/security.md).

use crate::Swm;
use std::fs;
use std::path::Path;
use swm::core::files::Lock;

/// A demo of a few seconds in the folder `demo`.
pub(crate) const DEMO: &[&str] =
    &["demo", "-o", "demo", "--episodes", "2", "--eval-episodes", "2", "schedule.steps=2", "schedule.warmup=1"];

/// Writes a file of the user, and its folders.
fn user_file(path: &Path) {
    fs::create_dir_all(path.parent().expect("the path has a parent folder")).expect("creating folders");
    fs::write(path, "thesis").expect("writing a file");
}

fn assert_untouched(path: &Path) {
    assert_eq!(fs::read_to_string(path).expect("reading the user's file"), "thesis", "{}", path.display());
}

#[test]
fn demo_refuses_a_folder_that_it_did_not_make() {
    let swm = Swm::new();
    let files = ["demo/results/thesis.txt", "demo/pldm-rooms/thesis.txt"].map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    swm.fails(DEMO, 2, &["demo", "did not write", "--output"]);
    files.iter().for_each(|path| assert_untouched(path));
}

#[test]
fn demo_continues_where_it_was_killed_while_it_marked_its_folder() {
    let swm = Swm::new();
    fs::create_dir(swm.path("demo")).expect("creating the folder");
    fs::write(swm.path("demo/..swm-demo.4242.tmp"), "`swm demo` ma").expect("writing a part of the mark");
    swm.json(DEMO);
    assert!(!swm.path("demo/..swm-demo.4242.tmp").exists());
}

#[test]
fn second_demo_keeps_files_of_the_user() {
    let swm = Swm::new();
    swm.json(DEMO);
    let files = ["demo/results/thesis.txt", "demo/pldm-rooms/thesis.txt", "demo/pldm-rooms/checkpoint/thesis.txt"]
        .map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    swm.json(DEMO);
    files.iter().for_each(|path| assert_untouched(path));
}

#[test]
fn demo_writes_to_no_folder_that_a_link_names() {
    let swm = Swm::new();
    swm.json(DEMO);
    // Results of the user are files that this program would replace.
    fs::rename(swm.path("demo/results"), swm.path("mine")).expect("moving the results");
    std::os::unix::fs::symlink(swm.path("mine"), swm.path("demo/results")).expect("making a link");
    let before = fs::read(swm.path("mine/run.json")).expect("the record");
    swm.fails(DEMO, 2, &["demo/results", "symbolic link"]);
    assert_eq!(fs::read(swm.path("mine/run.json")).expect("the record"), before);
}

#[test]
fn checkpoint_removal_keeps_files_of_the_user() {
    let swm = Swm::new();
    swm.json(DEMO);
    let run = swm.path("demo/pldm-rooms");
    let outside = swm.path("outside/config.json");
    let files = [run.join("thesis.txt"), run.join("checkpoint/notes/config.json"), outside.clone()];
    files.iter().for_each(|path| user_file(path));
    std::os::unix::fs::symlink(&outside, run.join("raw.safetensors")).expect("making a link");
    std::os::unix::fs::symlink(swm.path("outside"), run.join("best")).expect("making a link");

    swm.fails(&["checkpoints", "remove", "demo/pldm-rooms"], 2, &["not confirmed", "--yes"]);
    assert!(run.join("checkpoint/weights.safetensors").exists());
    let removed = swm.json(&["checkpoints", "remove", "demo/pldm-rooms", "--yes"]);
    assert_eq!(removed["remaining"].as_array().map(Vec::len), Some(4), "{removed}");
    assert!(!run.join("checkpoint/weights.safetensors").exists() && !run.join("train.jsonl").exists());
    files.iter().for_each(|path| assert_untouched(path));
}

#[test]
fn checkpoint_behind_a_link_is_not_called_removed() {
    let swm = Swm::new();
    swm.json(DEMO);
    let (run, outside) = (swm.path("demo/pldm-rooms"), swm.path("outside"));
    fs::rename(run.join("checkpoint"), &outside).expect("moving the checkpoint");
    for name in ["checkpoint", ".checkpoint.old"] {
        std::os::unix::fs::symlink(&outside, run.join(name)).expect("making a link");
        let named = format!("pldm-rooms/{name}");
        swm.fails(&["checkpoints", "remove", "demo/pldm-rooms", "--yes"], 2, &[&named, "symbolic link"]);
        assert!(run.join("train.jsonl").exists() && outside.join("weights.safetensors").exists());
        fs::remove_file(run.join(name)).expect("removing the link");
    }
    fs::rename(&outside, run.join("checkpoint")).expect("moving the checkpoint back");
    swm.json(&["checkpoints", "remove", "demo/pldm-rooms", "--yes"]);
    assert!(!run.exists());
}

#[test]
fn training_does_not_write_through_links() {
    let swm = Swm::new();
    swm.json(DEMO);
    let (thesis, run) = (swm.path("thesis.txt"), swm.path("linked"));
    user_file(&thesis);
    fs::create_dir_all(run.join(".checkpoint.new")).expect("creating folders");
    for name in [".checkpoint.new/config.json", ".checkpoint.new/weights.safetensors"] {
        std::os::unix::fs::symlink(&thesis, run.join(name)).expect("making a link");
    }
    // An event file marks the folder of a run that was killed.
    fs::write(run.join("events.out.tfevents.1.000000000.swm"), "").expect("writing a file");
    let train = |out: &'static str| {
        ["train", "lewm", "--data", "demo/rooms.lance", "-o", out, "schedule.steps=2", "schedule.warmup=1"]
    };
    swm.json(&train("./linked"));
    assert_untouched(&thesis);
    fs::create_dir_all(swm.path("logged")).expect("creating a folder");
    std::os::unix::fs::symlink(&thesis, swm.path("logged/train.jsonl")).expect("making a link");
    swm.fails(&train("./logged"), 2, &["train.jsonl", "symbolic link"]);
    assert_untouched(&thesis);
    // A run whose checkpoint is on another disk would fail at its first checkpoint, and leave a part of it.
    fs::rename(swm.path("linked/checkpoint"), swm.path("disk")).expect("moving the checkpoint");
    std::os::unix::fs::symlink(swm.path("disk"), run.join("checkpoint")).expect("making a link");
    let before = fs::read(run.join("run.json")).expect("the record");
    swm.fails(&["train", "-o", "./linked", "--resume"], 2, &["checkpoint", "symbolic link", "in its place"]);
    assert!(fs::read(run.join("run.json")).is_ok_and(|after| after == before) && !run.join(".checkpoint.old").exists());
}

#[test]
fn outputs_do_not_replace_files_of_the_user() {
    let swm = Swm::new();
    let files = ["site/index.html", "site/results.json"].map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    let eval = |out| ["eval", "random", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "5", "-o", out];
    swm.fails(&eval("site"), 2, &["results.json", "not written by this program"]);
    swm.json(&eval("results"));
    swm.fails(&["report", "results", "-o", "site"], 2, &["index.html", "not written by this program"]);
    files.iter().for_each(|path| assert_untouched(path));
    // The program replaces its own files.
    swm.json(&eval("results"));
    swm.json(&["report", "results", "-o", "page"]);
    swm.json(&["report", "results", "-o", "page"]);
    // The record of the run is checked before the work as well.
    user_file(&swm.path("recorded/run.json"));
    for until in [&[][..], &["--until", "ci=20"]] {
        swm.fails(&[&eval("recorded")[..], until].concat(), 2, &["run.json", "not written by this program"]);
        assert!(!swm.path("recorded/results.json").exists());
    }
    assert_untouched(&swm.path("recorded/run.json"));
    fs::create_dir_all(swm.path("mine")).expect("creating a folder");
    fs::write(swm.path("mine/results.json"), r#"{"my": "thesis", "swm_version": 1}"#).expect("writing a file");
    swm.fails(&eval("mine"), 2, &["results.json", "not written by this program"]);
}

#[test]
fn traces_do_not_replace_files_of_the_user() {
    let swm = Swm::new();
    let eval = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "1", "--budget", "5", "-o", "found"];
    let eval = [&eval[..], &["--solver", "cem,samples=16,iterations=2,elites=4"]].concat();
    let traced = [&eval[..], &["--trace"]].concat();
    swm.json(&eval);
    let file = swm.path("found/traces.json");
    user_file(&file);
    swm.fails(&traced, 2, &["traces.json", "not written by this program"]);
    swm.json(&eval);
    assert_untouched(&file);
    fs::remove_file(&file).expect("removing the user's file");
    // The program replaces its own traces.
    for _ in 0..2 {
        swm.json(&traced);
        assert!(fs::read_to_string(&file).expect("reading the traces").contains("\"simulator\""));
    }
    // Those of other plans do not stay beside new results.
    swm.json(&eval);
    assert!(!file.exists());
    let new = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "1", "--trace", "-o", "new"];
    for shift in ["agent.speed=abc", "agent.speed=1e9"] {
        swm.fails(&[&new[..], &["--shift", shift]].concat(), 2, &["agent.speed"]);
    }
    swm.fails(&[&new[..], &["--shift", "agent.speed=abc"]].concat(), 2, &["--shift agent.speed=abc"]);
    assert!(!swm.path("new").exists());
}

#[test]
fn traces_name_the_conditions_of_their_plans() {
    let swm = Swm::new();
    let eval = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "3", "--budget", "5", "--trace"];
    let plan = ["--solver", "cem,samples=16,iterations=2,elites=4", "--shift", "agent.speed"];
    let plans = |envs: &str| {
        swm.json(&[&eval[..], &plan, &["--envs", envs, "-o", "found"]].concat());
        let text = fs::read(swm.path("found/traces.json")).expect("reading the traces");
        let plans: Vec<serde_json::Value> = serde_json::from_slice(&text).expect("a list");
        let key = |plan: &serde_json::Value| {
            ["condition", "policy", "episode", "replan", "cost"].map(|name| plan[name].to_string())
        };
        plans.iter().map(key).collect::<Vec<_>>()
    };
    let one = plans("1");
    assert_eq!(one, plans("3"));
    let results = fs::read(swm.path("found/results.json")).expect("reading the results");
    let results: serde_json::Value = serde_json::from_slice(&results).expect("results");
    let mut conditions: Vec<&str> = one.iter().map(|plan| &*plan[0]).collect();
    conditions.dedup();
    let named: Vec<String> =
        results["runs"].as_array().expect("runs").iter().map(|run| run["condition"].to_string()).collect();
    assert!(
        conditions.len() == 2 && conditions.iter().all(|name| named.contains(&(*name).to_owned())),
        "{conditions:?}"
    );
    let mut keys: Vec<_> = one.iter().map(|plan| &plan[..4]).collect();
    keys.sort();
    keys.dedup();
    assert_eq!(keys.len(), one.len(), "every plan has its own condition, policy, episode and number");
}

#[test]
fn previews_videos_and_images_do_not_replace_files_of_the_user() {
    let swm = Swm::new();
    swm.json(DEMO);
    let names = ["shown/episode_0.mp4", "site/videos/random-in-distribution-0.mp4", "thesis.png"];
    let files = names.map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    let eval = ["eval", "random", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "5", "--videos", "1", "-o"];
    let probe = ["probe", "demo/pldm-rooms", "--data", "demo/rooms.lance", "--steps", "1", "--frames", "8", "--images"];
    let preview = ["preview", "demo/rooms.lance", "-o"];
    let refused = "was not written by this program";
    let with = |args: &[&'static str], last: &'static str| [args, &[last]].concat();
    swm.fails(&with(&preview, "shown"), 2, &["episode_0.mp4", refused]);
    swm.fails(&with(&eval, "site"), 2, &[".mp4", refused]);
    swm.fails(&with(&probe, "thesis.png"), 2, &["thesis.png", refused]);
    files.iter().for_each(|path| assert_untouched(path));
    assert!(!swm.path("shown/contact_sheet.png").exists());
    // The program replaces its own files.
    for _ in 0..2 {
        swm.json(&with(&preview, "preview"));
        swm.json(&with(&eval, "results"));
    }
}

/// An evaluation that is killed leaves videos in `.new`, which the next one deletes, and nothing else there.
#[test]
fn of_videos_that_waited_only_those_of_the_program_are_deleted() {
    let swm = Swm::new();
    let eval = ["eval", "random", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "5", "--videos", "1", "-o"];
    let with = |output| [&eval[..], &[output]].concat();
    swm.json(&with("out"));
    assert!(!swm.path("out/.new").exists());
    let files = ["out/.new/videos/holiday-2024.png", "out/.new/videos/cat-1.mp4"].map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    let left = swm.path("out/.new/videos/random-in-distribution-7.mp4");
    fs::copy(swm.path("out/videos/random-in-distribution-0.mp4"), &left).expect("copying");
    swm.json(&with("out"));
    files.iter().for_each(|path| assert_untouched(path));
    assert!(!left.exists());
    // A link would lead elsewhere.
    fs::create_dir_all(swm.path("linked/.new")).expect("creating a folder");
    std::os::unix::fs::symlink(swm.path("out"), swm.path("linked/.new/videos")).expect("making a link");
    swm.fails(&with("linked"), 2, &["linked/.new/videos", "symbolic link"]);
}

#[test]
fn what_a_kill_leaves_of_an_image_is_deleted_by_the_next_of_its_name() {
    let swm = Swm::new();
    let demo = ["demo", "-o", "demo", "--episodes", "40", "--eval-episodes", "2", "schedule.steps=2"];
    swm.json(&[&demo[..], &["schedule.warmup=1"]].concat());
    [".rooms.png.77.tmp", ".other.png.77.tmp"].iter().for_each(|name| user_file(&swm.path(name)));
    let probe = ["probe", "demo/pldm-rooms", "--data", "demo/rooms.lance", "--steps", "1", "--frames", "8"];
    swm.json(&[&probe[..], &["--images", "rooms.png"]].concat());
    assert!(swm.path("rooms.png").exists() && !swm.path(".rooms.png.77.tmp").exists());
    assert_untouched(&swm.path(".other.png.77.tmp"));
}

#[test]
fn what_kills_leave_of_pages_and_videos_is_deleted() {
    let swm = Swm::new();
    let write = |name: &str| fs::write(swm.path(name), "cut off").expect("writing a file");
    fs::create_dir_all(swm.path("man")).expect("creating a folder");
    fs::create_dir_all(swm.path("out/videos")).expect("creating a folder");
    let own = [
        "man/.swm.1.77.tmp",
        "man/.swm-study-run.1.77.tmp",
        "out/.results.json.77.tmp",
        "out/.run.json.77.tmp",
        "out/videos/.random-in-distribution-0.mp4.77.tmp",
        "out/videos/.random-in-distribution-0.png.77.tmp",
    ];
    let others =
        ["man/.swm-notes.1.77.tmp", "man/.swm.1.tmp", "out/videos/.holiday.mp4.77.tmp", "out/videos/a-0.mp4.77.tmp"];
    own.into_iter().chain(others).for_each(write);
    swm.json(&["man", "-o", "man"]);
    let eval = "eval random --env swm/TwoRoom-v1 --episodes 1 --budget 3 --videos 0 -o out";
    swm.json(&eval.split(' ').collect::<Vec<_>>());
    own.iter().for_each(|name| assert!(!swm.path(name).exists(), "{name}"));
    others.iter().for_each(|name| assert!(swm.path(name).exists(), "{name}"));
}

#[test]
fn demo_does_not_take_a_file_of_the_user_for_its_mark() {
    let swm = Swm::new();
    let files = ["demo/.swm-demo", "demo/results/thesis.txt"].map(|name| swm.path(name));
    files.iter().for_each(|path| user_file(path));
    swm.fails(DEMO, 2, &["demo", "did not write", "--output"]);
    files.iter().for_each(|path| assert_untouched(path));
}

#[test]
fn checkpoints_are_removed_by_paths_that_end_in_dots() {
    for end in [".", "checkpoint/.."] {
        let swm = Swm::new();
        swm.json(DEMO);
        let run = swm.path("demo/pldm-rooms");
        swm.json(&["checkpoints", "remove", &format!("demo/pldm-rooms/{end}"), "--yes"]);
        assert!(!run.exists(), "{end}");
    }
}

#[test]
fn dataset_paths_may_contain_parent_folders() {
    let swm = Swm::new();
    fs::create_dir_all(swm.path("a/b")).expect("creating folders");
    let collect = ["collect", "swm/TwoRoom-v1", "-o", "a/b/../rooms.lance", "--episodes", "1", "--max-steps", "3"];
    swm.json(&collect);
    assert!(swm.path("a/rooms.lance").is_dir());
    assert_eq!(swm.json(&["inspect", "a/b/../rooms.lance"])["episodes"], 1);
}

#[test]
fn empty_names_are_refused() {
    let swm = Swm::new();
    let file = swm.path("checkpoints/thesis.txt");
    user_file(&file);
    fs::write(swm.path("checkpoints/config.json"), r#"{"family": "lewm"}"#).expect("writing a file");
    swm.fails(&["checkpoints", "remove", "", "--yes"], 2, &["name of a checkpoint", "is empty"]);
    swm.fails(&["train", "lewm", "--data", "", "-o", "x"], 2, &["name of a dataset", "is empty"]);
    assert_untouched(&file);
    assert!(swm.path("checkpoints/config.json").exists());
}

#[test]
fn training_does_not_replace_files_of_the_user() {
    fn train(out: &str) -> [&str; 8] {
        ["train", "lewm", "--data", "demo/rooms.lance", "-o", out, "schedule.steps=2", "schedule.warmup=1"]
    }
    let swm = Swm::new();
    swm.json(DEMO);
    for place in [
        "a/train.jsonl",
        "b/checkpoint/weights.safetensors",
        "c/.checkpoint.old/state.json",
        "d/.checkpoint.new/manifest.json",
        "e/best/checkpoint/weights.safetensors",
        "f/checkpoint",
    ] {
        let file = swm.path(place);
        user_file(&file);
        swm.fails(&train(&format!("./{}", &place[..1])), 2, &["choose another"]);
        assert_untouched(&file);
        let record = swm.path(&place[..1]).join("run.json");
        assert!(!record.exists(), "{place}: a refused training leaves a record, and its folder is no run");
    }
    fs::write(swm.path("a/train.jsonl"), "{\"step\": 1}\n").expect("writing a log of another program");
    swm.fails(&train("./a"), 2, &["train.jsonl", "not written by this program"]);

    // What a run leaves that was killed while it wrote its first checkpoint is replaced.
    swm.json(&train("./killed"));
    let (whole, new) = (swm.path("killed/checkpoint"), swm.path("killed/.checkpoint.new"));
    fs::rename(&whole, &new).expect("renaming the checkpoint");
    fs::remove_file(new.join("manifest.json")).expect("removing a file of the checkpoint");
    // Copies of a checkpoint that the user made stay.
    let copies =
        ["killed/checkpoint.old/weights.safetensors", "killed/checkpoint.new/config.json"].map(|file| swm.path(file));
    copies.iter().for_each(|file| user_file(file));
    swm.json(&train("./killed"));
    assert!(whole.join("manifest.json").is_file() && !new.exists());
    copies.iter().for_each(|file| assert_untouched(file));
}

#[test]
fn export_replaces_nothing() {
    fn export(folder: &str) -> [&str; 4] {
        ["checkpoints", "export", "zoo:two-room/pldm", folder]
    }
    let swm = Swm::new();
    let refused = "holds a checkpoint already";
    for place in [
        "a/checkpoint/weights.safetensors",
        "b/checkpoint/config.json",
        "c/.checkpoint.old/config.json",
        "d/.checkpoint.new/config.json",
        "e/checkpoint",
        "f/train.jsonl",
    ] {
        let (file, folder) = (swm.path(place), &place[..1]);
        user_file(&file);
        swm.fails(&export(folder), 2, &[refused]);
        assert_untouched(&file);
        assert_eq!(fs::read_dir(swm.path(folder)).expect("listing the folder").count(), 1, "{place}");
    }
    fs::create_dir_all(swm.path("linked")).expect("creating a folder");
    std::os::unix::fs::symlink("nowhere", swm.path("linked/checkpoint")).expect("making a link");
    swm.fails(&export("linked"), 2, &[refused]);

    let held = Lock::folder(&swm.path("held")).expect("locking the folder as training does");
    swm.fails(&export("held"), 2, &["another process writes to it"]);
    drop(held);
    swm.json(&export("held"));
    assert!(swm.path("held/checkpoint/weights.safetensors").is_file());
}

#[test]
fn capsules_of_the_zoo_are_not_removed() {
    let swm = Swm::new();
    let file = swm.path("zoo/maze/model.safetensors");
    user_file(&file);
    let remove = ["checkpoints", "remove", "zoo:maze/model", "--yes"];
    swm.fails(&remove, 2, &["zoo/maze/model.safetensors", "delete the file by hand"]);
    assert_untouched(&file);
}

#[test]
fn unfinished_exports_leave_nothing_or_can_be_removed() {
    let swm = Swm::new();
    // The limit of a file stands for a full disk: the configuration fits, the weights do not.
    let export = format!("ulimit -f 16; exec {} checkpoints export zoo:two-room/pldm full", env!("CARGO_BIN_EXE_swm"));
    let mut shell = std::process::Command::new("sh");
    let failed = shell.args(["-c", &export]).current_dir(swm.home()).output().expect("a shell");
    assert_eq!(failed.status.code(), Some(1), "{}", crate::text(&failed.stderr));
    assert!(!swm.path("full").exists());

    // What a kill leaves.
    swm.json(&["checkpoints", "export", "zoo:two-room/pldm", "killed"]);
    let new = swm.path("killed/.checkpoint.new");
    fs::rename(swm.path("killed/checkpoint"), &new).expect("renaming the checkpoint");
    fs::remove_file(new.join("manifest.json")).expect("removing a file");
    fs::rename(new.join("weights.safetensors"), new.join(".weights.safetensors.7.tmp")).expect("renaming a file");
    user_file(&new.join("thesis.txt"));
    swm.json(&["checkpoints", "remove", "./killed", "--yes"]);
    assert_untouched(&new.join("thesis.txt"));
    assert_eq!(fs::read_dir(&new).expect("listing the folder").count(), 1);
    // A kill before the configuration was complete.
    for (name, left) in [("empty", None), ("begun", Some(".config.json.7.tmp"))] {
        let new = swm.path(name).join(".checkpoint.new");
        fs::create_dir_all(&new).expect("creating a folder");
        left.iter().for_each(|file| fs::write(new.join(file), "{").expect("writing a file"));
        swm.json(&["checkpoints", "remove", &format!("./{name}"), "--yes"]);
        assert!(!swm.path(name).exists(), "{name}");
    }
    // Another folder of that name is no checkpoint.
    user_file(&swm.path("mine/.checkpoint.new/config.json.tmp"));
    swm.fails(&["checkpoints", "remove", "./mine", "--yes"], 1, &["not a checkpoint"]);
    user_file(&swm.path("mine/.checkpoint.new/config.json"));
    swm.fails(&["checkpoints", "remove", "./mine", "--yes"], 1, &["not a checkpoint"]);
}
