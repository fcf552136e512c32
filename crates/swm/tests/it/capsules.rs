//! Tests of capsules: packing, verifying, and using them where a checkpoint goes.

use crate::{Swm, text};
use serde_json::{Value, json};
use std::fs;
use swm::capsule::EvaluationRecord;
use swm::core::{Batch, ColumnSpec, DType, Schema};
use swm::models::capsule::Capsule;

const PLANNER: &[&str] = &["--solver", "cem,samples=16,iterations=2,elites=4", "--budget", "20"];

/// Trains a small model on episodes of two rooms.
fn train(swm: &Swm) {
    let collect =
        ["collect", "swm/TwoRoom-v1", "-o", "rooms", "--image", "32", "--episodes", "12", "--max-steps", "40"];
    swm.json(&[&collect[..], &["--policy", "explore"]].concat());
    let train = ["train", "lewm", "--data", "rooms", "-o", "small", "schedule.steps=4", "schedule.warmup=0"];
    swm.json(&[&train[..], &["data.batch_size=16", "model.image=32"]].concat());
}

fn eval(swm: &Swm, model: &str, out: &str, more: &[&str]) -> Value {
    swm.json(&[&["eval", model, "--episodes", "6", "-o", out], PLANNER, more].concat())
}

/// Changes the record of the evaluation in a capsule.
fn edit(swm: &Swm, from: &str, to: &str, change: impl FnOnce(&mut Capsule)) {
    let mut capsule = Capsule::read(&swm.path(from)).expect("a capsule");
    change(&mut capsule);
    capsule.write(&swm.path(to)).expect("a written capsule");
}

fn record(capsule: &mut Capsule) -> &mut Value {
    &mut capsule.evaluation.as_mut().expect("an evaluation").record
}

#[test]
fn capsules_are_packed_verified_and_used_like_checkpoints() {
    let swm = Swm::new();
    train(&swm);
    for (name, more) in [("episodic", &[][..]), ("recorded", &["--dataset", "rooms", "--goal-offset", "10"])] {
        let file = format!("{name}.safetensors");
        let file = file.as_str();
        eval(&swm, "small", name, more);
        let pack = ["checkpoints", "pack", "small", "-o", file, "--eval", name, "--licence", "MIT", "--author", "we"];
        let packed = swm.json(&pack);
        let bytes = fs::read(swm.path(file)).expect("the capsule");
        swm.json(&pack);
        assert_eq!(fs::read(swm.path(file)).expect("the capsule"), bytes, "equal packs have equal bytes");

        // Without the dataset and the home folder of this machine.
        let other = Swm::new();
        fs::copy(swm.path(file), other.path(file)).expect("a copied file");
        let verified = &other.json(&["checkpoints", "verify", file])[0];
        assert_eq!((&verified["whole"], &verified["capsule"]["episodes"]), (&json!(true), &json!(3)), "{verified}");
        assert_eq!(verified["capsule"]["hash"], packed["hash"]);
        let shown = other.json(&["checkpoints", "show", file]);
        assert_eq!(shown["capsule"]["licence"], "MIT");
        assert!(shown["capsule"]["evaluation"]["success"]["n"].as_u64() > Some(0), "{shown}");

        // A capsule is evaluated like the checkpoint that it exports to.
        let args = ["checkpoints", "export", file, "exported"];
        other.json(&args);
        other.fails(&args, 2, &["holds a checkpoint already"]);
        let runs = |found: Value| found["runs"][1]["episodes"].clone();
        let from_file = runs(eval(&other, file, "a", &["--seed", "3"]));
        assert_eq!(from_file, runs(eval(&other, "./exported", "b", &["--seed", "3"])));
        other.json(&["reproduce", "a"]);
    }
    // Packing a capsule again with its own evaluation keeps the licence and the weights.
    eval(&swm, "episodic.safetensors", "own", &[]);
    let again = ["checkpoints", "pack", "episodic.safetensors", "-o", "again.safetensors", "--eval", "own"];
    swm.json(&again);
    let shown = swm.json(&["checkpoints", "show", "again.safetensors"]);
    assert_eq!(shown["capsule"]["licence"], "MIT");
    assert_eq!(shown["capsule"]["evaluation"]["weights"], shown["weights"]);
    // A capsule is packed in place; the capsule of another training is not replaced.
    // What a killed command left is deleted, and nothing of other files.
    let left = [".again.safetensors.77.tmp", ".other.safetensors.77.tmp"].map(|name| swm.path(name));
    left.iter().for_each(|path| fs::write(path, "cut off").expect("writing a file"));
    swm.json(&["checkpoints", "pack", "again.safetensors", "-o", "again.safetensors", "--author", "they"]);
    assert_eq!(left.each_ref().map(|path| path.exists()), [false, true]);
    let other = ["train", "lewm", "--data", "rooms", "-o", "second", "schedule.steps=4", "schedule.warmup=0", "seed=1"];
    swm.json(&[&other[..], &["data.batch_size=16", "model.image=32"]].concat());
    let bytes = fs::read(swm.path("again.safetensors")).expect("the capsule");
    let pack = ["checkpoints", "pack", "second", "-o", "again.safetensors"];
    swm.fails(&pack, 2, &["again.safetensors", "holds another model", "--output"]);
    assert_eq!(fs::read(swm.path("again.safetensors")).expect("the capsule"), bytes);
    swm.fails(&["checkpoints", "remove", "again.safetensors", "--yes"], 2, &["is a capsule"]);
    swm.fails(&["checkpoints", "pack", "small", "-o", "small.bin"], 2, &[".safetensors"]);
    fs::write(swm.path("notes.safetensors"), "notes").expect("a file of the user");
    swm.fails(&["checkpoints", "pack", "small", "-o", "notes.safetensors"], 2, &["was not written by this program"]);
    swm.fails(&["checkpoints", "verify", "notes.safetensors"], 1, &["1 of 1 checkpoints have faults"]);
    let faults = swm.run(&["checkpoints", "verify", "notes.safetensors"]).stdout;
    assert!(text(&faults).starts_with("notes.safetensors: is no capsule"), "{}", text(&faults));
    swm.json(&["eval", "random", "--env", "swm/TwoRoom-v1", "--episodes", "2", "-o", "other"]);
    let other = ["checkpoints", "pack", "small", "-o", "x.safetensors", "--eval", "other"];
    swm.fails(&other, 2, &["0 of its policies have the weights of this checkpoint"]);
}

