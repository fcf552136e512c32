//! Tests of the zoo: names, folders, and the capsules of the repository.

use crate::{Swm, text};
use serde_json::json;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm::capsule::{EvaluationRecord, computes_alike, cpu_level, verify};
use swm::core::Origin;
use swm::core::run::Control;
use swm::eval::{RunOptions, StartsRequest};
use swm::models::capsule::Capsule;
use swm::zoo;
use swm_simd::{CpuLevel, limit_cpu_level};

/// The most bytes of all capsules in the repository.
const MAX_ALL: u64 = 60_000_000;

/// The capsules in `zoo/` of the repository: name and path.
fn repository() -> Vec<(String, PathBuf)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../zoo");
    let mut found = vec![];
    for folder in fs::read_dir(&root).expect("the zoo").flatten().filter(|entry| entry.path().is_dir()) {
        for file in fs::read_dir(folder.path()).expect("a folder of the zoo").flatten() {
            let name =
                format!("{}/{}", folder.file_name().display(), file.path().file_stem().expect("a name").display());
            found.push((name, file.path()));
        }
    }
    found.sort();
    found
}

/// Every capsule of the repository behaves as it records, is complete, and is small.
#[test]
fn capsules_of_the_repository_are_valid() {
    let swm = Swm::new();
    let all = repository();
    assert!(!all.is_empty());
    let bytes: u64 = all.iter().map(|(_, path)| fs::metadata(path).expect("a file").len()).sum();
    assert!(bytes <= MAX_ALL, "the zoo has {bytes} bytes");
    for (name, path) in &all {
        assert_eq!(path.extension().and_then(|end| end.to_str()), Some("safetensors"), "{}", path.display());
        let capsule = Capsule::read(path).unwrap_or_else(|error| panic!("{error}"));
        let evaluation = capsule.evaluation.as_ref().unwrap_or_else(|| panic!("{name} has no evaluation"));
        let record = EvaluationRecord::read(evaluation).expect("an evaluation");
        assert_eq!(record.weights, capsule.weights_hash(), "{name} was evaluated with other weights");
        assert!(record.floor.is_some() && record.success[1] >= 50, "{name}: {:?}", record.success);
        let described = &capsule.description;
        assert!(described.licence.is_some() && described.author.is_some(), "{name} has no licence or no author");
        let zoo_name = format!("zoo:{name}");
        let output = swm.run(&["checkpoints", "verify", &zoo_name]);
        assert!(output.status.success(), "{name}: {}{}", text(&output.stdout), text(&output.stderr));

        // Without options, an evaluation plays the recorded episodes whose starts the environment draws.
        let env = || swm::env(&record.request.env, &Origin::User).and_then(|env| env.env());
        if record.request.starts != StartsRequest::Episodic || env().is_err() {
            continue;
        }
        let episodes = 1 + record.episodes.iter().map(|episode| episode.number).max().expect("an episode");
        let found = swm.json(&["eval", &zoo_name, "--episodes", &episodes.to_string()]);
        for episode in record.episodes.iter().filter(|_| computes_alike(&described.cpu_level, &cpu_level())) {
            let played = &found["runs"][1]["episodes"][episode.number];
            assert_eq!(
                (&played["success"], &played["steps"]),
                (&json!(episode.success), &json!(episode.steps)),
                "{name}"
            );
        }
    }
    // Processors without fused multiplications compute nearly the same outputs, the others the same bits.
    for level in [CpuLevel::Baseline, CpuLevel::Avx2] {
        limit_cpu_level(level);
        for (name, path) in &all {
            let found = verify(path, false, &RunOptions::default(), &mut Control::new()).expect(name);
            assert!(found.faults.is_empty(), "{name} with {level:?}: {:?}", found.faults);
            if computes_alike(&found.packed_on, &found.verified_on) {
                assert_eq!(
                    found.difference, 0.0,
                    "{name}: packed on {}, run on {}",
                    found.packed_on, found.verified_on
                );
            }
        }
    }
    limit_cpu_level(CpuLevel::Avx512);
    let listed = swm.json(&["zoo"]);
    let names: Vec<&str> = listed.as_array().expect("a list").iter().filter_map(|row| row["name"].as_str()).collect();
    assert_eq!(names, all.iter().map(|(name, _)| name.as_str()).collect::<Vec<_>>());
}

/// A capsule named `expert` plays an environment that has no scripted expert.
#[test]
fn expert_of_the_zoo_is_the_policy_of_its_environment() {
    let swm = Swm::new();
    let experts = zoo::experts();
    assert!(experts.iter().any(|(name, _)| name == "zoo:cartpole-swingup/expert"), "{experts:?}");
    let listed = text(&swm.run(&["envs"]).stdout);
    assert!(listed.contains("expert,task=swingup"), "{listed}");
    for (name, env) in &experts {
        let entry = swm::env(env, &Origin::User).expect(env).entry;
        assert_eq!(zoo::trained_expert(&entry, env, "expert").as_ref(), Some(name));
        if swm::env(env, &Origin::User).and_then(|env| env.env()).is_err() {
            continue;
        }
        let found = swm.json(&["eval", "expert", "--env", env, "--episodes", "2"]);
        let weights = swm.json(&["checkpoints", "show", name])["capsule"]["weights"].clone();
        assert_eq!(found["manifest"]["hashes"]["weights"], weights, "{name}");
        swm.json(&[
            "collect",
            env,
            "--policy",
            "expert",
            "--episodes",
            "1",
            "--no-pixels",
            "-o",
            "played.lance",
            "--overwrite",
        ]);
    }
    // Scripted experts of some tasks do not play the others.
    swm.fails(
        &["eval", "expert", "--env", "swm/ManipulatorDMControl-v0,task=bring_peg", "--episodes", "2"],
        2,
        &["experts of bring_ball only"],
    );
    swm.fails(
        &["eval", "expert", "--env", "swm/CartpoleDMControl-v0,task=balance", "--episodes", "2"],
        2,
        &["no expert"],
    );
}

