//! `--on ray`, with a program in place of Python: what is checked before the work, and how a run ends.

use crate::{Swm, text};
use serde_json::Value;
use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// A Python that has all packages. It writes its request and its id, and ends with 130 at Ctrl-C.
const PYTHON: &str = "#!/bin/sh
case \"$2\" in *find_spec*) exit 0 ;; esac
trap 'exit 130' INT
cat > request
echo $$ > id.new && mv id.new id
while :; do sleep 0.05; done
";

fn fake_python(swm: &Swm) -> PathBuf {
    let path = swm.path("python");
    std::fs::write(&path, PYTHON).expect("a program");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("its mode");
    path
}

/// Waits for a condition of another process.
fn until(what: &str, condition: impl Fn() -> bool) {
    let began = Instant::now();
    while !condition() {
        assert!(began.elapsed() < Duration::from_secs(60), "{what}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Starts a run, and waits until Python has its request.
fn start(swm: &Swm) -> (Child, String) {
    let python = fake_python(swm);
    let mut command = swm.command(&["collect", "swm/TwoRoom-v1", "-o", "./a.lance", "--no-pixels", "--on", "ray"]);
    let child = command.env("SWM_RAY_PYTHON", python).stderr(Stdio::piped()).spawn().expect("swm starts");
    until("Python starts", || swm.path("id").exists());
    let id = std::fs::read_to_string(swm.path("id")).expect("the id").trim().to_owned();
    (child, id)
}

fn kill(signal: &str, id: &str) {
    assert!(Command::new("kill").args([signal, id]).status().expect("kill").success());
}

/// Whether a process runs: it exists and is no zombie.
fn runs(id: &str) -> bool {
    let status = std::fs::read_to_string(Path::new("/proc").join(id).join("stat")).unwrap_or_default();
    !status.is_empty() && !status.contains(") Z ")
}

#[test]
fn a_request_to_end_reaches_the_run() {
    let swm = Swm::new();
    let (child, id) = start(&swm);
    kill("-TERM", &child.id().to_string());
    let output = child.wait_with_output().expect("swm ends");
    assert_eq!(output.status.code(), Some(130), "{}", text(&output.stderr));
    assert!(!runs(&id));
}

#[test]
fn a_signal_that_ends_the_driver_is_named() {
    let swm = Swm::new();
    let (child, id) = start(&swm);
    kill("-KILL", &id);
    let output = child.wait_with_output().expect("swm ends");
    let error = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(error.contains("signal 9 ended") && !error.contains("error above"), "{error}");
}

#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "only Linux ends the children of a killed process")]
fn a_run_ends_with_the_program() {
    let swm = Swm::new();
    let (mut child, id) = start(&swm);
    kill("-KILL", &child.id().to_string());
    child.wait().expect("swm ends");
    until("Python ends", || !runs(&id));
}

#[test]
fn files_of_the_user_in_the_output_are_refused() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "2", "--image", "32", "--max-steps", "20"]);
    let study = "title = \"T\"\nquestion = \"q?\"\n[defaults]\nenv = \"swm/TwoRoom-v1\"\nepisodes = 1\n\
                 [[condition]]\nname = \"c\"\n[[policy]]\nname = \"random\"\npolicy = \"random\"\n";
    std::fs::write(swm.path("study.toml"), study).expect("a study");
    let python = fake_python(&swm);
    let fails = |args: &[&str], part: &str| {
        let output = swm.command(&[args, &["--on", "ray"]].concat()).env("SWM_RAY_PYTHON", &python).output();
        let output = output.expect("swm starts");
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(2) && error.contains(part), "{args:?}: {error}");
        assert!(!swm.path("request").exists(), "{args:?}: the run began");
    };
    let eval = ["eval", "random", "--env", "swm/TwoRoom-v1", "--no-pixels", "--episodes", "1", "--budget", "2"];
    let study = ["study", "run", "study.toml"];
    let train = ["train", "lewm", "--data", "rooms", "--preset", "tiny", "schedule.steps=1"];
    let sweep = [&train[..], &["--sweep", "seed=0,1"]].concat();
    let videos: Vec<&str> = eval.into_iter().filter(|part| *part != "--no-pixels").chain(["--videos", "1"]).collect();
    let trace = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--trace", "--videos", "0"];
    let cases: [(&[&str], &str, &str); 9] = [
        (&videos, "videos/mine.txt", "videos: exists and was not written by this run"),
        (&trace, "traces.json", "traces.json: exists and was not written by this run"),
        (&eval, "results.json", "not written by this run"),
        (&eval, "run.json", "not written by this run"),
        (&study, "study.json", "not written by this program"),
        (&study, "notes.txt", "has files and no study.json"),
        (&train, "run/train.jsonl", "run: exists and was not written by this run"),
        (&train, "run", "run: exists and was not written by this run"),
        (&sweep, "seed=1/checkpoint/config.json", "seed=1: exists and was not written by this run"),
    ];
    for (index, (command, file, part)) in cases.into_iter().enumerate() {
        let output = format!("out-{index}");
        let path = swm.path(&output).join(file);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(&path, "mine").expect("a file");
        let link = swm.path(&format!("link-{index}"));
        std::os::unix::fs::symlink(swm.path(&output), &link).expect("a link");
        for output in [format!("./{output}"), link.to_string_lossy().into_owned()] {
            fails(&[command, &["-o", &output]].concat(), part);
        }
        assert_eq!(std::fs::read_to_string(&path).expect("the file"), "mine");
    }
    std::fs::write(swm.path("file"), "mine").expect("a file");
    fails(&[&eval[..], &["-o", "./file"]].concat(), "is not a folder");
    // Another study.
    let stored = "{\"title\": \"Other\", \"cells\": []}";
    std::fs::create_dir(swm.path("other")).expect("a folder");
    std::fs::write(swm.path("other/study.json"), stored).expect("a study");
    fails(&[&study[..], &["-o", "./other"]].concat(), "holds the study 'Other', not 'T'");
}