#[test]
fn records_of_a_capsule_that_contradict_themselves_are_faults() {
    let swm = Swm::new();
    train(&swm);
    eval(&swm, "small", "found", &[]);
    swm.json(&["checkpoints", "pack", "small", "-o", "a.safetensors", "--eval", "found"]);
    let refused = |change: &dyn Fn(&mut Capsule), part: &str| {
        edit(&swm, "a.safetensors", "b.safetensors", change);
        let printed = swm.run(&["checkpoints", "verify", "b.safetensors"]).stdout;
        assert!(text(&printed).contains(part), "no '{part}' in {}", text(&printed));
    };
    let twice = |capsule: &mut Capsule| {
        record(capsule)["episodes"][1]["number"] = record(capsule)["episodes"][0]["number"].clone()
    };
    refused(&twice, "it records an episode twice");
    let opposite = |capsule: &mut Capsule| {
        let episodes = record(capsule)["episodes"].as_array().expect("episodes").clone();
        let solved = |episode: &Value| episode["success"] == true && episode["solved_at_start"] == false;
        let n = record(capsule)["success"][1].clone();
        record(capsule)["success"] = if episodes.iter().any(solved) { json!([0, n]) } else { json!([n, n]) };
    };
    refused(&opposite, "episodes solved, and its recorded episodes are");
}

