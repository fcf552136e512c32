//! PLDM: training does not depend on threads and reduces the loss; invalid settings are refused.

use crate::dots::Dots;
use std::path::Path;
use std::sync::Arc;
use swm_core::Result;
use swm_core::run::Control;
use swm_models::pldm::Pldm;
use swm_models::{Checkpoint, TrainConfig, TrainOptions, TrainSummary, train};

/// A model of a few thousand parameters.
pub fn config(overrides: &[&str]) -> Result<TrainConfig<Pldm>> {
    let small = [
        "model.image=16",
        "model.latent=4",
        "model.projector=16",
        "model.encoder.pyramid.stages=[{ patch = 4, channels = 8 }, { patch = 2, channels = 8 }]",
        "model.encoder.pyramid.hidden=16",
        "model.encoder.pyramid.dim=16",
        "model.predictor.dim=16",
        "model.predictor.history=2",
        "model.predictor.mlp=32",
        "model.predictor.dim_head=8",
        "model.predictor.dropout=0.1",
        "data.frameskip=2",
        "data.num_steps=4",
        "data.batch_size=16",
        "loss.temp_align=0.2",
        "loss.temp_straight=0.1",
        "loss.idm_hidden=16",
        "schedule.steps=10",
        "schedule.warmup=2",
        "log_every=5",
    ];
    let overrides = crate::overridden(&small, overrides);
    TrainConfig::load("tiny", &overrides)
}

fn run(config: &TrainConfig<Pldm>, out: &Path, threads: usize) -> TrainSummary {
    let options = TrainOptions { threads, ..crate::options() };
    train(config, Arc::new(Dots::new(6, 0)), out, &options, &mut Control::new()).expect("training the model")
}

#[test]
fn results_do_not_depend_on_threads() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let config = config(&[]).expect("loading the configuration");
    let (one, two) = (run(&config, &folder.path().join("1"), 1), run(&config, &folder.path().join("2"), 2));
    assert_eq!(one.weights, two.weights);
    let loaded = Checkpoint::<Pldm>::load(&folder.path().join("1"), &crate::device()).expect("loading the checkpoint");
    assert_eq!((loaded.hash(), loaded.config.loss.idm_hidden), (one.weights.as_str(), 16));
}

#[test]
fn every_loss_term_is_logged_and_the_loss_decreases() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let overrides = ["schedule.steps=300", "log_every=20", "model.predictor.dropout=0", "optim.lr=3e-3", "loss.idm=10"];
    run(&config(&overrides).expect("loading the configuration"), folder.path(), 2);
    let lines = std::fs::read_to_string(folder.path().join("train.jsonl")).expect("reading train.jsonl");
    let line = |line: Option<&str>| {
        serde_json::from_str::<serde_json::Value>(line.expect("the log has a line")).expect("parsing the JSON")
    };
    let (first, last) = (line(lines.lines().next()), line(lines.lines().last()));
    let value =
        |line: &serde_json::Value, name: &str| line[name].as_f64().unwrap_or_else(|| panic!("{name} in {line}"));
    for name in ["prediction", "std", "std_t", "cov", "cov_t", "temp_align", "idm", "temp_straight"] {
        assert!(value(&last, name).is_finite(), "{name}");
    }
    for name in ["loss", "idm"] {
        assert!(value(&last, name) < 0.7 * value(&first, name), "{name}: {first}\n{last}");
    }
    // Collapsed latents have a standard deviation of 0, for which the term `std` is 1.
    assert!(value(&last, "std") < 0.5, "{last}");
}

#[test]
fn invalid_settings_are_refused() {
    let message = |overrides: &[&str]| config(overrides).expect_err("an invalid setting").to_string();
    assert!(message(&["model.latent=1"]).contains("model.latent"), "{}", message(&["model.latent=1"]));
    let short = message(&["data.num_steps=2", "model.predictor.history=1"]);
    assert!(short.contains("loss.temp_straight") && short.contains("data.num_steps of at least 3"), "{short}");
    assert!(message(&["data.num_steps=2"]).contains("model.predictor.history"));
    assert!(message(&["loss.cov=-1"]).contains("loss.cov: -1; give a number of at least 0"));
    assert!(message(&["model.pixel_mean=[1e30,0,0]"]).contains("model.pixel_mean"));
    assert!(message(&["loss.stdd=1"]).contains("did you mean loss.std"));
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let large = config(&["model.image=32"]).expect("loading the configuration");
    let reader = Arc::new(Dots::new(2, 0));
    let trained = train(&large, reader, folder.path(), &crate::options(), &mut Control::new());
    let message = trained.expect_err("images of 16 pixels").to_string();
    assert!(message.contains("[32, 32, 3]") && message.contains("model.image"), "{message}");
}
