//! Tests that files do not choose code (docs/security.md).

use crate::gym::python;
use crate::{Swm, text};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// A module that leaves a file when it is imported.
const MODULE: &str = "
import gymnasium, pathlib
from gymnasium.envs.classic_control import CartPoleEnv
pathlib.Path(__file__).with_name('imported').touch()
gymnasium.register('Cart-v0', CartPoleEnv, max_episode_steps=5)
";

/// Applies `change` to a JSON file.
fn edit(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut value = serde_json::from_slice(&fs::read(path).expect("the file")).expect("JSON");
    change(&mut value);
    fs::write(path, value.to_string()).expect("writing the file");
}

/// Evaluates the random policy and returns the path of the results.
fn results(swm: &Swm, env: &str) -> String {
    let args = ["eval", "random", "--env", env, "--episodes", "1", "--budget", "2", "--no-pixels", "-o", "results"];
    swm.json(&args);
    swm.path("results/results.json").to_string_lossy().into_owned()
}

#[test]
fn checkpoint_does_not_choose_a_module() {
    let swm = Swm::new();
    fs::write(swm.path("evil_mod.py"), MODULE).expect("a module");
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "2", "--image", "32", "--max-steps", "20"]);
    let train = ["train", "lewm", "--data", "rooms", "-o", "./run", "schedule.steps=1", "schedule.warmup=0"];
    swm.json(&[&train[..], &["data.batch_size=2", "model.image=32"]].concat());
    let config = swm.path("run/checkpoint/config.json");
    let stored = fs::read_to_string(&config).expect("the configuration");
    assert!(stored.contains("swm/TwoRoom-v1"), "{stored}");
    fs::write(&config, stored.replace("swm/TwoRoom-v1", "evil_mod:Cart-v0")).expect("writing the configuration");
    swm.fails(&["eval", "./run", "--episodes", "1"], 1, &["config.json", "the hash differs"]);
    // A stranger leaves the hash out.
    edit(&swm.path("run/checkpoint/manifest.json"), |manifest| {
        manifest["hashes"].as_object_mut().expect("the hashes").remove("config");
    });
    let parts = ["run", "'evil_mod:Cart-v0'", "imports a Python module", "--env 'evil_mod:Cart-v0'", "--trust"];
    swm.fails(&["eval", "./run", "--episodes", "1"], 2, &parts);
    assert!(!swm.path("imported").exists());
}

#[test]
fn results_do_not_choose_modules_files_and_connections() {
    let swm = Swm::new();
    let file = results(&swm, "swm/TwoRoom-v1");
    // What the results state is what their request says.
    let set = |change: &dyn Fn(&mut Value)| {
        edit(Path::new(&file), |results| {
            let request = &mut results["manifest"]["config"];
            change(request);
            let (env, is_dataset) = (request["env"].clone(), request["starts"].is_object());
            results["env"] = env;
            results["protocol"] = json!(if is_dataset { "dataset" } else { "episodic" });
        });
    };
    let refused =
        |parts: &[&str]| swm.fails(&["reproduce", "results"], 2, &[&["results.json", "--trust"], parts].concat());

    set(&|request| request["env"] = json!("evil_mod:Cart-v0"));
    refused(&["evil_mod:Cart-v0", "imports a Python module", "--env"]);
    swm.fails(&["reproduce", "results", "--env", "CartPole-v1"], 2, &["the results are of evil_mod:Cart-v0"]);
    set(&|request| request["env"] = json!("Ant-v5,xml_file=/etc/passwd"));
    refused(&["xml_file=/etc/passwd"]);

    let media = json!([{"id": "chroma-key", "settings": {"key_color": [0, 0, 0], "media": "/dev/zero"}}]);
    set(&|request| (request["env"], request["wrappers"]) = (json!("swm/TwoRoom-v1"), media.clone()));
    refused(&["chroma-key", "reads files"]);

    let starts = json!({"dataset": {"dataset": "http://127.0.0.1:9/x.lance", "goal_offset": 2, "held_out": null}});
    set(&|request| (request["wrappers"], request["starts"]) = (json!([]), starts.clone()));
    refused(&["http://127.0.0.1:9/x.lance", "network connection"]);
}

#[test]
fn user_allows_a_module_that_results_name() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    fs::write(swm.path("evil_mod.py"), MODULE).expect("a module");
    results(&swm, "evil_mod:Cart-v0");
    fs::remove_file(swm.path("imported")).expect("the user's own environment was imported");
    swm.fails(&["reproduce", "results"], 2, &["evil_mod:Cart-v0"]);
    assert!(!swm.path("imported").exists());
    swm.json(&["reproduce", "results", "--env", "evil_mod:Cart-v0"]);
    swm.json(&["reproduce", "results", "--trust"]);
}

