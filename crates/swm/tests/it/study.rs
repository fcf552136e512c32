//! `swm study`: files, cells, interruption, tables.

use crate::{Swm, text};
use std::collections::BTreeMap;
use std::os::unix::ffi::OsStrExt as _;
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
name = "random"
policy = "random"

[[published]]
source = "a table"
rates = { "in distribution" = { planner = 0.9 } }
"#;

/// The files of a folder and their contents.
pub(crate) fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
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
        // Hue 0 is the default; a circle of another colour covers a small part of the frame.
        let expected = if row["condition"] == "agent at hue 0" { 0.0..=0.0 } else { 0.01..=60.0 };
        let distance = row["image_distance"].as_f64();
        assert!(unshifted == distance.is_none() && distance.is_none_or(|mean| expected.contains(&mean)), "{row}");
        // The agent's colour does not change what the expert does.
        assert!(unshifted || (row["gap"]["only_a"] == 0 && row["gap"]["only_b"] == 0), "{row}");
        assert!(unshifted || (row["gap"]["comparisons"] == 2 && row["gap"]["verdict"] == "too few"), "{row}");
        assert!(
            unshifted
                || row["condition"] == format!("agent at hue {}", row["variables"]["hue"].as_str().expect("a hue"))
        );
    }
    let families = results["families"].as_array().into_iter().flatten();
    let families: Vec<&str> = families.filter_map(|family| family["name"].as_str()).collect();
    let of = |policy: &str| [0, 1].map(|seed| format!("{policy} · strict · seed {seed}"));
    assert_eq!(families, [of("planner"), of("random")].concat());
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
    for folder in ["whole", "killed"] {
        swm.json(&["study", "report", folder]);
    }
    let page = contents(&swm.path("whole/report"));
    assert!(page == contents(&swm.path("killed/report")), "the page of a killed study differs");
    let names: Vec<&str> = page.keys().map(String::as_str).collect();
    assert_eq!(names[..3], ["figures/drop-1.png", "figures/drop-1.svg", "figures/drop-2.png"], "{names:?}");
    assert_eq!(names[4..], ["index.html", "table.csv", "table.md", "table.tex"], "{names:?}");
    let html = String::from_utf8_lossy(&page["index.html"]);
    for words in ["12 of 12", "swm study run study.toml --output study", "90.0\u{a0}% [1]", "a table", "seed 1"] {
        assert!(html.contains(words), "the page lacks: {words}");
    }
    let latex = swm.run(&["study", "export", "whole", "--format", "latex"]);
    assert!(text(&latex.stdout).contains("\\midrule"));
}

