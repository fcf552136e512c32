//! Capsules: round trips, and files that a stranger made or damaged.

use crate::hostile::{SMALL, SMALL_PREDICTOR, hostile_values, load, model, must_fail, pointers};
use burn::tensor::Device;
use serde_json::{Value, json};
use std::fs;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use swm_core::{Batch, ColumnSpec, DType, EnvSpec, Error, Key, Result, Schema};
use swm_models::capsule::{self, Capsule, Description, Evaluation, MAX_BYTES, Reference, reference};
use swm_models::dino_wm::DinoWm;
use swm_models::lewm::Lewm;
use swm_models::nn::Init;
use swm_models::nn::parameters::HostTensor;
use swm_models::{Checkpoint, FAMILIES, StoredCheckpoint, Trainable, load_stored};

const SIDE: usize = 64;

/// A model that acts would need an environment; these tests have none.
fn no_env() -> Result<EnvSpec> {
    Err(Error::config("environment", "there is none", "test a model that predicts"))
}

/// A batch of frames and of actions of a model step, `[rows, horizon, dim]`.
fn inputs(dim: usize) -> Batch {
    let (rows, horizon) = (3, 2);
    let schema = Schema::new([
        ColumnSpec::image("pixels", SIDE, SIDE),
        ColumnSpec::image("goal", SIDE, SIDE),
        ColumnSpec::new("state", DType::Float32, [3]),
        ColumnSpec::new("actions", DType::Float32, [horizon, dim]),
    ]);
    let mut batch = Batch::zeros(&schema.expect("a schema"), rows);
    for (i, value) in batch.get_mut::<u8>("pixels").expect("pixels").iter_mut().enumerate() {
        *value = (i * i % 251) as u8;
    }
    for (i, value) in batch.get_mut::<f32>("actions").expect("actions").iter_mut().enumerate() {
        *value = (i as f32 * 0.7).sin();
    }
    batch
}

/// Packs an untrained model and returns the capsule.
fn packed<M: Trainable>(mut checkpoint: Checkpoint<M>) -> Capsule {
    let folder = tempfile::tempdir().expect("a folder");
    checkpoint.save_to(folder.path()).expect("a checkpoint");
    let stored = StoredCheckpoint::read(folder.path()).expect("a stored checkpoint");
    let inputs = inputs(checkpoint.action_dim());
    let rounded = capsule::round(&stored).expect("rounded weights");
    let loaded = load_stored(FAMILIES.rows, &rounded.stored, &Device::flex()).expect("a model");
    let outputs = reference::outputs(&*loaded, &inputs, no_env).expect("outputs");
    rounded.capsule(Description::default(), Reference { inputs, outputs }, None)
}

fn lewm() -> Capsule {
    packed(model::<Lewm>(&[SMALL, SMALL_PREDICTOR]))
}

/// Writes a capsule into a folder and returns its path.
fn written(capsule: &Capsule, folder: &Path) -> PathBuf {
    let path = folder.join("model.safetensors");
    capsule.write(&path).expect("a written capsule");
    path
}

fn error(path: &Path) -> String {
    Capsule::read(path).expect_err("a refused capsule").to_string()
}

#[test]
fn capsule_holds_the_model_and_its_outputs() {
    let folder = tempfile::tempdir().expect("a folder");
    let capsule = lewm();
    let path = written(&capsule, folder.path());
    let bytes = fs::read(&path).expect("a file");
    let again = Capsule::read(&path).expect("a capsule");
    assert_eq!(again.weights, capsule.weights);
    assert_eq!(again.hash().expect("a hash"), capsule.hash().expect("a hash"));
    again.write(&path).expect("a written capsule");
    assert_eq!(fs::read(&path).expect("a file"), bytes, "equal capsules have equal bytes");

    let loaded = swm_models::load(&path, &Device::flex()).expect("a model");
    let outputs = reference::outputs(&*loaded, &again.reference.inputs, no_env).expect("outputs");
    assert_eq!(reference::difference(&again.reference.outputs, &outputs).expect("a difference"), 0.0);
    assert_eq!(outputs.keys().collect::<Vec<_>>(), ["latents", "predicted"]);

    // The exported checkpoint has the weights of the capsule, and their hash.
    let run = folder.path().join("run");
    let hash = capsule::export(&again, &run).expect("an exported checkpoint");
    assert_eq!(hash, capsule.weights_hash());
    let exported = StoredCheckpoint::read(&run).expect("a checkpoint");
    assert_eq!(exported.weights().expect("weights"), capsule.weights);
    assert!(capsule::export(&again, &run).expect_err("an existing checkpoint").to_string().contains("already"));
}