#[test]
fn dataset_that_is_continued_does_not_choose_a_module() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    fs::write(swm.path("evil_mod.py"), MODULE).expect("a module");
    let options = ["-o", "carts", "--policy", "random", "--no-pixels"];
    let collect = [&["collect", "evil_mod:Cart-v0", "--episodes", "2"][..], &options].concat();
    swm.json(&collect);
    fs::remove_file(swm.path("imported")).expect("the user's own environment was imported");
    let resume = ["collect", "--resume", "-o", "carts", "--episodes", "3"];
    swm.fails(&resume, 2, &["carts.lance", "'evil_mod:Cart-v0'", "imports a Python module", "--trust"]);
    assert!(!swm.path("imported").exists());
    assert_eq!(swm.json(&[&collect[..], &["--resume"]].concat())["collected"]["added"], 0);
    assert_eq!(swm.json(&[&resume[..], &["--trust"]].concat())["collected"]["added"], 1);
}

/// Files of the current folder do not replace modules that the worker imports.
#[test]
fn current_folder_hides_no_module() {
    if !python("gymnasium") {
        return;
    }
    let swm = Swm::new();
    for name in ["json", "ctypes", "mmap", "gymnasium", "numpy", "swm_bridge", "pip"] {
        let source = "import pathlib; pathlib.Path(__file__).with_name('imported').touch(); raise SystemExit(3)";
        fs::write(swm.path(&format!("{name}.py")), source).expect("a module");
    }
    let output = swm.run(&["envs", "CartPole-v1"]);
    assert!(output.status.success() && !swm.path("imported").exists(), "{}", text(&output.stderr));
}

#[test]
fn record_of_a_run_chooses_no_recipe_and_no_weights() {
    let swm = Swm::new();
    fs::write(swm.path("evil_mod.py"), MODULE).expect("a module");
    fs::create_dir_all(swm.path("run")).expect("a folder");
    let recipe =
        "summary = \"s\"\n[[collect]]\nname = \"a\"\nenv = \"evil_mod:Cart-v0\"\nepisodes = 1\nno-pixels = true\n";
    fs::write(swm.path("run/evil.toml"), recipe).expect("a recipe");
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "2", "--image", "32", "--max-steps", "20"]);
    let resume = |command: &[&str], code: i32, parts: &[&str]| {
        let command = json!({
            "command": command, "folder": swm.home(), "started": "", "git": null, "version": "", "cpu": "", "os": "",
            "assets": {},
        });
        fs::write(swm.path("run/run.json"), json!({"commands": [command]}).to_string()).expect("a record");
        swm.fails(&["train", "--output", "./run", "--resume"], code, &[&["run.json"], parts].concat());
        assert!(!swm.path("imported").exists() && !swm.path("run/checkpoint").exists());
    };
    let train = ["swm", "train", "--recipe", "run/evil.toml", "--trust", "-o", "run", "a.seed=1"];
    resume(&train, 1, &["no command line of a training"]);
    let train = ["swm", "train", "sac", "--env", "evil_mod:Cart-v0", "-o", "run"];
    resume(&train, 2, &["'evil_mod:Cart-v0'", "imports a Python module"]);
    let train = ["swm", "train", "pldm", "--data", "s3://bucket/run", "-o", "run"];
    resume(&train, 2, &["s3://bucket/run", "opens a connection"]);
    let train = ["swm", "train", "dino_wm", "--data", "rooms", "-o", "run", "model.weights=nobody/nothing"];
    resume(&train, 2, &["nobody/nothing", "may be downloaded"]);
    // Such a run is not continued at all.
    let train = ["swm", "train", "inverse", "--data", "rooms", "--encoder", "s3://bucket/run", "-o", "run"];
    let record = fs::read_to_string(swm.path("run/run.json")).expect("the record");
    let mut record: Value = serde_json::from_str(&record).expect("JSON");
    record["commands"][0]["command"] = json!(train);
    fs::write(swm.path("run/run.json"), record.to_string()).expect("a record");
    swm.fails(&["train", "--output", "./run", "--resume"], 2, &["cannot be resumed"]);
}

#[test]
fn record_of_a_run_chooses_no_folder_that_is_written_to() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "12", "--image", "64", "--max-steps", "9"]);
    let settings = ["schedule.steps=1", "schedule.warmup=0", "data.batch_size=8"];
    let train = ["train", "gcbc", "--preset", "keypoints", "--data", "rooms", "-o", "./run"];
    swm.json(&[&train[..], &settings].concat());
    let file = swm.path("run/run.json");
    let record = fs::read_to_string(&file).expect("the record").replacen(
        "\"--data\"",
        "\"--feature-cache\", \"elsewhere\", \"--data\"",
        1,
    );
    assert!(record.contains("elsewhere"));
    fs::write(&file, record).expect("the record");
    swm.json(&["train", "--output", "./run", "--resume"]);
    assert!(!swm.path("elsewhere").exists(), "the record chose a folder");
    swm.json(&["train", "--output", "./run", "--resume", "--feature-cache", "mine"]);
    assert!(swm.path("mine").is_dir());
}

