//! Checkpoints of the reference implementation load, give the recorded outputs, and can be exported.

use crate::golden::{Golden, check, values};
use burn::tensor::Tensor;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_models::dino_wm::{self, DinoWm};
use swm_models::lewm::{self, Lewm};
use swm_models::nn::DropoutRng;
use swm_models::nn::parameters;
use swm_models::pldm;
use swm_models::train::{ColumnInfo, DatasetInfo};
use swm_models::weights::{self, Naming};
use swm_plan::ActionScale;

fn folder(family: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/reference").join(family)
}

fn dataset_info(action_dim: usize) -> DatasetInfo {
    let all = |value: f64| vec![value; 3];
    let proprio = ColumnInfo { shape: vec![3], mean: all(0.0), std: all(1.0), min: all(-1.0), max: all(1.0) };
    DatasetInfo {
        action: ActionScale::identity(action_dim),
        columns: BTreeMap::from([("proprio".to_owned(), proprio)]),
        env: None,
    }
}

/// The recorded inputs and outputs of a checkpoint.
fn recorded(family: &str) -> Golden {
    Golden::read(&folder("..").join(format!("reference-{family}.safetensors")))
}

fn check_world_model(golden: &Golden, model: &Lewm) {
    let [clips, steps, _] = golden.tensor::<3>("i.action").dims();
    let latents = model.encode(golden.patches("i.pixels"));
    let [_, latent] = latents.dims();
    let latents = latents.reshape([clips, steps, latent]);
    check(golden, "o.emb", &values(latents.clone()));
    check(golden, "o.pred", &values(model.predict(latents, model.embed_actions(golden.tensor("i.action")))));
}

#[test]
fn lewm_checkpoint_of_the_reference_gives_its_outputs() {
    let checkpoint = lewm::import::import(&folder("lewm"), dataset_info(2)).expect("importing the checkpoint");
    assert_eq!((checkpoint.config.data.frameskip, checkpoint.config.model.image), (2, 8));
    check_world_model(&recorded("lewm"), &checkpoint.model);
}

#[test]
fn pldm_checkpoint_of_the_reference_gives_its_outputs() {
    // `import` accepts the path of the weights file as well as the folder.
    let checkpoint =
        pldm::import::import(&folder("pldm").join("weights.pt"), dataset_info(4)).expect("importing the checkpoint");
    assert_eq!((checkpoint.config.data.frameskip, checkpoint.config.model.predictor.history), (1, 3));
    check_world_model(&recorded("pldm"), &checkpoint.model.model);
}

fn dino_wm_checkpoint() -> swm_models::Checkpoint<DinoWm> {
    dino_wm::import::import(&folder("prejepa"), dataset_info(2)).expect("importing the checkpoint")
}

#[test]
fn dino_wm_checkpoint_of_the_reference_gives_its_outputs() {
    let (golden, checkpoint) = (recorded("prejepa"), dino_wm_checkpoint());
    let names: Vec<&str> = checkpoint.config.model.columns.iter().map(|column| column.name.as_str()).collect();
    assert_eq!((names, checkpoint.config.data.frameskip), (vec!["proprio", "action"], 2));
    let model = &checkpoint.model;
    let columns: Vec<Tensor<3>> = vec![golden.tensor("i.proprio"), golden.tensor("i.action")];
    let features = model.backbone.patches(golden.patches("i.pixels"));
    let ([clips, steps, _], [_, patches, width]) = (columns[0].dims(), features.dims());
    let frames = model.embed(features.reshape([clips, steps, patches, width]), &columns);
    check(&golden, "o.emb", &values(frames.clone()));
    check(&golden, "o.pred", &values(model.predict(frames, &mut DropoutRng::disabled())));
}

