//! The studies of this program at their small sizes: kills, other kinds of cells, datasets that a study collects.

use crate::study::contents;
use crate::{Swm, text};
use std::process::Stdio;
use std::time::Instant;
use swm::core::Key;

/// Kills a small study at random moments, completes it, and compares all its bytes and those of its page with an
/// uninterrupted run.
fn killed(study: &str, settings: &[&str], kills: u64) {
    let swm = Swm::new();
    let whole = [&["study", "run", study, "--small", "--output", "whole"], settings].concat();
    let start = Instant::now();
    swm.json(&whole);
    let duration = start.elapsed();
    swm.json(&["study", "report", "whole"]);

    // From another empty home. Each attempt lasts twice its share on average, so that the kills meet all parts of the work.
    let other = Swm::new();
    let args = [&["study", "run", study, "--small", "--output", "killed"], settings].concat();
    for moment in 0..kills {
        let mut child = other.command(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("swm starts");
        let part = (Key::new(0).with(study).at(moment).seed() >> 32) as f64 / f64::from(u32::MAX);
        std::thread::sleep(duration.mul_f64(part * (2.0 / kills as f64).min(1.0)));
        // The study may be done already.
        let _ = child.kill();
        child.wait().expect("the process ends");
    }
    other.json(&args);
    other.json(&["study", "report", "killed"]);
    let (mut whole, mut killed) = (contents(&swm.path("whole")), contents(&other.path("killed")));
    // A model is beside a log of its training, which has times.
    for files in [&mut whole, &mut killed] {
        files.retain(|name, _| !name.starts_with("models/"));
    }
    // The command on the page names no folder of this run, so that pages are equal, too.
    assert_eq!(killed.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>(), "{study}");
    killed.retain(|name, bytes| whole.get(name) != Some(bytes));
    assert!(killed.is_empty(), "{study} after {kills} kills differs in {:?}", killed.keys());
}

#[test]
fn a_killed_study_ends_in_the_same_bytes() {
    killed("two-room/colour-wheel", &["episodes=2"], 3);
}

#[test]
#[ignore = "twenty kills of each study: a minute"]
fn twenty_kills_of_every_study_end_in_the_same_bytes() {
    for study in [
        "paper/baselines",
        "paper/colour-wheel",
        "paper/distractors",
        "paper/factors",
        "paper/shift",
        "two-room/colour-wheel",
        "two-room/shift",
    ] {
        killed(study, &["episodes=6"], 20);
    }
    killed("paper/factors-per-env", &[], 20);
}

#[test]
#[ignore = "twenty kills of each study that trains: minutes"]
fn twenty_kills_of_studies_that_train_end_in_the_same_bytes() {
    killed("paper/drift", &["episodes=2", "steps=50", "frames=300"], 20);
    killed("paper/online", &["steps=60", "warmup=40", "episodes=2", "max-steps=20"], 20);
}

#[test]
fn factors_are_counted_beside_published_ones() {
    let swm = Swm::new();
    let args = ["study", "run", "paper/factors-per-env", "--output", "factors"];
    let table = swm.json(&args);
    let rows = table["rows"].as_array().expect("rows");
    let row =
        |name: &str| rows.iter().find(|row| row["name"] == name).unwrap_or_else(|| panic!("{name}"))["values"].clone();
    let ours =
        swm.json(&["fovs", "swm/TwoRoom-v1"])["variation"].as_object().map(serde_json::Map::len).expect("factors");
    let wrappers = swm.json(&["wrappers"]).as_object().map(serde_json::Map::len).expect("wrappers");
    assert_eq!(row("swm/TwoRoom-v1"), serde_json::json!([ours as f64, (ours + wrappers) as f64, 17.0, 28.0]));
    assert_eq!(row("Atari"), serde_json::json!([0.0, wrappers as f64, 0.0, 11.0]));
    assert_eq!(row("swm/PushT-Discrete-v1")[2], serde_json::Value::Null);
    let first = contents(&swm.path("factors"));
    swm.json(&args);
    assert!(contents(&swm.path("factors")) == first, "a second run changes nothing");
    swm.json(&["study", "report", "factors"]);
    let page = std::fs::read_to_string(swm.path("factors/report/index.html")).expect("the page");
    assert!(
        page.contains("swm/TwoRoom-v1")
            && page.contains("swm study run paper/factors-per-env --output factors-per-env")
    );
    let csv = text(&swm.run(&["study", "export", "factors"]).stdout);
    assert!(csv.starts_with("cell,environment,\"native, factors\","), "{csv}");
    swm.fails(&["study", "export", "factors", "--format", "csv-seeds"], 2, &["training seeds", "csv"]);
    swm.fails(
        &["study", "run", "two-room/colour-wheel", "--output", "factors"],
        2,
        &["Factors of variation per environment", "Colour of the agent in Two-Room"],
    );
    swm.fails(&["study", "run", "paper/baselines", "--output", "out"], 2, &["push-t/tdmpc2", "swm zoo"]);
    assert!(!swm.path("datasets").exists(), "nothing is collected for a study whose models are missing");
    swm.fails(&["study", "run", "paper/factors-per-env", "--commands"], 2, &["no cell"]);
}

#[test]
fn formats_are_measured_and_an_object_store_only_where_it_is_named() {
    let swm = Swm::new();
    let settings = ["envs=[\"swm/TwoRoom-v1\"]", "layouts=[\"lance, jpeg\", \"hdf5\"]", "remote-layouts=[\"hdf5\"]"];
    let quick = ["episodes=3", "steps=30", "size=16", "batch=4", "repeats=1", "seconds=0.01"];
    let args = [&["study", "run", "paper/data", "--small", "--output", "data"], &settings[..], &quick].concat();
    let table = swm.json(&args);
    assert_eq!((table["cells"].as_u64(), table["done"].as_u64()), (Some(3), Some(2)));
    let rows = table["rows"].as_array().expect("rows");
    assert_eq!(rows[2]["name"], "swm/TwoRoom-v1, hdf5, object store");
    assert!(rows[2]["values"].as_array().is_some_and(|values| values.iter().all(serde_json::Value::is_null)));
    for row in &rows[..2] {
        let values: Vec<f64> =
            row["values"].as_array().into_iter().flatten().filter_map(serde_json::Value::as_f64).collect();
        assert!(values.len() == 4 && values.iter().all(|value| *value > 0.0), "{row}");
        assert!(row["machine"].as_str().is_some_and(|machine| machine.contains("threads")), "{row}");
    }
    let first = contents(&swm.path("data/cells"));
    assert_eq!(swm.json(&args)["rows"], table["rows"], "measured rows stay as they are");
    assert!(contents(&swm.path("data/cells")) == first);
    swm.json(&["study", "report", "data"]);
    assert!(swm.path("data/report/figures/dots-1.svg").exists());
    swm.fails(&[&args[..], &["sizes=3"]].concat(), 2, &["sizes", "did you mean size"]);
}

/// A study of latents, with a small model and few episodes.
const DRIFT: &str = r#"
kind = "drift"
title = "Drift"
question = "Does the actor drift?"
[defaults]
env = "swm/PushT-v1"
dataset = "few-states"
train = ["model.encoding=[{column=\"state\",latent=16}]"]
steps = 20
episodes = 3
max-steps = 20
frames = 200
[[collect]]
name = "few-states"
env = "swm/PushT-v1"
policy = "expert"
episodes = 20
max-steps = 30
no-pixels = true
"#;

#[test]
fn drift_is_measured_in_the_latents_of_a_trained_model() {
    let swm = Swm::new();
    std::fs::write(swm.path("drift.toml"), DRIFT).expect("writing the study");
    swm.fails(&["study", "run", "drift.toml", "--output", "out"], 2, &["few-states", "--trust"]);
    // The output is checked before datasets are collected.
    std::fs::create_dir(swm.path("used")).expect("a folder");
    std::fs::write(swm.path("used/notes.txt"), "mine").expect("a file");
    let used = ["study", "run", "drift.toml", "--output", "used", "--trust"];
    swm.fails(&used, 2, &["has files and no study.json"]);
    assert!(!swm.path("datasets").exists(), "a dataset was collected");
    let run = ["study", "run", "drift.toml", "--output", "out", "--trust"];
    let table = swm.json(&run);
    let rows = table["rows"].as_array().expect("rows");
    let names: Vec<&str> = rows.iter().filter_map(|row| row["name"].as_str()).collect();
    assert_eq!(names, ["held-out episodes", "expert", "TD-MPC2's actor", "TD-MPC2's planner", "random policy"]);
    let values = |row: usize| -> Vec<f64> {
        rows[row]["values"].as_array().into_iter().flatten().filter_map(serde_json::Value::as_f64).collect()
    };
    assert!((0..5).all(|row| values(row).len() == 7 && values(row).iter().all(|value| *value >= 0.0)), "{table}");
    // 1 % of the held-out frames are outside, by definition.
    assert!(values(0)[5] < 5.0, "{table}");
    let paths = |row: usize| rows[row]["paths"].as_array().map_or(0, Vec::len);
    assert!(paths(0) > 10, "a dot for each held-out frame");
    assert_eq!([paths(1), paths(2), paths(4)], [3, 3, 3], "a path for each episode");
    let first = contents(&swm.path("out"));
    let is_model = |name: &String| name.starts_with("models/tdmpc2-") && name.ends_with("/weights.safetensors");
    assert!(first.keys().any(is_model), "the model is in the folder of the study");
    assert!(!swm.path("checkpoints").exists(), "and not in the home folder");
    swm.json(&run);
    assert!(contents(&swm.path("out")) == first, "a second run changes nothing");
    swm.json(&["study", "report", "out"]);
    assert!(swm.path("out/report/figures/paths-1.svg").exists());
    // Another empty home gives the same values: nothing depends on what was there.
    let other = Swm::new();
    std::fs::write(other.path("drift.toml"), DRIFT).expect("writing the study");
    assert_eq!(other.json(&run)["rows"], table["rows"]);
    // Nothing is trained through a link.
    std::fs::rename(swm.path("out/models"), swm.path("elsewhere")).expect("moving the models");
    std::os::unix::fs::symlink(swm.path("elsewhere"), swm.path("out/models")).expect("a link");
    std::fs::remove_dir_all(swm.path("out/cells")).expect("removing the rows");
    swm.fails(&run, 2, &["out/models", "is a symbolic link"]);
}

/// A study that collects its dataset.
const RECORDED: &str = r#"
title = "Recorded starts"
question = "Do plans reach recorded goals?"
[[collect]]
name = "few-rooms"
env = "swm/TwoRoom-v1"
policy = "explore"
episodes = 12
max-steps = 40
image = 64
[defaults]
env = "swm/TwoRoom-v1"
episodes = 4
budget = 10
goal-offset = 10
predict = 2
solver = "cem,samples=4,iterations=1,elites=2"
[[starts]]
name = "all"
dataset = "few-rooms"
[[starts]]
name = "training episodes"
dataset = "few-rooms"
split = "train"
[[condition]]
name = "as recorded"
[[policy]]
name = "PLDM"
policy = "zoo:two-room/pldm"
[[policy]]
name = "expert"
policy = "expert"
starts = "all"
[small.defaults]
episodes = 3
[[small.collect]]
name = "few-rooms"
env = "swm/TwoRoom-v1"
policy = "explore"
episodes = 12
max-steps = 40
image = 64
"#;

#[test]
fn a_study_collects_the_datasets_that_it_needs() {
    let swm = Swm::new();
    let study = RECORDED;
    std::fs::write(swm.path("study.toml"), study).expect("writing the study");
    // A stranger's file may not write to the home folder.
    swm.fails(&["study", "run", "study.toml", "--output", "out"], 2, &["few-rooms", "--trust"]);
    let run = ["study", "run", "study.toml", "--output", "out", "--trust"];
    let results = swm.json(&run);
    let rows = results["rows"].as_array().expect("rows");
    let names: Vec<_> = rows.iter().map(|row| (row["starts"].as_str(), row["policy"].as_str())).collect();
    let pair = |starts, policy| (Some(starts), Some(policy));
    assert_eq!(names, [pair("all", "PLDM"), pair("all", "expert"), pair("training episodes", "PLDM")]);
    // Another dataset than that of the training, of which these may be a part.
    assert!(rows.iter().all(|row| row["trained_on_starts"].is_null()));
    let errors = &rows[0]["prediction"];
    let counted = [&errors["solved"], &errors["failed"]].map(|list| list.as_array().map_or(0, Vec::len));
    assert!(counted[0] + counted[1] > 0 && rows[1]["prediction"].is_null(), "{errors}");
    let played = &rows[0]["played"]["errors"];
    let kept = ["solved", "failed"].map(|kind| played[kind].as_array().map_or(0, Vec::len));
    assert!(kept[0] + kept[1] > 0 && rows[1]["played"].is_null(), "{played}");
    assert_eq!(swm.json(&["inspect", "few-rooms"])["episodes"], 12);
    swm.json(&["study", "report", "out"]);
    let page = std::fs::read_to_string(swm.path("out/report/index.html")).expect("the page");
    assert!(page.contains("Does the prediction error predict success?"));
    let csv = text(&swm.run(&["study", "export", "out"]).stdout);
    assert!(csv.lines().next().is_some_and(|line| line.ends_with(",optimism,optimism_low,optimism_high")), "{csv}");
    let small = swm.json(&["study", "run", "study.toml", "--small", "--output", "small", "--trust"]);
    assert_eq!(
        (small["title"].as_str(), &small["rows"][0]["success"]["n"].as_u64().map(|n| n <= 3)),
        (Some("Recorded starts, small"), &Some(true))
    );
    let commands = text(&swm.run(&["study", "run", "study.toml", "--commands"]).stdout);
    assert!(commands.starts_with("swm collect --output=few-rooms ") && commands.lines().count() == 4, "{commands}");
    std::fs::write(swm.path("study.toml"), study.replace("starts = \"all\"", "starts = \"al\""))
        .expect("writing the study");
    swm.fails(&run, 2, &["source of starts", "al", "all"]);
    std::fs::write(swm.path("study.toml"), study.split("[small.defaults]").next().expect("a part"))
        .expect("writing the study");
    swm.fails(&["study", "run", "study.toml", "--small", "--output", "none"], 2, &["small size", "[small.defaults]"]);
}

/// A study of the expert from the starts of a dataset that it collects.
const PLAYED: &str = r#"
title = "Recorded goals"
question = "Are recorded goals reached?"
[[collect]]
name = "rooms"
env = "swm/TwoRoom-v1"
policy = "expert"
episodes = 3
max-steps = 30
no-pixels = true
[defaults]
env = "swm/TwoRoom-v1"
episodes = 2
budget = 5
goal-offset = 5
no-pixels = true
[[starts]]
name = "recorded"
dataset = "rooms"
[[condition]]
name = "as recorded"
[[policy]]
name = "expert"
policy = "expert"
"#;

#[test]
fn a_study_uses_no_other_dataset_than_the_one_that_it_collects() {
    let swm = Swm::new();
    let write = |text: &str| std::fs::write(swm.path("study.toml"), text).expect("writing the study");
    let run = |output| ["study", "run", "study.toml", "--output", output, "--trust"];
    write(PLAYED);
    let first = swm.json(&run("first"));
    // What an earlier study collected is used.
    assert_eq!(swm.json(&run("second"))["rows"], first["rows"]);
    let hash = swm.json(&["inspect", "rooms", "--checksum"])["content_hash"].as_str().expect("a hash").to_owned();
    let recorded = format!("hash = \"{hash}\"");
    for (from, to, parts) in [
        (
            "policy = \"expert\"",
            "policy = \"random\"",
            &["policy \"expert\"", "'rooms' asks for policy \"random\"", &recorded][..],
        ),
        ("episodes = 3", "episodes = 3\nseed = 9", &["seed 0", "seed 9"]),
        ("max-steps = 30", "max-steps = 20", &["max_episode_steps 30", "max_episode_steps 20"]),
        ("episodes = 3", "episodes = 2", &["3 episodes", "'rooms' asks for 2", "more-episodes = true"]),
    ] {
        write(&PLAYED.replacen(from, to, 1));
        swm.fails(&run("third"), 2, &[&["study.toml", "rooms.lance", "move"], parts].concat());
        assert!(!swm.path("third").exists(), "{to}");
    }
    // A dataset with the hash that the table names is the one.
    write(&PLAYED.replacen("episodes = 3", &format!("episodes = 2\nhash = \"{hash}\""), 1));
    assert_eq!(swm.json(&run("fourth"))["rows"], first["rows"]);
    write(&PLAYED.replacen("episodes = 3", "episodes = 2\nmore-episodes = true", 1));
    assert_eq!(swm.json(&run("fifth"))["rows"], first["rows"]);
    let commands = text(&swm.run(&["study", "run", "study.toml", "--commands"]).stdout);
    assert!(commands.starts_with("swm collect --output=rooms ") && !commands.contains("more"), "{commands}");
}

#[test]
fn a_registered_study_says_whether_it_is_still_the_same() {
    let swm = Swm::new();
    let study = r#"
title = "Registered"
question = "Does the expert see colours?"
[defaults]
env = "swm/TwoRoom-v1"
episodes = 2
budget = 5
no-pixels = true
[[condition]]
name = "in distribution"
[[condition]]
name = "red"
pin = { "agent.color" = "255,0,0" }
[[policy]]
name = "expert"
policy = "expert"
"#;
    std::fs::write(swm.path("study.toml"), study).expect("writing the study");
    let register = ["study", "register", "study.toml", "--output", "out"];
    let first = swm.json(&register);
    let [hash, date] = ["registered", "unproven_date"].map(|key| first[key].as_str().expect("a text").to_owned());
    assert!(date.len() == 20 && date.starts_with("20") && date.ends_with('Z'), "{date}");
    // As if it had been registered a year ago: without results it can be registered again, and keeps its date.
    let file = swm.path("out/registration.json");
    let stored = std::fs::read_to_string(&file).expect("the registration");
    let (this, date) = (date, "2025-11-24T01:02:03Z");
    for wrong in ["2020-99-99T01:02:03Z", "yesterday", "2025-11-24T01:02:03Z\\nverified"] {
        std::fs::write(&file, stored.replace(&this, wrong)).expect("a wrong date");
        swm.fails(&register, 1, &["registration.json", "unproven_date is no date"]);
    }
    std::fs::write(&file, stored.replace(&this, date)).expect("an older date");
    let again = swm.json(&register);
    assert_eq!((again["registered"].as_str(), again["unproven_date"].as_str()), (Some(&*hash), Some(date)));
    let run = ["study", "run", "study.toml", "--output", "out"];
    let registration = swm.json(&run)["registration"].clone();
    assert_eq!(registration, serde_json::json!({"hash": hash, "is_same": true, "date": date}));
    let status = text(&swm.run(&["study", "status", "out"]).stdout);
    assert!(status.contains(&hash) && status.contains("date unproven") && status.contains(date), "{status}");
    swm.fails(&register, 2, &["has results already", "empty folder"]);
    // The families are no part of any cell: all cells are done, but it is another study.
    std::fs::write(swm.path("study.toml"), format!("families = []\n{study}")).expect("writing the study");
    let registration = swm.json(&run)["registration"].clone();
    assert_eq!(registration, serde_json::json!({"hash": hash, "is_same": false, "date": date}));
    swm.json(&["study", "report", "out"]);
    let page = std::fs::read_to_string(swm.path("out/report/index.html")).expect("the page");
    assert!(page.contains("<b>This study differs from its registration"), "the page hides that the study was changed");
    swm.fails(&["study", "register", "paper/factors-per-env", "--output", "none"], 2, &["no evaluations"]);
}
