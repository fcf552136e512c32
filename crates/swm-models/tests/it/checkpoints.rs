//! Errors of damaged and unsuitable checkpoints name the problem.

use crate::training::{config, run};
use std::path::Path;
use swm_models::lewm::Lewm;
use swm_models::{Checkpoint, TrainOptions};

fn edit(path: &Path, change: impl FnOnce(&mut serde_json::Value)) {
    let mut value = serde_json::from_slice(&std::fs::read(path).expect("reading the file")).expect("parsing the JSON");
    change(&mut value);
    std::fs::write(path, value.to_string()).expect("writing the file");
}

#[test]
fn damaged_checkpoints_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let trained = folder.path().join("run");
    let load = |path: &Path| Checkpoint::<Lewm>::load(path, &crate::device());
    let message = |path: &Path| load(path).expect_err("loading must fail").to_string();
    assert!(message(&trained).contains("no checkpoint"));

    run(&config(&["schedule.steps=1"]), &trained, &crate::options(), 0).expect("training the model");
    let checkpoint = load(&trained).expect("loading the undamaged checkpoint");
    assert_eq!(checkpoint.dataset_info.env.as_deref(), Some("test/Dots-v0"));
    assert_eq!(checkpoint.hash().len(), 64);

    let inner = trained.join("checkpoint");
    let weights = inner.join("weights.safetensors");
    let valid_weights = std::fs::read(&weights).expect("reading the file");
    std::fs::write(&weights, &valid_weights[..valid_weights.len() / 2]).expect("writing the file");
    assert!(message(&trained).contains("is damaged"), "{}", message(&trained));
    let mut flipped = valid_weights.clone();
    *flipped.last_mut().expect("bytes") ^= 1;
    std::fs::write(&weights, flipped).expect("writing the file");
    assert!(message(&trained).contains("the hash differs"), "{}", message(&trained));
    std::fs::write(&weights, &valid_weights).expect("writing the file");

    let config_file = inner.join("config.json");
    let original = std::fs::read(&config_file).expect("reading the file");
    edit(&config_file, |file| file["config"]["model"]["latent"] = 8.into());
    assert!(message(&trained).contains("but config.json requires"), "{}", message(&trained));
    std::fs::write(&config_file, &original).expect("writing the file");
    edit(&config_file, |file| file["config"]["model"]["predictor"]["depth"] = 1.into());
    assert!(message(&trained).contains("is not a weight of config.json"), "{}", message(&trained));
    std::fs::write(&config_file, &original).expect("writing the file");
    edit(&config_file, |file| file["family"] = "pldm".into());
    assert!(message(&trained).contains("family 'pldm'"), "{}", message(&trained));
    std::fs::write(&config_file, &original).expect("writing the file");

    edit(&config_file, |file| file["config"]["model"]["pixel_mean"][0] = 0.75.into());
    assert!(message(&trained).contains("config.json") && message(&trained).contains("the hash differs"));
    std::fs::write(&config_file, &original).expect("writing the file");

    let manifest_file = inner.join("manifest.json");
    let manifest = std::fs::read(&manifest_file).expect("reading the file");
    edit(&manifest_file, |file| file["config"]["optim"]["lr"] = 0.5.into());
    assert!(message(&trained).contains("another value of 'optim.lr'"), "{}", message(&trained));
    // A setting that did not exist yet when the checkpoint was written.
    edit(&manifest_file, |file| drop(file["config"]["optim"].as_object_mut().expect("a table").remove("lr")));
    load(&trained).expect("a manifest with fewer settings");
    std::fs::write(&manifest_file, &manifest).expect("writing the file");

    // If a process is killed between the two renames of a save, the folder `.checkpoint.old` remains.
    std::fs::rename(&inner, trained.join(".checkpoint.old")).expect("renaming the folder");
    load(&trained).expect("loading the old checkpoint");
}

#[test]
fn resuming_with_another_configuration_is_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    run(&config(&["schedule.steps=1"]), folder.path(), &crate::options(), 0).expect("training the model");
    let resume = TrainOptions { resume: true, ..crate::options() };
    let error = run(&config(&["schedule.steps=1", "optim.lr=2e-3"]), folder.path(), &resume, 0);
    let message = error.expect_err("another configuration").to_string();
    assert!(message.contains("optim.lr: stored 0.001, requested 0.002"), "{message}");
}