#[test]
fn modules_of_the_current_folder_are_not_imported() {
    let swm = Swm::new();
    for name in ["json", "importlib", "ray", "stable_worldmodel"] {
        let source = "import pathlib; pathlib.Path(__file__).with_name('imported').touch()";
        std::fs::write(swm.path(&format!("{name}.py")), source).expect("a module");
    }
    let mut command = swm.command(&["collect", "swm/TwoRoom-v1", "-o", "./a.lance", "--no-pixels", "--on", "ray"]);
    let output = command.env("SWM_RAY_PYTHON", "/usr/bin/python3").output().expect("swm starts");
    let error = text(&output.stderr);
    assert!(error.contains("it has no package ray") || error.contains("cannot be started"), "{error}");
    assert!(!swm.path("imported").exists());
}

/// The files of a folder and their contents, without what differs between equal evaluations.
fn files_of(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let untimed = |path: &Path| {
        let bytes = std::fs::read(path).expect("a file");
        let Ok(mut value) = serde_json::from_slice::<Value>(&bytes) else { return bytes };
        let runs = value.get_mut("runs").and_then(Value::as_array_mut).into_iter().flatten();
        for run in runs.filter_map(Value::as_object_mut) {
            run.remove("timing");
        }
        for plan in value.as_array_mut().into_iter().flatten().filter_map(Value::as_object_mut) {
            plan.retain(|name, _| !name.ends_with("seconds"));
        }
        value.to_string().into_bytes()
    };
    let mut found = BTreeMap::new();
    for name in ["results.json", "traces.json", "videos"] {
        let path = folder.join(name);
        if path.is_dir() {
            for entry in std::fs::read_dir(&path).expect("a folder").flatten() {
                found.insert(format!("{name}/{}", entry.file_name().to_string_lossy()), untimed(&entry.path()));
            }
        } else {
            found.insert(name.to_owned(), untimed(&path));
        }
    }
    found
}

