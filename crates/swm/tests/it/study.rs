//! `swm study`: files, cells, interruption, tables.

use crate::{Swm, text};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

/// A study of 12 cells that takes about a second.
const STUDY: &str = r#"
title = "Colours in Two-Room"
question = "Does the expert see colours?"

[defaults]
env = "swm/TwoRoom-v1"
episodes = 6
budget = 40
image = "32"
seed = [0, 1]

[[condition]]
name = "in distribution"

[[condition]]
name = "{what} at hue {hue}"
pin = { "{what}.color" = "hsv({hue},1,1)" }
each = { what = ["agent"], hue = [0, 240] }

[[policy]]
name = "planner"
policy = "expert"

[[policy]]
name = "chance"
policy = "random"
"#;

/// The files of a folder and their contents.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).expect("reading a folder").flatten() {
        let (name, path) = (entry.file_name().to_string_lossy().into_owned(), entry.path());
        if path.is_dir() {
            files.extend(contents(&path).into_iter().map(|(inner, bytes)| (format!("{name}/{inner}"), bytes)));
        } else {
            files.insert(name, std::fs::read(&path).expect("reading a file"));
        }
    }
    files
}

fn with_study() -> Swm {
    let swm = Swm::new();
    std::fs::write(swm.path("study.toml"), STUDY).expect("writing the study");
    swm
}