#[test]
fn exported_checkpoints_round_trip() {
    let out = tempfile::tempdir().expect("creating a temporary folder");
    for naming in [Naming::Published, Naming::Transformers5] {
        let exported_folder = out.path().join(format!("lewm-{naming:?}"));
        let lewm = lewm::import::import(&folder("lewm"), dataset_info(2)).expect("importing the checkpoint");
        lewm::import::export(&lewm, &exported_folder, naming).expect("exporting the checkpoint");
        let second = lewm::import::export(&lewm, &exported_folder, naming).expect_err("existing files").to_string();
        assert!(second.contains("config.json") && second.contains("is not replaced"), "{second}");
        let again = lewm::import::import(&exported_folder, dataset_info(2)).expect("importing the checkpoint");
        assert_eq!(again.config.model, lewm.config.model);
        assert_eq!(parameters::values(&again.model), parameters::values(&lewm.model));

        let exported_folder = out.path().join(format!("pldm-{naming:?}"));
        let pldm = pldm::import::import(&folder("pldm"), dataset_info(2)).expect("importing the checkpoint");
        pldm::import::export(&pldm, &exported_folder, naming).expect("exporting the checkpoint");
        let again = pldm::import::import(&exported_folder, dataset_info(2)).expect("importing the checkpoint");
        assert_eq!(parameters::values(&again.model), parameters::values(&pldm.model));
    }
    // Weights with published names are exported unchanged, except for counters.
    let mut reference = weights::read(&folder("pldm").join("weights.pt")).expect("reading the reference weights");
    let mut exported =
        weights::read(&out.path().join("pldm-Published/weights.pt")).expect("reading the exported weights");
    for state in [&mut reference, &mut exported] {
        state.retain(|name, _| !name.ends_with("num_batches_tracked"));
    }
    assert_eq!(exported, reference);

    // A config.json of the reference names a published encoder. The encoder of this checkpoint is smaller than all
    // published encoders, so only the state dict can be compared.
    let checkpoint = dino_wm_checkpoint();
    let refused = dino_wm::import::export(&checkpoint, &out.path().join("dino"), Naming::Published);
    assert!(refused.expect_err("an encoder that is not published").to_string().contains("DINOv2-small"));
    let exported = dino_wm::import::state(&checkpoint.model, Naming::Transformers5);
    let reference = weights::read(&folder("prejepa").join("weights.pt")).expect("reading the reference weights");
    let reference: parameters::Named<_> = reference
        .into_iter()
        .map(|(name, tensor)| (name.replacen("backbone.backbone.", "backbone.", 1), tensor))
        .collect();
    assert_eq!(exported, reference);
}

#[test]
fn unsuitable_checkpoints_are_refused() {
    let message = |found: swm_core::Result<swm_models::Checkpoint<Lewm>>| {
        found.expect_err("an unsuitable checkpoint").to_string()
    };
    let other = message(lewm::import::import(&folder("pldm"), dataset_info(2)));
    assert!(other.contains("PLDM") && other.contains("class LeWM"), "{other}");
    let actions = message(lewm::import::import(&folder("lewm"), dataset_info(3)));
    assert!(actions.contains("3 action elements") && actions.contains("divisor of 4"), "{actions}");
    let missing = message(lewm::import::import(Path::new("nowhere"), dataset_info(2)));
    assert!(missing.contains("nowhere"), "{missing}");
    // The config.json has fewer layers than the weights.
    let out = tempfile::tempdir().expect("creating a temporary folder");
    let text = std::fs::read_to_string(folder("lewm").join("config.json")).expect("reading the configuration file");
    std::fs::write(out.path().join("config.json"), text.replace("\"depth\": 2", "\"depth\": 1"))
        .expect("writing the file");
    std::fs::copy(folder("lewm").join("weights.pt"), out.path().join("weights.pt")).expect("copying the file");
    let mismatch = message(lewm::import::import(out.path(), dataset_info(2)));
    assert!(mismatch.contains("layers.1") && mismatch.contains("config.json"), "{mismatch}");
}

/// Runs the Python interpreter that `SWM_TORCH_PYTHON` names. It must have the packages stable-worldmodel,
/// stable-pretraining and transformers 5.
#[test]
#[ignore = "needs SWM_TORCH_PYTHON"]
fn exported_checkpoints_load_in_the_reference() {
    let python = std::env::var_os("SWM_TORCH_PYTHON").expect("SWM_TORCH_PYTHON names an interpreter");
    let out = tempfile::tempdir().expect("creating a temporary folder");
    let load = |family: &str| {
        let golden = folder("..");
        let status = std::process::Command::new(&python)
            .arg(golden.join("load_reference.py"))
            .arg(out.path().join(family))
            .arg(golden.join(format!("reference-{family}.safetensors")))
            .status();
        assert!(status.expect("running Python").success(), "{family}");
    };
    let lewm = lewm::import::import(&folder("lewm"), dataset_info(2)).expect("importing the checkpoint");
    lewm::import::export(&lewm, &out.path().join("lewm"), Naming::Transformers5).expect("exporting the checkpoint");
    load("lewm");
    let pldm = pldm::import::import(&folder("pldm"), dataset_info(2)).expect("importing the checkpoint");
    pldm::import::export(&pldm, &out.path().join("pldm"), Naming::Transformers5).expect("exporting the checkpoint");
    load("pldm");
}