#[test]
fn cells_of_an_evaluation_join_to_that_of_one_process() {
    let swm = Swm::new();
    let eval = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--image", "32", "--episodes", "2", "--budget", "6"];
    let more = ["--solver", "cem,samples=4,iterations=1,elites=2", "--horizon", "2", "--shift", "agent.color=0,0,255"];
    let eval = [&eval[..], &more, &["--trace", "--videos", "1"]].concat();
    swm.json(&[&eval[..], &["--output", "one"]].concat());
    for (index, name) in ["000000", "000001"].into_iter().enumerate() {
        let part = format!("part-{index}");
        swm.json(&[&eval[..], &["--part", &index.to_string(), "--output", &part]].concat());
        for (from, to) in [("results.json", "results"), ("traces.json", "traces"), ("videos", "videos")] {
            let suffix = if from == "videos" { "" } else { ".json" };
            let to = swm.path("parts").join(to).join(format!("{name}{suffix}"));
            std::fs::create_dir_all(to.parent().expect("a folder")).expect("a folder");
            std::fs::rename(swm.path(&part).join(from), to).expect("a file of the cell");
        }
    }
    let joined = swm.json(&[&eval[..], &["--join", "parts", "--output", "joined"]].concat());
    assert_eq!(joined["ends"], true);
    let (one, joined) = (files_of(&swm.path("one")), files_of(&swm.path("joined")));
    assert_eq!(one.keys().collect::<Vec<_>>(), joined.keys().collect::<Vec<_>>());
    assert!(one.len() == 2 + 2 * 4 && one == joined, "{:?}", one.keys());
    // The record has the command of the user, not that of the cell.
    let record = std::fs::read(swm.path("joined/run.json")).expect("the record");
    let record: Value = serde_json::from_slice(&record).expect("JSON");
    let command: Vec<&str> = std::iter::once("swm").chain(eval.iter().copied()).chain(["--output", "joined"]).collect();
    assert_eq!(record["commands"][0]["command"], serde_json::json!(command));
}

#[test]
fn the_levels_inside_an_interval_are_those_of_one_process() {
    let swm = Swm::new();
    // A slow agent does not arrive in time.
    let of = ["study", "break", "expert", "env=swm/TwoRoom-v1", "no-pixels=true", "budget=30", "episodes=20"];
    let of = [&of[..], &["--factor", "agent.speed", "--towards", "1.75", "--output"]].concat();
    swm.json(&[&of[..], &["one"]].concat());
    let read = |path: &str| -> Value {
        serde_json::from_slice(&std::fs::read(swm.path(path)).expect("a file")).expect("JSON")
    };
    let whole = read("one/study.json");
    let request = swm.json(&[&of[..], &["./many", "--on", "ray", "--print-request"]].concat());
    let grid = &request["cells"];
    assert_eq!((request["kind"].as_str(), grid["inside"].as_u64()), (Some("study"), Some(3)));
    std::fs::create_dir_all(swm.path("many/cells")).expect("a folder");
    std::fs::write(swm.path("many/study.json"), grid["study"].to_string()).expect("the study");
    let ids = grid["ids"].as_array().expect("ids");
    assert_eq!((ids.len(), whole["cells"].as_array().map(Vec::len)), (9, Some(12)));
    for id in ids.iter().filter_map(Value::as_str) {
        let name = format!("cells/{id}.json");
        std::fs::copy(swm.path("one").join(&name), swm.path("many").join(&name)).expect("results of the grid");
    }
    assert_eq!(swm.json(&[&of[..], &["many", "--inside"]].concat())["cells"], 12);
    assert_eq!(read("many/levels.json")["study"], whole);
    // A value of an order has levels inside, a kind of door has none.
    let doors = ["study", "break", "expert", "env=swm/TwoRoom-v1", "--factor", "door.number", "--output", "./doors"];
    let request = swm.json(&[&doors[..], &["--on", "ray", "--print-request"]].concat());
    assert_eq!(request["cells"]["inside"], 0);
}