#[test]
fn study_pairs_conditions_and_resumes_to_the_same_bytes() {
    let swm = with_study();
    let results = swm.json(&["study", "run", "study.toml", "--output", "whole"]);
    assert_eq!((results["cells"].as_u64(), results["done"].as_u64()), (Some(12), Some(12)));
    let rows = results["rows"].as_array().expect("rows");
    assert_eq!(rows.len(), 12);
    for row in rows {
        let unshifted = row["condition"] == "in distribution";
        assert_eq!(row["gap"].is_null(), unshifted, "{row}");
        // The agent's colour does not change what the expert does.
        assert!(unshifted || (row["gap"]["only_a"] == 0 && row["gap"]["only_b"] == 0), "{row}");
        assert!(
            unshifted
                || row["condition"] == format!("agent at hue {}", row["variables"]["hue"].as_str().expect("a hue"))
        );
    }
    let whole = contents(&swm.path("whole"));

    // Killed at several moments, with another number of environments and threads, then completed.
    for moment in 0..4 {
        let args = ["study", "run", "study.toml", "--output", "killed", "--envs", "3", "--threads", "1"];
        let mut child = swm.command(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("swm starts");
        std::thread::sleep(Duration::from_millis(60 * moment));
        let _ = child.kill();
        child.wait().expect("the process ends");
    }
    swm.json(&["study", "run", "study.toml", "--output", "killed"]);
    let killed = contents(&swm.path("killed"));
    assert_eq!(killed.keys().collect::<Vec<_>>(), whole.keys().collect::<Vec<_>>());
    assert!(killed == whole, "a study that was killed differs from one that was not");
    for args in [["study", "status", "whole"], ["study", "export", "whole"]] {
        let other = args.map(|word| if word == "whole" { "killed" } else { word });
        let (whole, killed) = (swm.run(&args), swm.run(&other));
        assert!(whole.status.success() && whole.stdout == killed.stdout, "{}", text(&killed.stdout));
    }
    let latex = swm.run(&["study", "export", "whole", "--format", "latex"]);
    assert!(text(&latex.stdout).contains("\\midrule"));
}

#[test]
fn study_evaluates_only_what_changed() {
    let swm = with_study();
    swm.json(&["study", "run", "study.toml", "--output", "out", "seed=0"]);
    let first = contents(&swm.path("out/cells"));
    assert_eq!(first.len(), 6);
    let results = swm.json(&["study", "run", "study.toml", "--output", "out"]);
    assert_eq!((results["cells"].as_u64(), results["done"].as_u64()), (Some(12), Some(12)));
    let all = contents(&swm.path("out/cells"));
    assert!(all.len() == 12 && first.iter().all(|(name, bytes)| all.get(name) == Some(bytes)));
}

#[test]
fn commands_of_a_study_are_those_of_eval() {
    let swm = with_study();
    let output = swm.run(&["study", "run", "study.toml", "--commands", "seed=7"]);
    let commands = text(&output.stdout);
    assert_eq!(commands.lines().count(), 6, "{commands}");
    let shifted = commands.lines().nth(2).expect("six lines");
    assert!(
        shifted.starts_with("swm eval expert ") && shifted.contains("--pin=agent.color=255,0,0 --seed=7"),
        "{shifted}"
    );
    let args: Vec<&str> = shifted.split(' ').skip(1).chain(["--output", "one"]).collect();
    let results = swm.json(&args);
    assert_eq!(results["runs"].as_array().map(Vec::len), Some(2));
}

#[test]
fn errors_in_a_study_name_the_line_and_the_nearest_word() {
    let swm = Swm::new();
    for (from, to, parts) in [
        ("budget = 40", "bugdet = 40", vec!["study.toml:8", "bugdet", "budget"]),
        ("[[policy]]\nname = \"chance\"", "[[polisy]]\nname = \"chance\"", vec!["study.toml", "polisy", "policy"]),
        ("\"expert\"", "\"exprt\"", vec!["planner", "exprt"]),
        ("hsv({hue},1,1)", "hsv({hue},1)", vec!["study.toml:15", "hsv(0,1)", "HUE"]),
        ("budget = 40", "budget = \"many\"", vec!["study.toml:12", "--budget", "many"]),
        ("title = \"Colours in Two-Room\"", "", vec!["has no title"]),
        ("budget = 40", "budget = ", vec!["study.toml:8"]),
        ("hue = [0, 240]", "hue = [0, 0]", vec!["same evaluation"]),
    ] {
        assert!(STUDY.contains(from), "{from}");
        std::fs::write(swm.path("study.toml"), STUDY.replace(from, to)).expect("writing the study");
        swm.fails(&["study", "run", "study.toml", "--output", "out"], 2, &parts);
        assert!(!swm.path("out").exists(), "{to}");
    }
    swm.fails(&["study", "run", "paper/factor", "--output", "out"], 2, &["paper/factors"]);
}

#[test]
fn study_leaves_other_files_alone() {
    let swm = with_study();
    std::fs::create_dir(swm.path("thesis")).expect("creating a folder");
    std::fs::write(swm.path("thesis/main.tex"), "text").expect("writing a file");
    swm.fails(&["study", "run", "study.toml", "--output", "thesis"], 2, &["thesis", "no study.json"]);
    assert_eq!(contents(&swm.path("thesis")).len(), 1);
}

#[test]
fn study_file_chooses_no_modules_files_and_connections() {
    let swm = Swm::new();
    let mark = swm.path("imported");
    std::fs::write(swm.path("evil_mod.py"), format!("open({mark:?}, 'w').close()\n")).expect("writing a module");
    for (from, to, name) in [
        ("swm/TwoRoom-v1", "evil_mod:X-v0", "evil_mod"),
        ("budget = 40", "budget = 40\ndataset = \"s3://bucket/rooms.lance\"", "s3://bucket"),
        ("budget = 40", "budget = 40\nwrapper = \"chroma-key,key_color=255/255/255,media=/etc/passwd\"", "chroma-key"),
    ] {
        std::fs::write(swm.path("study.toml"), STUDY.replace(from, to)).expect("writing the study");
        swm.fails(&["study", "run", "study.toml", "--output", "out"], 2, &["study.toml", name, "--trust"]);
        assert!(!mark.exists() && !swm.path("out").exists(), "{name}");
    }
    std::fs::write(swm.path("study.toml"), STUDY.replace("swm/TwoRoom-v1", "evil_mod:X-v0"))
        .expect("writing the study");
    swm.fails(&["study", "run", "study.toml", "--commands"], 2, &["evil_mod", "--trust"]);
    assert!(!mark.exists());
    // The user's own setting replaces the environment of the file.
    let output = swm.run(&["study", "run", "study.toml", "--commands", "env=swm/TwoRoom-v1"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
}

#[test]
fn study_with_too_many_cells_is_refused_before_they_are_made() {
    let swm = Swm::new();
    let values: Vec<String> = (0..1000).map(|value| value.to_string()).collect();
    let list = format!("[{}]", values.join(","));
    for (from, to) in [
        ("what = [\"agent\"], hue = [0, 240]", format!("what = {list}, hue = {list}")),
        ("seed = [0, 1]", format!("seed = {list}\nhold = {list}")),
        ("seed = [0, 1]", format!("seed = {list}\nhold = [1, 2, 3, 4]")),
    ] {
        std::fs::write(swm.path("study.toml"), STUDY.replace(from, &to)).expect("writing the study");
        swm.fails(&["study", "run", "study.toml", "--commands"], 2, &["at most 10000"]);
    }
}

#[test]
fn study_replaces_neither_files_of_the_user_nor_another_study() {
    let swm = with_study();
    std::fs::create_dir(swm.path("mine")).expect("creating a folder");
    std::fs::write(swm.path("mine/study.json"), "{\"my\": \"thesis\"}").expect("writing a file");
    swm.fails(&["study", "run", "study.toml", "--output", "mine"], 2, &["study.json", "not written by this program"]);
    assert_eq!(std::fs::read(swm.path("mine/study.json")).expect("the file"), b"{\"my\": \"thesis\"}");

    swm.json(&["study", "run", "study.toml", "--output", "first", "seed=0"]);
    std::fs::write(swm.path("other.toml"), STUDY.replace("Colours in", "Shapes in")).expect("writing another study");
    swm.fails(&["study", "run", "other.toml", "--output", "first"], 2, &["Colours in Two-Room", "Shapes in Two-Room"]);
    // A run that ended before it wrote anything leaves an empty folder, in which the study starts.
    std::fs::create_dir(swm.path("empty")).expect("creating a folder");
    swm.json(&["study", "run", "study.toml", "--output", "empty", "seed=0"]);
}

#[test]
fn results_of_another_evaluation_are_refused() {
    let swm = with_study();
    swm.json(&["study", "run", "study.toml", "--output", "out"]);
    let mut cells: Vec<_> = std::fs::read_dir(swm.path("out/cells")).expect("the cells").flatten().collect();
    cells.sort_by_key(std::fs::DirEntry::path);
    std::fs::copy(cells[0].path(), cells[1].path()).expect("copying results over others");
    for args in [&["study", "status", "out"][..], &["study", "run", "study.toml", "--output", "out"]] {
        swm.fails(args, 1, &["results of another evaluation"]);
    }
    let study = std::fs::read_to_string(swm.path("out/study.json")).expect("the study");
    let mut twice: serde_json::Value = serde_json::from_str(&study).expect("JSON");
    let cells = twice["cells"].as_array().expect("cells");
    let cells = [cells.clone(), cells.clone()].concat();
    twice["cells"] = cells.into();
    std::fs::write(swm.path("out/study.json"), twice.to_string()).expect("writing the study");
    swm.fails(&["study", "status", "out"], 1, &["same evaluation"]);
}