#[test]
fn folders_of_the_zoo_are_searched_in_order() {
    let swm = Swm::new();
    let (_, path) = repository().swap_remove(0);
    let own = swm.path("own/maze");
    for folder in [&own, &swm.path("zoo/maze")] {
        fs::create_dir_all(folder).expect("a folder");
        fs::copy(&path, folder.join("model.safetensors")).expect("a copied file");
    }
    fs::write(swm.path("zoo/maze/broken.safetensors"), "no capsule").expect("a file");
    let found = |given: Option<&str>| {
        let mut command = swm.command(&["zoo", "--json"]);
        command.env_remove("SWM_ZOO").envs(given.map(|folder| ("SWM_ZOO", folder)));
        let output = command.output().expect("swm starts");
        let rows: Vec<serde_json::Value> = serde_json::from_slice(&output.stdout).expect("JSON");
        let row = |name: &str| rows.iter().find(|row| row["name"] == name).cloned().expect(name);
        assert!(row("maze/broken")["error"].as_str().is_some_and(|error| error.contains("is no capsule")));
        row("maze/model")["path"].as_str().expect("a path").to_owned()
    };
    assert!(found(None).contains("zoo/maze"));
    assert!(found(Some("own")).contains("own/maze"));
    assert!(swm.json(&["checkpoints", "show", "zoo:maze/model"])["capsule"]["hash"].is_string());
    swm.fails(
        &["checkpoints", "show", "zoo:maze/modle"],
        2,
        &["unknown capsule", "did you mean maze/model", "swm zoo"],
    );
    for name in ["zoo:../zoo/maze/model", "zoo:", "zoo:/etc/passwd", "zoo:maze/../maze/model"] {
        swm.fails(&["checkpoints", "show", name], 2, &["unknown capsule"]);
    }
}

/// The engine of a Python package names the data wheel for the capsules that only it has. `python/tests/test_zoo.py` installs it.
#[test]
fn capsules_of_the_data_wheel_are_named() {
    let swm = Swm::new();
    let zoo = swm.path("site/stable_worldmodel/share/swm/zoo");
    fs::create_dir_all(&zoo).expect("a folder");
    fs::write(zoo.join("data-wheel.txt"), "maze/large\nmaze/other\n").expect("a file");
    let program = swm.path("site/stable_worldmodel/swm");
    std::os::unix::fs::symlink(env!("CARGO_BIN_EXE_swm"), &program).expect("a link");
    let run = |args: &[&str]| {
        let mut command = Command::new(&program);
        let output = command.args(args).env("STABLEWM_HOME", swm.home()).env_remove("SWM_ZOO").output();
        output.expect("swm starts")
    };
    let missing = run(&["checkpoints", "show", "zoo:maze/large"]);
    let error = text(&missing.stderr);
    assert_eq!(missing.status.code(), Some(2), "{error}");
    assert!(error.contains("stable-worldmodel-rs-zoo") && error.contains("pip install"), "{error}");
    let listed = text(&run(&["zoo"]).stdout);
    assert!(listed.contains("not installed: zoo:maze/large, zoo:maze/other"), "{listed}");
}

/// A program that is found through `$PATH` does not take capsules of the current folder.
#[test]
fn current_folder_is_no_zoo() {
    let swm = Swm::new();
    let planted = swm.path("here/share/swm/zoo/maze");
    fs::create_dir_all(&planted).expect("a folder");
    fs::copy(&repository()[0].1, planted.join("planted.safetensors")).expect("a copied file");
    let program = Path::new(env!("CARGO_BIN_EXE_swm"));
    let mut command = Command::new("swm");
    command.arg("zoo").env("PATH", program.parent().expect("a folder")).current_dir(swm.path("here"));
    let output = command.env("STABLEWM_HOME", swm.home()).output().expect("swm starts");
    assert!(output.status.success() && !text(&output.stdout).contains("maze/planted"), "{}", text(&output.stdout));
}

/// The version is declared in the workspace; files that Cargo does not read repeat it.
#[test]
fn other_files_have_the_version_of_the_engine() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let version = env!("CARGO_PKG_VERSION");
    for (file, line) in [
        ("CITATION.cff", format!("version: {version}")),
        ("python/pyproject.toml", format!("zoo = [\"stable-worldmodel-rs-zoo=={version}\"]")),
    ] {
        let text = fs::read_to_string(root.join(file)).expect(file);
        assert!(text.lines().any(|found| found == line), "{file} has no line `{line}`");
    }
}
