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
    let set =
        |change: &dyn Fn(&mut Value)| edit(Path::new(&file), |results| change(&mut results["manifest"]["config"]));
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
