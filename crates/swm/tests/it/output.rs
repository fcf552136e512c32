//! Tests of lost output, of output folders, and of text from files on the terminal (docs/security.md).

use crate::{Swm, text};
use std::ffi::OsStr;
use std::fs;
use std::os::unix::ffi::OsStrExt as _;
use std::process::{Command, Output, Stdio};

/// Evaluates two short episodes in the folder `found`.
const EVAL: &[&str] = &["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "3", "-o", "found"];

/// Runs the command with this file as standard output.
fn run_into(swm: &Swm, args: &[&str], out: &str) -> Output {
    let out = fs::OpenOptions::new().write(true).open(out).expect("the file opens");
    swm.command(args).stdout(out).stderr(Stdio::piped()).output().expect("swm starts")
}

#[test]
fn lost_output_is_an_error() {
    let swm = Swm::new();
    for args in [
        &["formats"][..],
        &["formats", "--json"],
        &["envs", "swm/TwoRoom-v1"],
        &["models", "--json"],
        &["datasets"],
        &["--help"],
        &["collect", "--help"],
        &["help", "eval"],
        &["--version"],
    ] {
        let output = run_into(&swm, args, "/dev/full");
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{args:?}: {error}");
        assert!(error.contains("standard output") && error.contains("the output is lost"), "{args:?}: {error}");
        assert_eq!(run_into(&swm, args, "/dev/null").status.code(), Some(0), "{args:?}");
    }
    // The results of a long command are written to its files all the same.
    assert_eq!(run_into(&swm, EVAL, "/dev/full").status.code(), Some(1));
    assert!(swm.path("found/results.json").is_file());
    // Another failure keeps its exit code.
    assert_eq!(run_into(&swm, &["inspect", "nothing"], "/dev/full").status.code(), Some(2));
}

#[cfg(target_os = "linux")]
#[test]
fn closed_output_is_an_error_before_the_work() {
    let swm = Swm::new();
    for args in [EVAL, &["formats"], &["--help"]] {
        let closed = ["-c", "exec \"$0\" \"$@\" >&-", env!("CARGO_BIN_EXE_swm")];
        let mut command = Command::new("sh");
        command.args(closed).args(args).env("STABLEWM_HOME", swm.home()).current_dir(swm.home());
        let output = command.output().expect("sh starts");
        let error = text(&output.stderr);
        assert!(output.status.code() == Some(1) && error.contains("standard output is closed"), "{args:?}: {error}");
    }
    assert!(!swm.path("found").exists());
}

#[test]
fn closed_pipe_ends_quietly() {
    let swm = Swm::new();
    let mut child =
        swm.command(&["envs", "--json"]).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("swm starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("swm ends");
    assert_eq!((output.status.code(), text(&output.stderr)), (Some(0), String::new()));
}

#[test]
fn output_folders_are_checked_before_the_work() {
    let swm = Swm::new();
    fs::write(swm.path("file"), "").expect("a file");
    fs::create_dir_all(swm.path("occupied/results.json")).expect("a folder");
    let other = |folder: &'static str| [&EVAL[..EVAL.len() - 1], &[folder]].concat();
    let no_work = |folder: &'static str, code: i32, parts: &[&str]| {
        let output = swm.run(&other(folder));
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{folder}: {error}");
        assert!(parts.iter().all(|part| error.contains(part)), "{folder}: {error}");
        assert!(!error.contains("evaluate: random"), "{folder}: the floor was played: {error}");
    };
    no_work("", 2, &["--output", "a value is required"]);
    no_work("file", 2, &["is not a folder"]);
    no_work("file/below", 1, &["file/below"]);
    no_work("occupied", 2, &["results.json", "is a folder"]);
    no_work("/proc/swm", 2, &["/proc/swm"]);
    no_work("s3://bucket/found", 2, &["s3://bucket/found", "is a URI"]);

    swm.json(EVAL);
    swm.fails(&["reproduce", "found", "-o", "found"], 2, &["would be replaced"]);
    swm.fails(&["report", "found", "-o", "file"], 2, &["is not a folder"]);
    swm.fails(&["report", "found", "-o", "file://x"], 2, &["is a URI"]);
    assert!(!swm.path("s3:").exists() && !swm.path("file:").exists());

    let lock = fs::File::open(swm.path("found")).expect("the folder");
    lock.lock().expect("the lock");
    for args in [EVAL, &["report", "found", "-o", "found"], &["demo", "-o", "found"]] {
        swm.fails(args, 2, &["another process writes to it"]);
    }
}

#[test]
fn folder_of_an_output_file_is_checked_before_the_work() {
    let swm = Swm::new();
    fs::write(swm.path("file"), "").expect("a file");
    for (args, name) in [
        (&["leaderboard", "submit", "nothing", "-o"][..], "entry.json"),
        (&["frame", "swm/TwoRoom-v1", "-o"], "frame.png"),
        (&["checkpoints", "pack", "nothing", "-o"], "model.safetensors"),
    ] {
        let fails = |folder: &str, parts: &[&str]| {
            swm.fails(&[args, &[format!("{folder}/{name}").as_str()]].concat(), 2, parts);
        };
        fails("missing/deeper", &["the folder missing/deeper does not exist", "mkdir -p missing/deeper"]);
        fails("file", &["file is a file, and not a folder"]);
        fails("s3://bucket", &["is a URI", "give a path"]);
    }
    assert!(!swm.path("missing").exists());
}

#[test]
fn videos_are_not_written_through_files_and_links() {
    let swm = Swm::new();
    let eval = ["eval", "expert", "--env", "swm/TwoRoom-v1", "--episodes", "1", "--budget", "3", "--image", "32"];
    fs::create_dir_all(swm.path("mine")).expect("a folder");
    for (folder, link) in [("a", false), ("b", true)] {
        fs::create_dir_all(swm.path(folder)).expect("a folder");
        let videos = swm.path(folder).join("videos");
        if link {
            std::os::unix::fs::symlink(swm.path("mine"), &videos).expect("a link");
        } else {
            fs::write(&videos, "").expect("a file");
        }
        swm.fails(&[&eval[..], &["--videos", "1", "-o", folder]].concat(), 2, &["videos", "a symbolic link"]);
    }
    assert_eq!(fs::read_dir(swm.path("mine")).expect("the folder").count(), 0);
}

#[test]
fn requests_are_checked_before_the_floor_is_played() {
    let swm = Swm::new();
    let simulator = ["eval", "simulator", "--env", "swm/TwoRoom-v1", "--episodes", "2", "--budget", "3"];
    let solver = |text: &'static str| [&simulator[..], &["--solver", text]].concat();
    for (args, parts) in [
        (solver("cem,samples=8,elites=20"), &["cem elites", "20 of 8"][..]),
        (solver("cem,iterations=0"), &["cem iterations"]),
        (solver("mppi,temperature=0"), &["mppi temperature"]),
        (solver("cem,samples=1152921504606846976"), &["samples", "1000000"]),
        (solver("cem,samples=8,samples=9"), &["given twice", "samples=8", "samples=9"]),
        ([&simulator[..], &["--horizon", "1152921504606846976"]].concat(), &["MPC horizon", "10000"]),
        ([&simulator[..], &["--pin", "agent.speed=1", "--pin", "agent.speed=2"]].concat(), &["agent.speed", "twice"]),
        ([&simulator[..], &["--pin", "agent.sped=1"]].concat(), &["did you mean agent.speed"]),
        ([&simulator[..], &["--wrapper", "noise,std=1,std=2"]].concat(), &["std=1", "std=2", "twice"]),
        ([&simulator[..], &["--term", "control,weight=1,weight=2"]].concat(), &["weight=1", "weight=2", "twice"]),
    ] {
        let output = swm.run(&args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {error}");
        assert!(parts.iter().all(|part| error.contains(part)), "{args:?}: {error}");
        assert!(!error.contains("evaluate: random") && !error.contains("panicked"), "{args:?}: {error}");
    }
    swm.fails(&["train", "lewm", "--data", "x", "seed=1", "seed=2"], 2, &["'seed=1' and 'seed=2'"]);
    let twice = "swm/OGBCube-v0,env_type=double,env_type=single";
    swm.fails(&["envs", twice], 2, &["'env_type=double' and 'env_type=single'"]);
}

#[test]
fn results_that_request_other_episodes_are_not_repeated() {
    let swm = Swm::new();
    swm.json(EVAL);
    let file = swm.path("found/results.json");
    let good: serde_json::Value =
        serde_json::from_slice(&fs::read(&file).expect("the results")).expect("a JSON document");
    for (pointer, value, parts) in [
        ("/manifest/config/episodes", (1u64 << 60).into(), &["1152921504606846976 episodes", "has 2"][..]),
        ("/manifest/config/image", serde_json::json!([1u64 << 40, 1u64 << 40]), &["frame size", "4096"]),
    ] {
        let mut bad = good.clone();
        *bad.pointer_mut(pointer).expect(pointer) = value;
        fs::write(&file, bad.to_string()).expect("the file is written");
        swm.fails(&["reproduce", "found"], 2, parts);
    }
}

#[test]
fn without_a_home_folder_nothing_goes_to_the_current_folder() {
    let swm = Swm::new();
    let run = |args: &[&str]| {
        let mut command: Command = swm.command(args);
        command.env_remove("STABLEWM_HOME").env_remove("HOME").env_remove("SWM_ASSETS").output().expect("swm starts")
    };
    let collect = ["collect", "swm/TwoRoom-v1", "--episodes", "1", "--no-pixels", "-o"];
    for args in
        [&[&collect[..], &["rooms"]].concat()[..], &["datasets"], &["checkpoints"], &["demo"], &["assets", "install"]]
    {
        let output = run(args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{args:?}: {error}");
        assert!(error.contains("set STABLEWM_HOME"), "{args:?}: {error}");
    }
    assert_eq!(fs::read_dir(swm.home()).expect("the folder").count(), 0);
    assert!(run(&[&collect[..], &["./rooms.lance"]].concat()).status.success(), "paths need no home folder");
}

#[test]
fn the_home_folder_is_on_this_machine() {
    let swm = Swm::new();
    let collect = ["collect", "swm/TwoRoom-v1", "--episodes", "1", "--no-pixels", "-o", "rooms"];
    let run = |variable: &str, value: &str, args: &[&str]| {
        swm.command(args).env("HOME", swm.path("user")).env(variable, value).output().expect("swm starts")
    };
    for (variable, args) in [("STABLEWM_HOME", &collect[..]), ("SWM_ASSETS", &["assets", "install"])] {
        let output = run(variable, "s3://bucket/home", args);
        let error = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{error}");
        assert!(error.contains(variable) && error.contains("s3://bucket/home is a URI"), "{error}");
    }
    assert_eq!(fs::read_dir(swm.home()).expect("the folder").count(), 0);
    let output = run("STABLEWM_HOME", "~/data", &collect);
    assert!(output.status.success(), "{}", text(&output.stderr));
    assert!(swm.path("user/data/datasets/rooms.lance").exists() && !swm.path("~").exists());
}

#[test]
fn paths_that_are_not_utf8_are_printed_as_json() {
    let swm = Swm::new();
    let odd = swm.home().join(OsStr::from_bytes(b"n\xffu"));
    fs::create_dir(&odd).expect("a folder");
    // The home folder and the current folder have the name as well.
    let json = |args: &[&str], output: Option<&str>| {
        let mut command = swm.command(args);
        command.env("STABLEWM_HOME", &odd).env("SWM_ASSETS", odd.join("assets")).current_dir(&odd);
        if let Some(name) = output {
            command.arg("-o").arg(odd.join(name));
        }
        let output = command.arg("--json").output().expect("swm starts");
        let error = text(&output.stderr);
        assert!(output.status.success() && !error.contains("panicked"), "swm {args:?}: {error}");
        let value: serde_json::Value = serde_json::from_slice(&output.stdout).expect("a JSON document");
        value.to_string()
    };
    // Lance has no such paths.
    swm.json(&["collect", "swm/TwoRoom-v1", "--policy", "explore", "--episodes", "10", "--image", "64", "-o", "rooms"]);
    let rooms = swm.path("datasets/rooms.lance").display().to_string();
    let settings = ["schedule.steps=4", "data.batch_size=8"];
    let train = [&["train", "pldm", "--data", &rooms, "-o", "model"], &settings[..]].concat();
    for (args, output) in [
        (&train[..], None),
        (&["train", "-o", "model", "--resume"], None),
        (&["checkpoints", "show", "model"], None),
        (&["checkpoints", "pack", "model", "--licence", "MIT", "--author", "Ada"], Some("model.safetensors")),
        (&["frame", "swm/TwoRoom-v1"], Some("frame.png")),
        (&["preview", &rooms, "--episodes", "1"], Some("preview")),
        (&["man"], Some("man")),
        (&["assets"], None),
    ] {
        let printed = json(args, output);
        assert!(printed.contains("n\u{fffd}u"), "{args:?}: {printed}");
    }
    let record = fs::read_to_string(odd.join("checkpoints/model/run.json")).expect("the record of a run");
    assert!(record.contains("n\u{fffd}u"), "{record}");
    assert!(json(&["checkpoints", "remove", "model", "--yes"], None).contains("n\u{fffd}u"));
    json(&["zoo"], None);
}

#[test]
fn text_from_files_does_not_control_the_terminal() {
    let swm = Swm::new();
    let name = "\u{1b}]0;owned\u{7}\u{9b}31m\u{202e}evil";
    fs::create_dir_all(swm.path("checkpoints").join(name)).expect("a folder");
    fs::create_dir_all(swm.path("datasets").join(format!("{name}.lance"))).expect("a folder");
    for args in [
        &["checkpoints"][..],
        &["checkpoints", "--json"],
        &["checkpoints", "verify"],
        &["datasets"],
        &["datasets", "--json"],
        &["inspect", name],
        &["checkpoints", "show", name],
        &[name],
        &["fovs", name],
    ] {
        let output = swm.run(args);
        let printed = text(&output.stdout) + &text(&output.stderr);
        assert!(printed.contains("evil"), "{args:?}: {printed:?}");
        let raw = |c: char| c != '\n' && (c.is_control() || c == '\u{202e}');
        assert!(!printed.contains(raw), "{args:?}: {printed:?}");
    }
    assert!(swm.json(&["checkpoints"])[0]["name"] == name, "JSON keeps the name");
}
