//! Tests of commands on files that a stranger made (docs/security.md).

use crate::Swm;
use crate::deletion::DEMO;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

const RUN: &str = "demo/pldm-rooms";

fn read(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("reading the file")).expect("parsing the JSON")
}

#[test]
fn verify_reports_missing_hashes_and_infinite_weights() {
    let swm = Swm::new();
    swm.json(DEMO);
    let verified = swm.json(&["checkpoints", "verify", RUN]);
    assert_eq!(verified[0]["whole"], json!(true), "{verified}");

    let path = swm.path(RUN).join("checkpoint/manifest.json");
    let mut manifest = read(&path);
    manifest["hashes"].as_object_mut().expect("the manifest has hashes").remove("weights");
    fs::write(&path, manifest.to_string()).expect("writing a file");
    swm.fails(&["checkpoints", "verify", RUN], 1, &["1 of 1 checkpoints have faults"]);
    let verified = swm.run(&["checkpoints", "verify", RUN]);
    assert!(crate::text(&verified.stdout).contains("no hash of weights.safetensors"));

    let path = swm.path(RUN).join("checkpoint/weights.safetensors");
    let mut weights = fs::read(&path).expect("reading the file");
    let end = weights.len() - 4;
    weights[end..].copy_from_slice(&f32::NAN.to_le_bytes());
    fs::write(&path, weights).expect("writing a file");
    let verified = swm.run(&["checkpoints", "verify", RUN]);
    assert!(crate::text(&verified.stdout).contains("not finite"));
    swm.fails(&["checkpoints", "show", RUN], 1, &["not finite"]);
}

#[test]
fn absurd_sizes_in_a_checkpoint_are_errors_of_every_command() {
    let swm = Swm::new();
    swm.json(DEMO);
    let path = swm.path(RUN).join("checkpoint/config.json");
    let original = read(&path);
    let sizes =
        ["/config/model/latent", "/config/model/predictor/depth", "/config/data/frameskip", "/facts/action/mean"];
    for pointer in sizes {
        let mut changed = original.clone();
        let new = if pointer.ends_with("mean") { json!([]) } else { json!(1_u64 << 60) };
        *changed.pointer_mut(pointer).expect("the value exists") = new;
        fs::write(&path, changed.to_string()).expect("writing a file");
        for command in [&["checkpoints", "show", RUN][..], &["checkpoints", "verify", RUN]] {
            swm.fails(command, 1, &[]);
        }
        let train = ["train", "inverse", "--data", "demo/rooms.lance", "--encoder", RUN, "-o", "inverse"];
        let output = swm.run(&train);
        assert!(matches!(output.status.code(), Some(1 | 2)), "{}", crate::text(&output.stderr));
    }
}