#[test]
fn changed_records_of_a_capsule_are_found_and_hostile_ones_refused() {
    let swm = Swm::new();
    train(&swm);
    eval(&swm, "small", "found", &[]);
    swm.json(&["checkpoints", "pack", "small", "-o", "a.safetensors", "--eval", "found"]);
    let verify = ["checkpoints", "verify", "b.safetensors"];
    let refused = |change: &dyn Fn(&mut Capsule), part: &str| {
        edit(&swm, "a.safetensors", "b.safetensors", change);
        let output = swm.run(&verify);
        let (code, printed) = (output.status.code(), text(&output.stdout));
        assert_eq!(code, Some(1), "{part}: {printed}{}", text(&output.stderr));
        assert!(printed.contains(part), "no '{part}' in {printed}");
    };
    refused(&|capsule| record(capsule)["episodes"][0]["steps"] = json!(7), "was recorded as");
    refused(&|capsule| record(capsule)["request"]["seed"] = json!(99), "start with other values");
    let outputs = |capsule: &mut Capsule| {
        let tensor = capsule.reference.outputs.values_mut().next().expect("an output");
        tensor.values[0] += 1.0;
    };
    refused(&outputs, "the reference outputs differ");
    refused(&|capsule| record(capsule)["request"]["env"] = json!("evil_mod:X-v0"), "imports a Python module");
    let own = |capsule: &mut Capsule| {
        record(capsule)["request"]["policies"][0]["acts"]["plan"]["model"] = json!({"checkpoint": "small"});
    };
    refused(&own, "is not the model of the capsule");
    refused(&|capsule| record(capsule)["request"]["budget"] = json!(1_u64 << 40), "number of steps");
    refused(&|capsule| record(capsule)["request"]["budget"] = json!(1 << 20), "more than 10000");
    refused(&|capsule| record(capsule)["request"]["version"] = json!(2), "layout 2");
    refused(&|capsule| record(capsule)["request"]["image"] = json!([1_u64 << 40, 64]), "pixels");
    refused(&|capsule| record(capsule)["episodes"] = json!([]), "3 starts");
    refused(&|capsule| record(capsule)["episodes"][0]["number"] = json!(u64::MAX), "choosing starts");
    refused(&|capsule| record(capsule)["success"] = json!([9, 3]), "more successes than episodes");
    refused(&|capsule| record(capsule)["success"] = json!([1u64 << 60, 1u64 << 60]), "counts more than the");
    refused(&|capsule| *record(capsule) = json!([]), "the evaluation in the capsule");
    refused(&|capsule| record(capsule)["weights"] = json!("trust me"), "'trust me' is no hash");
    refused(&|capsule| record(capsule)["hashes"]["starts"] = json!("/etc/passwd"), "'/etc/passwd' is no hash");
    refused(&|capsule| record(capsule)["weights"] = json!("0".repeat(64)), "is that of other weights");
    let media = json!([{"id": "chroma-key", "settings": {"key_color": [0, 0, 0], "media": "/dev/zero"}}]);
    refused(&|capsule| record(capsule)["request"]["wrappers"] = media.clone(), "reads files");

    // Reference inputs of other columns, sizes and types.
    let inputs = |columns: Vec<ColumnSpec>| Batch::zeros(&Schema::new(columns).expect("a schema"), 4);
    let actions = |dim: usize| ColumnSpec::new("actions", DType::Float32, [3, dim]);
    let with =
        |columns: Vec<ColumnSpec>| move |capsule: &mut Capsule| capsule.reference.inputs = inputs(columns.clone());
    refused(&with(vec![actions(10)]), "unknown column 'pixels'");
    refused(&with(vec![ColumnSpec::image("pixels", 31, 32), actions(10)]), "pixels");
    refused(&with(vec![ColumnSpec::new("pixels", DType::Float64, [32, 32, 3]), actions(10)]), "pixels");
    refused(&with(vec![ColumnSpec::image("pixels", 32, 32)]), "unknown column 'actions'");
    refused(&with(vec![ColumnSpec::image("pixels", 32, 32), actions(7)]), "actions");
    refused(&with(vec![ColumnSpec::image("pixels", 32, 32), actions(0)]), "actions");

    // The environment of the model itself is refused, too, until the user names it.
    edit(&swm, "a.safetensors", "b.safetensors", |capsule| {
        capsule.checkpoint["facts"]["env"] = json!("evil_mod:X-v0");
        capsule.checkpoint["env"] = json!("evil_mod:X-v0");
    });
    swm.fails(&["eval", "b.safetensors", "--episodes", "1"], 2, &["b.safetensors", "imports a Python module"]);
    let capsule = Capsule::read(&swm.path("a.safetensors")).expect("a capsule");
    let record = EvaluationRecord::read(capsule.evaluation.as_ref().expect("an evaluation")).expect("a record");
    assert_eq!(record.episodes.len(), 3);
}