#[test]
fn only_the_capsule_of_the_same_model_is_replaced() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("model.safetensors");
    let mut other = model::<Lewm>(&[SMALL, SMALL_PREDICTOR]);
    (other.manifest.seed, other.config.seed) = (1, 1);
    let init = Init::new(Key::new(1), &Device::flex());
    other.model = Lewm::new(&other.config, &other.dataset_info, &init).expect("a model");
    // As two commands that both found no file: neither looks at it before it writes.
    lewm().write_own(&path).expect("a new capsule");
    let bytes = fs::read(&path).expect("a file");
    let error = packed(other).write_own(&path).expect_err("another model").to_string();
    assert!(error.contains("holds another model"), "{error}");
    lewm().write_own(&path).expect("the same model");
    assert_eq!(fs::read(&path).expect("a file"), bytes);
    assert_eq!(fs::read_dir(folder.path()).expect("a folder").count(), 1, "no temporary file is left");
}

#[test]
fn matrices_are_rounded_to_half_precision_and_vectors_are_not() {
    let mut checkpoint = model::<Lewm>(&[SMALL, SMALL_PREDICTOR]);
    let folder = tempfile::tempdir().expect("a folder");
    checkpoint.save_to(folder.path()).expect("a checkpoint");
    let stored = StoredCheckpoint::read(folder.path()).expect("a stored checkpoint");
    let (single, capsule) = (stored.weights().expect("weights"), packed(checkpoint));
    let mut rounded = 0;
    for (name, tensor) in &capsule.weights {
        let HostTensor { shape, values } = &single[name];
        let differs = tensor.values != *values;
        rounded += usize::from(differs);
        assert!(shape.len() > 1 || !differs, "{name}");
        let largest = values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        let close = tensor.values.iter().zip(values).all(|(a, b)| (a - b).abs() <= largest / 1024.0);
        assert!(close, "{name}");
    }
    assert!(rounded > 3, "{rounded} tensors are rounded");
    assert_ne!(capsule.manifest.hashes["packed"], capsule.weights_hash());
}

#[test]
fn model_that_only_scores_plans_has_costs() {
    let vit = ["patch=32", "dim=4", "heads=2", "mlp=5"].map(|size| format!("model.encoder.vit.{size}"));
    let vit: Vec<&str> = vit.iter().map(String::as_str).collect();
    let columns = "model.columns=[{name='action',dim=2},{name='state',dim=3}]";
    let capsule = packed(model::<DinoWm>(&[&vit, &SMALL_PREDICTOR[3..], &[columns, "model.decoder=2"]]));
    assert_eq!(capsule.reference.outputs["costs"].shape, [3]);
}

#[test]
fn hostile_capsule_configurations_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let original = lewm();
    let path = written(&original, folder.path());
    assert_eq!(load(&path), None, "the original loads");
    let mut found = vec![];
    pointers("", &original.checkpoint, &mut found);
    for pointer in &found {
        let key = pointer.rsplit('/').find(|part| *part != "0").unwrap_or_default();
        for new in &hostile_values() {
            let mut changed = original.clone();
            let at = changed.checkpoint.pointer_mut(pointer).expect("the value");
            let old = std::mem::replace(at, new.clone());
            written(&changed, folder.path());
            let Ok(error) = catch_unwind(AssertUnwindSafe(|| load(&path))) else { panic!("{pointer} = {new} panics") };
            assert!(error.is_some() || !must_fail(key, &old, new), "{pointer} = {new} loads");
        }
    }
}

/// Every changed byte is found, in the header, in the document and in the tensors.
#[test]
fn damaged_capsules_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = written(&lewm(), folder.path());
    let bytes = fs::read(&path).expect("a file");
    let places = (0..600).chain((600..bytes.len()).step_by(bytes.len() / 400));
    for place in places {
        let mut changed = bytes.clone();
        changed[place] ^= 1 << (place % 8);
        fs::write(&path, &changed).expect("a written file");
        let Ok(read) = catch_unwind(|| Capsule::read(&path).map(drop)) else { panic!("byte {place} panics") };
        assert!(read.is_err(), "byte {place} is changed, and the capsule is read");
    }
    let mut changed = bytes.clone();
    changed[bytes.len() - 1] ^= 1;
    fs::write(&path, changed).expect("a written file");
    assert!(Capsule::is_capsule_file(&path), "a damaged capsule counts as a file of weights");
    for length in [0, 7, 8, 100, bytes.len() / 2, bytes.len() - 1] {
        fs::write(&path, &bytes[..length]).expect("a written file");
        assert!(Capsule::read(&path).is_err(), "{length} bytes");
    }
    fs::write(&path, vec![0; MAX_BYTES as usize + 1]).expect("a written file");
    assert!(error(&path).contains("longer than 6000000 bytes"));
}