#[test]
fn cache_that_cannot_be_made_leaves_no_run() {
    let swm = Swm::new();
    swm.json(&["collect", "swm/TwoRoom-v1", "-o", "rooms", "--episodes", "12", "--image", "64", "--max-steps", "9"]);
    let settings = ["schedule.steps=1", "schedule.warmup=0", "data.batch_size=8"];
    let train = [&["train", "gcbc", "--preset", "keypoints", "--data", "rooms", "-o", "./run"][..], &settings].concat();
    fs::write(swm.path("file"), "").expect("writing a file");
    for cache in ["file", "file/cache"] {
        swm.fails(&[&train[..], &["--feature-cache", cache]].concat(), 1, &[cache, "creating the cache's folder"]);
        assert!(!swm.path("run").exists(), "{cache}");
    }
    swm.json(&train);
    // Another run in the folder is refused before there is a cache.
    swm.fails(&[&train[..], &["--feature-cache", "cache"]].concat(), 2, &["run"]);
    assert!(!swm.path("cache").exists());
    // A model without a fixed part has no features to keep.
    let train = [&["train", "gcbc", "--preset", "tiny", "--data", "rooms", "-o", "./other"][..], &settings].concat();
    swm.json(&[&train[..], &["--feature-cache", "file"]].concat());
}

#[test]
fn results_on_a_server_open_no_connection() {
    let swm = Swm::new();
    swm.json(&[
        "demo",
        "-o",
        "demo",
        "--episodes",
        "2",
        "--eval-episodes",
        "2",
        "schedule.steps=2",
        "schedule.warmup=1",
    ]);
    let file = swm.path("demo/results/results.json");
    let text = fs::read_to_string(&file).expect("the results");
    let name = "demo/pldm-rooms\"";
    assert!(text.contains(name), "{text}");
    let server = std::net::TcpListener::bind("127.0.0.1:0").expect("a server");
    server.set_nonblocking(true).expect("a server that does not wait");
    let uri = format!("http://{}/run", server.local_addr().expect("its address"));
    fs::write(&file, text.replace(name, &format!("{uri}\""))).expect("the results");
    swm.json(&["report", "demo/results", "-o", "page"]);
    swm.fails(&["leaderboard", "submit", "demo/results", "-o", "entry.json"], 2, &["on a server", "--author"]);
    assert!(server.accept().is_err(), "a connection was opened");
}

#[test]
fn repository_of_a_stranger_starts_no_program() {
    let swm = Swm::new();
    let git = |arguments: &[&str]| {
        let mut git = std::process::Command::new("git");
        git.args(["-c", "user.name=A", "-c", "user.email=a@b"]).args(arguments).current_dir(swm.home());
        let output = git.output().expect("git");
        assert!(output.status.success(), "git {arguments:?}: {}", text(&output.stderr));
        text(&output.stdout)
    };
    git(&["init", "--quiet"]);
    fs::write(swm.path("code.py"), "pass\n").expect("a file");
    git(&["add", "code.py"]);
    git(&["commit", "--quiet", "--message", "code"]);
    let commit = git(&["rev-parse", "HEAD"]).trim().to_owned();
    let recorded = || {
        results(&swm, "swm/TwoRoom-v1");
        let record: Value =
            serde_json::from_slice(&fs::read(swm.path("results/run.json")).expect("the record")).expect("JSON");
        record["commands"][0]["git"].as_str().expect("a commit").to_owned()
    };
    assert_eq!(recorded(), commit);
    fs::write(swm.path("code.py"), "print()\n").expect("a changed file");
    assert_eq!(recorded(), format!("{commit}-dirty"));

    let marker = swm.path("started");
    let program = swm.path("program.sh");
    fs::write(&program, format!("#!/bin/sh\ntouch '{}'\ncat\n", marker.display())).expect("a program");
    let executable = std::os::unix::fs::PermissionsExt::from_mode(0o755);
    fs::set_permissions(&program, executable).expect("making it executable");
    let path = program.to_str().expect("a path");
    git(&["config", "core.fsmonitor", path]);
    fs::copy(&program, swm.path(".git/hooks/post-index-change")).expect("a hook");
    assert_eq!(recorded(), format!("{commit}-dirty"));
    assert!(!marker.exists(), "a monitor or a hook was started");
    git(&["config", "--unset", "core.fsmonitor"]);
    fs::remove_file(swm.path(".git/hooks/post-index-change")).expect("removing the hook");
    let _ = fs::remove_file(&marker);
    // A submodule has a configuration of its own.
    let inner = |arguments: &[&str]| git(&[&["-C", "inner"], arguments].concat());
    git(&["init", "-q", "inner"]);
    fs::write(swm.path("inner/.gitattributes"), "* filter=evil\n").expect("attributes");
    fs::write(swm.path("inner/file"), "content\n").expect("a file");
    inner(&["add", "."]);
    inner(&["-c", "user.name=A", "-c", "user.email=a@b.c", "commit", "-qm", "inner"]);
    git(&["add", "inner"]);
    inner(&["config", "filter.evil.clean", path]);
    // Equal content with another time, which git would read again.
    fs::write(swm.path("inner/file"), "content\n").expect("a file");
    assert_eq!(recorded(), format!("{commit}-dirty"));
    assert!(!marker.exists(), "a filter of a submodule was started");
    git(&["config", "filter.evil.clean", path]);
    fs::write(swm.path(".gitattributes"), "* filter=evil\n").expect("attributes");
    assert_eq!(recorded(), commit);
    assert!(!marker.exists(), "a filter was started");
}