#[test]
fn study_with_a_rule_shows_confidence_sequences_and_resumes_to_the_same_bytes() {
    let swm = with_study();
    let args = |folder: &'static str| ["study", "run", "study.toml", "--output", folder, "--until", "ci=20"];
    let settings = ["episodes=90", "seed=0"];
    let results = swm.json(&[&args("whole")[..], &settings].concat());
    assert_eq!((results["done"].as_u64(), results["until"].as_str()), (Some(6), Some("ci=20")));
    for row in results["rows"].as_array().expect("rows") {
        let [low, high] = ["low", "high"].map(|end| row["success"][end].as_f64().expect("an end"));
        assert!(high - low <= 0.4, "{row}");
        assert!(row["gap"].is_null() || row["gap"]["e"].is_number(), "{row}");
    }
    for moment in 0..3 {
        let args = [&args("killed")[..], &settings].concat();
        let mut child = swm.command(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().expect("swm starts");
        std::thread::sleep(Duration::from_millis(60 * moment));
        let _ = child.kill();
        child.wait().expect("the process ends");
    }
    swm.json(&[&args("killed")[..], &settings].concat());
    assert!(contents(&swm.path("killed")) == contents(&swm.path("whole")), "a study that was killed differs");
    let csv = swm.run(&["study", "export", "whole"]);
    assert!(text(&csv.stdout).lines().nth(2).is_some_and(|line| line.ends_with(",ci=20")), "{}", text(&csv.stdout));
    swm.json(&["study", "report", "whole"]);
    let status = swm.run(&["study", "status", "whole"]);
    let [page, table] = ["index.html", "table.tex"].map(|file| contents(&swm.path("whole/report"))[file].clone());
    for words in [&page, &table, &status.stdout] {
        assert!(text(words).contains("ran until ci=20: intervals are confidence sequences"), "{}", text(words));
    }
    assert!(text(&page).contains("study.toml episodes=90 seed=0 --until ci=20 --output study"));
    swm.fails(&["study", "run", "study.toml", "--output", "whole"], 2, &["--until ci=20", "--output"]);
    let cell = format!("whole/cells/{}.json", results["rows"][0]["cell"].as_str().expect("an id"));
    swm.fails(&["report", &cell], 2, &["--until", "swm study report"]);
    swm.fails(&["study", "run", "study.toml", "--output", "x", "--until", "narrow"], 2, &["narrow", "ci=5"]);
}

#[test]
fn breaking_points_are_found_along_a_ray_and_for_each_value() {
    let swm = Swm::new();
    let of = |factor: &'static str| ["study", "break", "expert", "env=swm/TwoRoom-v1", "--factor", factor, "-o"];
    let settings = ["no-pixels=true", "budget=30", "episodes=80"];
    // A slow agent does not arrive in time.
    let args = [&of("agent.speed")[..], &["speed", "--towards", "1.75"], &settings].concat();
    let results = swm.json(&args);
    assert_eq!((results["cells"].as_u64(), results["done"].as_u64()), (Some(12), Some(12)), "{results}");
    let point = &results["breaking"][0];
    let crossing = &point["half"]["estimates"][0];
    let [low, high] = [0, 1].map(|end| crossing[end].as_f64().expect("a change"));
    assert!(high - low < 0.04 && low > 0.1, "{crossing}");
    for end in ["above", "below"] {
        assert!(point["half"][end].as_str().is_some_and(|name| name.starts_with("agent.speed=")), "{point}");
    }
    assert!(results["families"][0]["comparisons"] == 32 && point["rises"] == serde_json::json!([]), "{results}");
    let whole = contents(&swm.path("speed"));
    assert_eq!(swm.json(&args), results);
    assert!(contents(&swm.path("speed")) == whole, "a study that was done changed");
    // A killed study keeps the levels inside that it chose, here two of three.
    let file = std::fs::read_to_string(swm.path("speed/study.json")).expect("the study");
    let mut study: serde_json::Value = serde_json::from_str(&file).expect("a study");
    let cells = study["cells"].as_array_mut().expect("cells");
    let eighths = |change: &serde_json::Value| {
        change.as_str().and_then(|text| text.parse::<f64>().ok()).map(|change| 8.0 * change)
    };
    let is_inside = |cell: &serde_json::Value| {
        let variables = cell["variables"].as_object().expect("variables");
        variables.values().filter_map(eighths).any(|change| change.fract() != 0.0)
    };
    cells.remove(cells.iter().position(is_inside).expect("a cell inside"));
    std::fs::write(swm.path("speed/study.json"), study.to_string()).expect("writing the study");
    assert_eq!(swm.json(&args)["cells"].as_u64(), Some(11));
    swm.json(&["study", "report", "speed"]);
    let page = text(&contents(&swm.path("speed/report"))["index.html"]);
    for words in
        ["Breaking point</h2>", "falls below half of its unshifted", "swm study break expert env=swm/TwoRoom-v1"]
    {
        assert!(page.contains(words), "the page lacks: {words}");
    }
    let shapes = swm.json(&[&of("door.number")[..], &["doors"], &settings].concat());
    assert_eq!((shapes["cells"].as_u64(), &shapes["breaking"][0]["ray"]["ordered"]), (Some(3), &false.into()));
    let status = swm.run(&["study", "status", "doors"]);
    assert!(text(&status.stdout).contains("expert, against half of its unshifted"), "{}", text(&status.stdout));
    let fails = |factor, parts: &[&str]| swm.fails(&[&of(factor)[..], &["x"], &settings].concat(), 2, parts);
    fails("agent.sped", &["agent.sped", "agent.speed"]);
    fails("agent.position", &["draws it in every episode"]);
    assert!(!swm.path("x").exists());
}

#[test]
fn temporary_files_of_a_killed_study_are_deleted() {
    let swm = with_study();
    let args = ["study", "run", "study.toml", "--output", "out", "seed=0"];
    std::fs::create_dir(swm.path("out")).expect("creating a folder");
    std::fs::write(swm.path("out/.study.json.77.tmp"), "{").expect("writing a file");
    swm.json(&args);
    let names = contents(&swm.path("out"));
    assert_eq!(names.len(), 8, "{:?}", names.keys());
    for other in ["out/cells/.0123.json.77.tmp", "out/cells/.notes.tmp", "out/.0123.json.77.tmp"] {
        std::fs::write(swm.path(other), "{").expect("writing a file");
    }
    swm.json(&args);
    let mut remaining = contents(&swm.path("out"));
    assert!(remaining.remove("cells/.notes.tmp").is_some() && remaining.remove(".0123.json.77.tmp").is_some());
    assert!(remaining == names, "{:?}", remaining.keys());
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
fn families_count_cells_that_are_not_done_and_follow_the_file() {
    let swm = with_study();
    std::fs::write(swm.path("study.toml"), format!("families = [\"seed\"]\n{STUDY}")).expect("writing the study");
    swm.json(&["study", "run", "study.toml", "--output", "out", "seed=1"]);
    // The study of both seeds has no cells of seed 0 yet, and lacks one of seed 1.
    let study = std::fs::read_to_string(swm.path("out/study.json")).expect("the study");
    assert!(study.contains("\"families\": [\n    \"seed\"\n  ]"), "{study}");
    let cells = swm.json(&["study", "status", "out"])["rows"].clone();
    let last = cells.as_array().and_then(|rows| rows.last()).expect("rows");
    let file = format!("out/cells/{}.json", last["cell"].as_str().expect("an id"));
    std::fs::remove_file(swm.path(&file)).expect("removing a cell");
    let results = swm.json(&["study", "status", "out"]);
    let families = results["families"].as_array().expect("families");
    assert_eq!(
        (families.len(), &families[0]["name"], families[0]["comparisons"].as_u64()),
        (1, &"seed 1".into(), Some(4))
    );
    let gaps = results["rows"].as_array().into_iter().flatten().filter(|row| !row["gap"].is_null());
    assert_eq!(gaps.map(|row| row["gap"]["comparisons"].as_u64()).collect::<Vec<_>>(), [Some(4); 3]);
}

#[test]
fn training_seeds_are_taken_together() {
    let swm = with_study();
    let policies = r#"
[[policy]]
name = "expert {training-seed}"
policy = "expert"
each = { training-seed = [0, 1, 2, 3] }
"#;
    let (before, _) = STUDY.split_once("[[policy]]").expect("policies");
    std::fs::write(swm.path("study.toml"), format!("{before}{policies}")).expect("writing the study");
    let results = swm.json(&["study", "run", "study.toml", "--output", "out", "seed=0"]);
    let over = results["over_seeds"].as_array().expect("a table over seeds");
    let conditions: Vec<_> = over.iter().map(|row| row["condition"].as_str()).collect();
    let [red, blue] = ["agent at hue 0", "agent at hue 240"].map(Some);
    assert_eq!(conditions, [Some("in distribution"), red, blue, None]);
    assert!(over.iter().all(|row| row["policy"] == "expert *" && row["scores"].as_array().map(Vec::len) == Some(4)));
    assert!(over[2]["interquartile"].is_null() && over[3]["interquartile"]["mean"].is_number(), "{over:?}");
    // Each policy is compared with itself.
    let rows = results["rows"].as_array().expect("rows");
    assert!(rows.iter().filter(|row| !row["gap"].is_null()).all(|row| row["gap"]["only_b"] == 0), "{rows:?}");
    let status = swm.run(&["study", "status", "out"]);
    assert!(text(&status.stdout).contains("all shifted conditions"), "{}", text(&status.stdout));
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
        ("[[policy]]\nname = \"random\"", "[[polisy]]\nname = \"random\"", vec!["study.toml", "polisy", "policy"]),
        ("\"expert\"", "\"exprt\"", vec!["planner", "exprt"]),
        ("hsv({hue},1,1)", "hsv({hue},1)", vec!["study.toml:15", "hsv(0,1)", "HUE"]),
        ("budget = 40", "budget = \"many\"", vec!["study.toml:12", "--budget", "many"]),
        ("title = \"Colours in Two-Room\"", "", vec!["has no title"]),
        ("budget = 40", "budget = ", vec!["study.toml:8"]),
        ("hue = [0, 240]", "hue = [0, 0]", vec!["same evaluation"]),
        ("[defaults]", "families = [\"polisy\"]\n[defaults]", vec!["study.toml:5", "polisy", "policy"]),
        (
            "policy = \"random\"",
            "policy = \"random\"\neach = { training-seed = [1] }",
            vec!["'random' does not contain {training-seed}"],
        ),
        (
            "name = \"random\"",
            "name = \"chance\"",
            vec!["of 'chance'", "the random policy has the name 'chance'", "write name = \"random\""],
        ),
        ("planner = 0.9", "planner = 90", vec!["study.toml:30", "not a success rate", "0 to 1"]),
        ("source = \"a table\"", "sources = \"a table\"", vec!["study.toml:29", "sources", "source"]),
        ("source = \"a table\"", "", vec!["study.toml:28", "no source"]),
        ("name = \"random\"", "name = \"random\\nswm: done\"", vec!["study.toml:", "several lines"]),
        (
            "name = \"random\"\npolicy = \"random\"",
            "name = \"planner\"\npolicy = \"no-op\"",
            vec!["of planner", "two cells have this name", "different names"],
        ),
    ] {
        assert!(STUDY.contains(from), "{from}");
        std::fs::write(swm.path("study.toml"), STUDY.replace(from, to)).expect("writing the study");
        swm.fails(&["study", "run", "study.toml", "--output", "out"], 2, &parts);
        assert!(!swm.path("out").exists(), "{to}");
    }
    swm.fails(&["study", "run", "paper/factor", "--output", "out"], 2, &["paper/factors"]);
}

#[test]
fn report_of_a_study_replaces_only_its_own_files() {
    let swm = with_study();
    swm.json(&["study", "run", "study.toml", "--output", "out", "seed=0"]);
    for name in ["index.html", "table.csv"] {
        let folder = swm.path(&format!("mine-{name}"));
        std::fs::create_dir(&folder).expect("creating a folder");
        std::fs::write(folder.join(name), "mine").expect("writing a file");
        let output = format!("mine-{name}");
        swm.fails(&["study", "report", "out", "--output", &output], 2, &[name, "not written by this program"]);
        assert_eq!(contents(&folder), BTreeMap::from([(name.to_owned(), b"mine".to_vec())]));
    }
    std::fs::create_dir_all(swm.path("paper/figures")).expect("creating a folder");
    std::fs::write(swm.path("paper/figures/drop-1.svg"), "mine").expect("writing a file");
    swm.fails(&["study", "report", "out", "--output", "paper"], 2, &["figures", "not written by this program"]);
    swm.json(&["study", "report", "out", "--output", "page", "--title", "First"]);
    let first = contents(&swm.path("page"));
    swm.json(&["study", "report", "out", "--output", "page", "--title", "Second"]);
    let second = contents(&swm.path("page"));
    assert!(first["index.html"] != second["index.html"] && first["table.csv"] == second["table.csv"]);
    swm.fails(&["study", "report", "nowhere"], 2, &["nowhere"]);
}

#[test]
fn studies_are_written_to_the_folder_that_is_named() {
    let swm = with_study();
    swm.fails(&["study", "run", "study.toml", "--output", "gs://bucket/x"], 2, &["gs://bucket/x", "is a URI"]);
    let mut command = swm.command(&["study", "run", "study.toml", "--output"]);
    let output = command.arg(std::ffi::OsStr::from_bytes(b"\xff\xfe")).output().expect("swm starts");
    assert!(output.status.code() == Some(2) && text(&output.stderr).contains("no valid UTF-8"));
    // An infinite value would be no JSON, and the study could not be read again.
    let infinite = STUDY.replace("hsv({hue},1,1)", "1e400,0,0");
    std::fs::write(swm.path("infinite.toml"), infinite).expect("writing the study");
    swm.fails(&["study", "run", "infinite.toml", "--output", "out"], 2, &["1e400,0,0", "it is not KEY=NUMBER"]);
    let left: Vec<_> = std::fs::read_dir(swm.path("")).expect("a folder").flatten().map(|e| e.file_name()).collect();
    assert!(!swm.path("out").exists() && !swm.path("gs:").exists(), "{left:?}");
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
fn damaged_folders_of_a_study_are_errors() {
    let swm = Swm::new();
    let factors = "kind = \"factors\"\ntitle = \"T\"\nquestion = \"q?\"\n";
    std::fs::write(swm.path("factors.toml"), factors).expect("a study");
    let run = ["study", "run", "factors.toml", "--output", "out"];
    std::fs::create_dir(swm.path("out")).expect("a folder");
    let file = swm.path("out/study.json");
    let made = std::process::Command::new("mkfifo").arg(&file).status().expect("mkfifo");
    assert!(made.success());
    swm.fails(&run, 1, &["study.json", "is not a regular file"]);
    std::fs::remove_file(&file).expect("the pipe");
    swm.json(&run);
    let study = std::fs::read_to_string(&file).expect("the study");
    std::fs::write(&file, study.replacen("\"environment\"", "\"\\u001b[31mred\"", 1)).expect("the study");
    let shown = swm.run(&["study", "status", "out"]);
    let shown = text(&shown.stdout);
    assert!(shown.contains("red") && !shown.contains('\u{1b}'), "{shown:?}");
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

/// The dataset of the name in the study is another one in another folder, and after more episodes are collected.
#[test]
fn a_study_is_not_resumed_with_another_dataset() {
    let swm = with_study();
    let recorded = "episodes = 6\ngoal-offset = 5\nno-pixels = true";
    let study = STUDY.replace("episodes = 6", recorded).replace("image = \"32\"\n", "");
    let study = format!("{study}\n[[starts]]\nname = \"recorded\"\ndataset = \"./d.lance\"\n");
    std::fs::write(swm.path("study.toml"), study).expect("writing the study");
    let collect = |more: &[&str]| {
        let args = [&["collect", "swm/TwoRoom-v1", "--no-pixels", "--max-steps", "20"], more].concat();
        swm.json(&args);
    };
    collect(&["--output", "d.lance", "--episodes", "8"]);
    collect(&["--output", "other/d.lance", "--episodes", "8", "--seed", "1"]);
    swm.json(&["study", "run", "study.toml", "--output", "out"]);
    let whole = contents(&swm.path("out"));
    let removed = whole.keys().find(|name| name.starts_with("cells/")).expect("a cell");
    std::fs::remove_file(swm.path("out").join(removed)).expect("removing a cell");
    let rest = contents(&swm.path("out"));
    let refused = |args: &[&str], cwd: &str| {
        let output = swm.command(args).current_dir(swm.path(cwd)).output().expect("running swm");
        let message = text(&output.stderr);
        assert!(output.status.code() == Some(2) && message.contains("the dataset of '"), "{args:?}: {message}");
        assert_eq!(contents(&swm.path("out")), rest, "nothing is written");
    };
    let id = removed.trim_start_matches("cells/").trim_end_matches(".json");
    refused(&["study", "resume", "../out"], "other");
    refused(&["study", "resume", "../out", "--cell", id], "other");
    swm.json(&["study", "resume", "out"]);
    assert_eq!(contents(&swm.path("out")), whole);
    std::fs::remove_file(swm.path("out").join(removed)).expect("removing a cell");
    collect(&["--output", "d.lance", "--episodes", "9", "--resume"]);
    refused(&["study", "resume", "out"], ".");
    // A complete study needs no dataset.
    std::fs::write(swm.path("out").join(removed), &whole[removed]).expect("the cell");
    swm.json(&["study", "resume", "out"]);
}

/// The commands of a study, one to a line.
fn commands(swm: &Swm, study: &str) -> String {
    std::fs::write(swm.path("study.toml"), study).expect("writing the study");
    let output = swm.run(&["study", "run", "study.toml", "--commands"]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    text(&output.stdout)
}

#[test]
fn small_files_do_not_expand_without_bound() {
    let swm = Swm::new();
    // Every value names the next variable 20 times: values are not expanded again.
    let next = |index: usize| format!("a{index:02} = [\"{}\"]\n", format!("{{a{:02}}}", index + 1).repeat(20));
    let each: String = (0..12).map(next).collect();
    let (before, policies) = STUDY.split_once("[[policy]]").expect("policies");
    let (defaults, _) = before.split_once("[[condition]]").expect("conditions");
    let nested = format!(
        "{defaults}[[condition]]\nname = \"{{a00}}\"\nwrapper = \"noise,std={{a12}}\"\n\
        [condition.each]\n{each}a12 = [1]\n[[policy]]{policies}"
    );
    let printed = commands(&swm, &nested);
    assert!(printed.contains("noise,std=1") && printed.len() < 2000, "{printed}");

    // A long text in many cells.
    let numbers = (0..5000).map(|number| number.to_string()).collect::<Vec<_>>().join(",");
    let long = "A".repeat(500_000);
    for (name, option) in [("c{i}", format!("wrapper = \"{long}\"\n")), ("{i}", format!("each.j = [\"{long}\"]\n"))] {
        let cloned =
            format!("{defaults}[[condition]]\nname = \"{name}\"\n{option}each.i = [{numbers}]\n[[policy]]{policies}");
        std::fs::write(swm.path("study.toml"), cloned).expect("writing the study");
        swm.fails(&["study", "run", "study.toml", "--commands"], 2, &["64 MiB", "fewer values"]);
    }
}

#[test]
fn names_in_a_study_are_no_options_of_its_commands() {
    let swm = Swm::new();
    for policy in ["--trust", "-o"] {
        let study = STUDY.replace("policy = \"expert\"", &format!("policy = \"{policy}\""));
        let printed = commands(&swm, &study);
        let line = printed.lines().next().expect("a command");
        assert!(line.starts_with("swm eval --") && line.ends_with(&format!(" -- {policy}")), "{line}");
        // As a command it evaluates a checkpoint of this name, which does not exist.
        let args: Vec<&str> = line.split(' ').skip(1).collect();
        swm.fails(&args, 2, &[policy]);
        swm.fails(&["study", "run", "study.toml", "--output", "out"], 2, &["planner", policy]);
        assert!(!swm.path("out").exists());
    }
    let empty = STUDY.replace("policy = \"expert\"", "policy = \"\"");
    assert!(commands(&swm, &empty).starts_with("swm eval '' --"));
}