#[test]
fn capsule_of_another_version_says_how_to_convert_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = written(&lewm(), folder.path());
    let bytes = fs::read(&path).expect("a file");
    let at = bytes.windows(12).position(|part| part == b"version\\\":1}");
    let at = at.expect("the version");
    let one = at + bytes[at..].iter().position(|&byte| byte == b'1').expect("the number");
    let mut changed = bytes;
    changed[one] = b'2';
    fs::write(&path, changed).expect("a written file");
    let error = error(&path);
    for part in ["capsule of version 2", "reads version 1", "checkpoints export", "checkpoints pack"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn other_files_are_no_capsules() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path().join("run");
    model::<Lewm>(&[SMALL, SMALL_PREDICTOR]).save_to(&run).expect("a checkpoint");
    let weights = error(&run.join("checkpoint/weights.safetensors"));
    assert!(!Capsule::is_capsule_file(&run.join("checkpoint/weights.safetensors")));
    assert!(weights.contains("is no capsule") && weights.contains("checkpoints pack"), "{weights}");
    assert!(error(&run.join("checkpoint/config.json")).contains("is no capsule"));
    assert!(error(Path::new("/dev/zero")).contains("not a regular file"));
}

#[test]
fn contradicting_tensors_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let refused = |change: &dyn Fn(&mut Capsule), part: &str| {
        let mut capsule = lewm();
        change(&mut capsule);
        let path = written(&capsule, folder.path());
        let error = load(&path).expect("a refused capsule");
        assert!(error.contains(part), "{error}");
    };
    let tensor = || HostTensor { shape: vec![1], values: vec![0.0] };
    refused(&|capsule| drop(capsule.weights.insert("other/weight".to_owned(), tensor())), "unknown");
    refused(&|capsule| drop(capsule.weights.insert("extra".to_owned(), tensor())), "hash of its weights");
    refused(&|capsule| capsule.weights.values_mut().for_each(|weight| weight.values[0] = f32::NAN), "not finite");
    refused(&|capsule| drop(capsule.manifest.hashes.remove("weights")), "hash of its weights");
    refused(&|capsule| capsule.checkpoint["family"] = json!("dreamer"), "dreamer");
    refused(
        &|capsule| capsule.checkpoint["env"] = json!("swm/PushT-v1"),
        "the environment swm/PushT-v1, and was trained on",
    );
    refused(&|capsule| capsule.checkpoint = Value::Null, "unknown");
    refused(&|capsule| capsule.manifest.config = json!({ "seed": 7 }), "configuration in its manifest");
    let rows = |rows: usize| Batch::zeros(&Schema::new([ColumnSpec::new("x", DType::U8, [])]).expect("a schema"), rows);
    let evaluation = |starts: Batch| Some(Evaluation { record: json!({}), starts, rows: None });
    refused(&|capsule| capsule.evaluation = evaluation(rows(65)), "1 to 64 equal rows");
    refused(&|capsule| capsule.evaluation = evaluation(rows(0)), "1 to 64 equal rows");

    let mut other = lewm();
    other.reference.outputs.insert("latents".to_owned(), tensor());
    let error = reference::difference(&other.reference.outputs, &lewm().reference.outputs).expect_err("other shapes");
    assert!(error.to_string().contains("latents [1]"), "{error}");
}

/// Reading takes quadratic time in the columns of a batch, so their number is bounded.
#[test]
fn capsules_of_too_many_tensors_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("model.safetensors");
    let mut header = serde_json::Map::new();
    header.insert("__metadata__".to_owned(), json!({"swm_capsule": "{}"}));
    for index in 0..5000 {
        let tensor = json!({"dtype": "U8", "shape": [1], "data_offsets": [index, index + 1]});
        header.insert(format!("reference/input/{index}"), tensor);
    }
    let header = Value::Object(header).to_string();
    let length = (header.len() as u64).to_le_bytes();
    fs::write(&path, [&length[..], header.as_bytes(), &[0; 5000]].concat()).expect("a written file");
    assert!(error(&path).contains("it has 5000 tensors, more than 4096"), "{}", error(&path));

    let mut capsule = lewm();
    let tensor = HostTensor { shape: vec![1], values: vec![0.0] };
    capsule.reference.outputs.extend((0..5000).map(|index| (format!("{index}"), tensor.clone())));
    let refused = capsule.write(&path).expect_err("too many tensors").to_string();
    assert!(refused.contains("more than 4096"), "{refused}");
}
