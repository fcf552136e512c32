//! Checkpoints, configurations and weights that a stranger made: every field of every file gives an error or a model,
//! never a panic or an allocation beyond the size of the weights.

use crate::training;
use burn::tensor::Device;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use swm_core::files::Lock;
use swm_core::{Key, Manifest};
use swm_models::dino_wm::DinoWm;
use swm_models::gcrl::{Gcbc, Gciql, Gcivl};
use swm_models::inverse::{InverseCheckpoint, InverseConfig};
use swm_models::lewm::{self, Lewm};
use swm_models::nn::{Init, Mlp};
use swm_models::pldm::{self, Pldm};
use swm_models::sac::Sac;
use swm_models::tdmpc2::Tdmpc2;
use swm_models::train::{ColumnInfo, DatasetInfo};
use swm_models::{Checkpoint, FAMILIES, TrainConfig, TrainOptions, Trainable, checkpoint, dino_wm, weights};
use swm_plan::ActionScale;

/// Settings without a limit: no size depends on them.
const UNLIMITED: &[&str] = &["seed", "every", "patience", "warmup", "save_every", "evaluate_every"];
/// Settings that only counters use, whose limit is 2^40.
const COUNTERS: &[&str] = &["steps", "log_every", "batches", "capacity", "part"];

const SMALL_ENCODER: &str = "model.encoder.pyramid.stages=[{patch=32,channels=2},{patch=2,channels=2}]";
pub(crate) const SMALL: &[&str] = &[SMALL_ENCODER, "model.encoder.pyramid.hidden=3", "model.encoder.pyramid.dim=4"];
pub(crate) const SMALL_PREDICTOR: &[&str] = &[
    "model.projector=4",
    "model.predictor.dim=4",
    "model.predictor.depth=1",
    "model.predictor.dim_head=3",
    "model.predictor.mlp=5",
];
const SMALL_HEAD: &[&str] = &["model.head.dim_head=3", "model.head.mlp=5", "model.critic=6"];

fn dataset_info() -> DatasetInfo {
    let all = |value: f64| vec![value; 3];
    let state = ColumnInfo { shape: vec![3], mean: all(0.0), std: all(1.0), min: all(-1.0), max: all(1.0) };
    DatasetInfo {
        action: ActionScale::identity(2),
        columns: BTreeMap::from([("state".to_owned(), state)]),
        env: Some("test/Dots-v0".to_owned()),
    }
}

pub(crate) fn model<M: Trainable>(settings: &[&[&str]]) -> Checkpoint<M> {
    let settings: Vec<String> = settings.concat().into_iter().map(str::to_owned).collect();
    let config = TrainConfig::<M>::load("tiny", &settings).expect("a configuration");
    let dataset_info = dataset_info();
    let model = M::new(&config, &dataset_info, &Init::new(Key::new(0), &Device::flex())).expect("a model");
    Checkpoint { model, config, dataset_info, manifest: Manifest::new("train", 0, Value::Null) }
}

/// Appends the JSON pointers of the numbers and arrays below a value; of an array, only the first element.
pub(crate) fn pointers(at: &str, value: &Value, out: &mut Vec<String>) {
    match value {
        Value::Number(_) => out.push(at.to_owned()),
        Value::Object(map) => map.iter().for_each(|(key, value)| pointers(&format!("{at}/{key}"), value, out)),
        Value::Array(values) => {
            out.push(at.to_owned());
            if let Some(first) = values.first() {
                pointers(&format!("{at}/0"), first, out);
            }
        }
        _ => {}
    }
}

/// Whether a value cannot be right where `old` was, in a setting with the given key.
pub(crate) fn must_fail(key: &str, old: &Value, new: &Value) -> bool {
    let huge = new.as_u64().filter(|value| *value > 1);
    match (old, new) {
        (Value::Array(_), _) => true,
        (Value::Number(old), Value::Number(_)) if !old.is_u64() => false,
        (Value::Number(_), Value::Number(new)) if new.is_u64() => {
            huge.is_some_and(|value| !UNLIMITED.contains(&key) && (!COUNTERS.contains(&key) || value > 1 << 40))
        }
        _ => true,
    }
}

/// Replaces every number and array of a JSON file by hostile values, and calls `load`, which returns the error.
fn mutate(file: &Path, load: impl Fn() -> Option<String>) {
    let original: Value = serde_json::from_slice(&std::fs::read(file).expect("a file")).expect("JSON");
    assert_eq!(load(), None, "the original loads");
    let mut found = vec![];
    pointers("", &original, &mut found);
    for pointer in &found {
        let key = pointer.rsplit('/').find(|part| *part != "0").unwrap_or_default();
        for new in &hostile_values() {
            let mut changed = original.clone();
            let at = changed.pointer_mut(pointer).expect("the value");
            let old = std::mem::replace(at, new.clone());
            std::fs::write(file, changed.to_string()).expect("a written file");
            let Ok(error) = catch_unwind(AssertUnwindSafe(&load)) else { panic!("{pointer} = {new} panics") };
            assert!(error.is_some() || !must_fail(key, &old, new), "{pointer} = {new} loads");
        }
    }
    std::fs::write(file, original.to_string()).expect("a written file");
}

/// Values that a stranger puts in the place of numbers and arrays.
pub(crate) fn hostile_values() -> Vec<Value> {
    vec![
        json!(0),
        json!(-1),
        json!(1_u64 << 31),
        json!(1_u64 << 40),
        json!(1_u64 << 60),
        json!(u64::MAX),
        json!(1e308),
        json!("NaN"),
        Value::Null,
        json!(""),
        json!([]),
        json!({}),
    ]
}

/// Loads a checkpoint of any family and makes everything that commands make of one; returns the error.
pub(crate) fn load(folder: &Path) -> Option<String> {
    let loaded = match swm_models::load(folder, &Device::flex()) {
        Ok(loaded) => loaded,
        Err(error) => return Some(error.to_string()),
    };
    let (cost, predictor, encoder) = (loaded.cost(), loaded.predictor(), loaded.encoder());
    assert!(cost.is_some() || loaded.acts() || predictor.is_some() || encoder.is_some());
    loaded.info().err().map(|error| error.to_string())
}

fn check(name: &str, save: impl FnOnce(&Path)) {
    let folder = tempfile::tempdir().expect("a folder");
    save(folder.path());
    // Without its hash, a changed configuration reaches all checks.
    let path = folder.path().join("checkpoint/manifest.json");
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(&path).expect("a manifest")).expect("JSON");
    manifest["hashes"].as_object_mut().expect("the hashes").remove("config").expect("the hash of the configuration");
    std::fs::write(&path, manifest.to_string()).expect("writing the manifest");
    mutate(&folder.path().join("checkpoint/config.json"), || load(folder.path()));
    assert!(load(folder.path()).is_none(), "{name}");
}

fn saved<M: Trainable>(settings: &[&[&str]]) -> impl FnOnce(&Path) {
    let mut checkpoint = model::<M>(settings);
    move |folder| {
        checkpoint.save_to(folder).expect("a checkpoint");
    }
}

#[test]
fn hostile_config_lewm() {
    check("lewm", saved::<Lewm>(&[SMALL, SMALL_PREDICTOR]));
}

#[test]
fn hostile_config_conv() {
    let sizes = ["model.encoder.conv.channels=[2,3]", "model.encoder.conv.hidden=3", "model.encoder.conv.dim=4"];
    check("lewm", |folder| {
        let settings: Vec<String> = [&sizes, SMALL_PREDICTOR].concat().into_iter().map(str::to_owned).collect();
        let config = TrainConfig::<Lewm>::load("small", &settings).expect("a configuration");
        let dataset_info = dataset_info();
        let model = Lewm::new(&config, &dataset_info, &Init::new(Key::new(0), &Device::flex())).expect("a model");
        let manifest = Manifest::new("train", 0, Value::Null);
        Checkpoint { model, config, dataset_info, manifest }.save_to(folder).expect("a checkpoint");
    });
}

#[test]
fn hostile_config_pldm() {
    check("pldm", saved::<Pldm>(&[SMALL, SMALL_PREDICTOR, &["loss.idm_hidden=4", "model.latent=3"]]));
}

#[test]
fn hostile_config_dino_wm() {
    let vit = ["patch=32", "dim=4", "heads=2", "mlp=5"].map(|size| format!("model.encoder.vit.{size}"));
    let vit: Vec<&str> = vit.iter().map(String::as_str).collect();
    let columns = "model.columns=[{name='action',dim=2},{name='state',dim=3}]";
    check("dino_wm", saved::<DinoWm>(&[&vit, &SMALL_PREDICTOR[3..], &[columns, "model.decoder=2"]]));
}

#[test]
fn hostile_config_tdmpc2() {
    let sizes = ["model.encoder=4", "model.hidden=5", "model.bins.count=7", "model.critics=2", "model.image=39"];
    let encoding = "model.encoding=[{column='pixels',latent=8},{column='state',latent=8}]";
    check("tdmpc2", saved::<Tdmpc2>(&[&sizes, &[encoding]]));
}

#[test]
fn hostile_config_gcbc() {
    check("gcbc", saved::<Gcbc>(&[SMALL, SMALL_HEAD]));
}

#[test]
fn hostile_config_gcivl() {
    check("gcivl", saved::<Gcivl>(&[SMALL, SMALL_HEAD]));
}

#[test]
fn hostile_config_gciql() {
    check("gciql", saved::<Gciql>(&[SMALL, SMALL_HEAD]));
}

#[test]
fn hostile_config_sac() {
    check("sac", saved::<Sac>(&[&["model.hidden=4"]]));
}

#[test]
fn hostile_config_inverse() {
    check("inverse", |folder| {
        let world_model = model::<Lewm>(&[SMALL, SMALL_PREDICTOR]);
        let config = InverseConfig::load(&["hidden=4".to_owned()]).expect("a configuration");
        let init = Init::new(Key::new(0), &Device::flex());
        let network = Mlp::new(&init, 2 * world_model.config.model.latent, 4, world_model.action_dim());
        let manifest = Manifest::new("train", 0, Value::Null);
        InverseCheckpoint { world_model, model: network, config, manifest }.save(folder).expect("a checkpoint");
    });
}

#[test]
fn hostile_training_state_is_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = training::config(&["schedule.steps=1"]);
    training::run(&config, folder.path(), &TrainOptions::default(), 0).expect("a trained model");
    let resume = TrainOptions { resume: true, ..TrainOptions::default() };
    let resumed = || training::run(&config, folder.path(), &resume, 0).err().map(|error| error.to_string());
    let state = folder.path().join("checkpoint/state.json");
    for step in [json!(2), json!(1_u64 << 60), json!(-1), json!("NaN"), Value::Null] {
        std::fs::write(&state, json!({ "step": step }).to_string()).expect("a written file");
        assert!(resumed().expect("an error").contains("state.json"), "{step}");
    }
    std::fs::write(&state, json!({ "step": 1 }).to_string()).expect("a written file");
    assert_eq!(resumed(), None);
}

/// A copy of a reference checkpoint, in a new folder.
fn copied(family: &str) -> (tempfile::TempDir, PathBuf) {
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/reference").join(family);
    let folder = tempfile::tempdir().expect("a folder");
    for name in ["weights.pt", "config.json"] {
        std::fs::copy(from.join(name), folder.path().join(name)).expect("a copied file");
    }
    let path = folder.path().to_owned();
    (folder, path)
}

#[test]
fn import_replaces_no_checkpoint_and_keeps_other_writers_away() {
    let (_folder, from) = copied("lewm");
    let run = from.join("run");
    let family = FAMILIES.get("lewm").expect("a family");
    let dots = crate::dots::Dots::new(2, 0);
    let import = || (family.import)(&from, &dots, &run).expect("a family of the reference");
    let held = Lock::folder(&run).expect("locking the folder as another import does");
    let error = import().expect_err("another process writes").to_string();
    assert!(error.contains("another process writes to it"), "{error}");
    drop(held);
    import().expect("an import");
    let error = import().expect_err("a second import").to_string();
    assert!(error.contains("holds a checkpoint already"), "{error}");
    assert_eq!(checkpoint::faults(&run).expect("a checkpoint"), [""; 0]);
}

#[test]
fn hostile_reference_configs_are_refused() {
    type Import = fn(&Path) -> swm_core::Result<()>;
    let imports: [(&str, Import); 3] = [
        ("lewm", |path| lewm::import::import(path, dataset_info()).map(drop)),
        ("pldm", |path| pldm::import::import(path, dataset_info()).map(drop)),
        ("prejepa", |path| {
            let mut info = dataset_info();
            info.columns.insert("proprio".to_owned(), info.columns["state"].clone());
            dino_wm::import::import(path, info).map(drop)
        }),
    ];
    for (family, import) in imports {
        let (_folder, path) = copied(family);
        let file = path.join("config.json");
        let original: Value = serde_json::from_slice(&std::fs::read(&file).expect("a file")).expect("JSON");
        let mut found = vec![];
        pointers("", &original, &mut found);
        assert!(import(&path).is_ok() && found.len() > 5, "{family}");
        for pointer in &found {
            for new in [json!(0), json!(1_u64 << 31), json!(1_u64 << 60), json!(u64::MAX), json!(1e308), json!([])] {
                let mut changed = original.clone();
                *changed.pointer_mut(pointer).expect("the value") = new.clone();
                std::fs::write(&file, changed.to_string()).expect("a written file");
                assert!(catch_unwind(|| drop(import(&path))).is_ok(), "{family}: {pointer} = {new} panics");
            }
        }
    }
}

#[test]
fn weights_without_a_hash_or_with_infinite_values_are_faults() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = folder.path();
    model::<Lewm>(&[SMALL, SMALL_PREDICTOR]).save_to(run).expect("a checkpoint");
    assert_eq!(checkpoint::faults(run).expect("a checkpoint"), [""; 0]);
    let path = run.join("checkpoint/manifest.json");
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(&path).expect("a file")).expect("JSON");
    manifest["hashes"] = json!({});
    std::fs::write(&path, manifest.to_string()).expect("a written file");
    assert_eq!(load(run), None, "the weights themselves are valid");
    let faults = ["config.json", "weights.safetensors"].map(|file| format!("manifest.json holds no hash of {file}"));
    assert_eq!(checkpoint::faults(run).expect("a checkpoint"), faults);
    let path = run.join("checkpoint/weights.safetensors");
    let mut bytes = std::fs::read(&path).expect("a file");
    for value in [f32::NAN, f32::INFINITY] {
        let end = bytes.len() - 4;
        bytes[end..].copy_from_slice(&value.to_le_bytes());
        std::fs::write(&path, &bytes).expect("a written file");
        let error = load(run).expect("an error");
        assert!(error.contains("not finite"), "{error}");
    }
}

#[test]
fn only_regular_files_are_weights() {
    let folder = tempfile::tempdir().expect("a folder");
    let made = std::process::Command::new("mkfifo").arg(folder.path().join("pipe.pt")).status().expect("mkfifo");
    assert!(made.success());
    for (target, name) in [("/dev/zero", "zero.safetensors"), ("/dev/zero", "zero.pt")] {
        std::os::unix::fs::symlink(target, folder.path().join(name)).expect("a link");
    }
    for name in ["pipe.pt", "zero.safetensors", "zero.pt"] {
        let error = weights::read(&folder.path().join(name)).expect_err("no regular file").to_string();
        assert!(error.contains("not a regular file"), "{error}");
    }
}

/// A PyTorch file with one element that a tensor repeats `count` times, by a stride of 0.
fn repeated(path: &Path, count: u64, element: f32) {
    let text = |text: &str| [b"X".as_slice(), &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    let long = |value: u64| [[0x8a, 8].as_slice(), &value.to_le_bytes()].concat();
    let pickle = [
        b"\x80\x02}".to_vec(),
        text("w"),
        b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(),
        text("storage"),
        b"ctorch\nFloatStorage\n".to_vec(),
        [text("0"), text("cpu"), long(1), b"tQ".to_vec(), long(0)].concat(),
        [b"(".to_vec(), long(count), b"t(".to_vec(), long(0), b"t".to_vec()].concat(),
        b"\x89ccollections\nOrderedDict\n)RtRs.".to_vec(),
    ]
    .concat();
    archive(path, &pickle, &element.to_le_bytes());
}

/// A PyTorch file with a pickle and the elements of one tensor.
fn archive(path: &Path, pickle: &[u8], elements: &[u8]) {
    let mut zip = zip::ZipWriter::new(std::fs::File::create(path).expect("a file"));
    let options = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, bytes) in [("data.pkl", pickle), ("byteorder", b"little"), ("data/0", elements), ("version", b"3")] {
        zip.start_file(format!("weights/{name}"), options).expect("an entry");
        std::io::Write::write_all(&mut zip, bytes).expect("bytes");
    }
    zip.finish().expect("a file");
}

#[test]
fn a_pytorch_tensor_cannot_repeat_its_elements_without_limit() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("repeated.pt");
    repeated(&path, 1000, 0.0);
    assert_eq!(weights::read(&path).expect("weights")["w"].values.len(), 1000);
    for count in [1 << 31, 1 << 40, 1 << 60] {
        repeated(&path, count, 0.0);
        let error = weights::read(&path).expect_err("too large").to_string();
        assert!(["larger than the file", "limit", "overflow"].iter().any(|word| error.contains(word)), "{error}");
    }
}

#[test]
fn infinite_and_missing_actions_are_refused_before_training() {
    for action in [[f32::INFINITY, 0.0], [0.0, f32::NEG_INFINITY], [0.0, f32::NAN]] {
        let dots = crate::dots::Dots::new(2, 0).with_action(1, action);
        for bounded in [false, true] {
            let error = DatasetInfo::from_reader(&dots, &[], bounded).expect_err("actions that no model learns");
            assert!(error.to_string().contains("column 'action' of the training data"), "{action:?}: {error}");
        }
    }
}

#[test]
fn actions_of_last_rows_do_not_hide_missing_ones() {
    let last = |dots: crate::dots::Dots| dots.with_action_at([0, 23], [0.5; 2]).with_action_at([1, 23], [0.5; 2]);
    let info = |dots: &crate::dots::Dots| DatasetInfo::from_reader(dots, &[], false);
    info(&last(crate::dots::Dots::new(2, 0))).expect("actions in all rows");
    info(&crate::dots::Dots::new(2, 0).with_action_at([0, 23], [0.5; 2])).expect("one action in a last row");
    for action in [[f32::NAN; 2], [0.0, f32::NAN]] {
        let dots = last(crate::dots::Dots::new(2, 0)).with_action_at([1, 7], action).with_action_at([1, 8], action);
        let error = info(&dots).expect_err("missing actions").to_string();
        assert!(error.contains("column 'action'") && error.contains("NaN in 2 rows"), "{error}");
        assert!(error.contains("in which it was taken"), "{error}");
    }
}

#[test]
fn columns_that_vary_too_little_for_a_model_are_refused() {
    let columns = ["position".to_owned()];
    let info = |dots: &crate::dots::Dots, bounded| DatasetInfo::for_training(dots, &columns, bounded);
    for (column, name) in [(1, "action"), (2, "position")] {
        let dots = crate::dots::Dots::new(2, 0).scaled(column, 1e-8);
        let error = info(&dots, false).expect_err(name).to_string();
        assert!(error.contains(&format!("column '{name}' of the training data")) && error.contains("scale"), "{error}");
    }
    // Rounding errors of zero and of one are noise, and so is an element beside one that varies more.
    info(&crate::dots::Dots::new(2, 0).scaled(2, 1e-16), false).expect("zeros");
    info(&crate::dots::Dots::new(2, 0).scaled(2, 1e-7).shifted(2, [1.0, 1.0]), false).expect("ones");
    info(&crate::dots::Dots::new(2, 0).scaled_by(1, [1.0, 1e-8]), false).expect("one element that varies");
    // A range of actions is mapped to -1 ..= 1, and a constant is one in any unit.
    info(&crate::dots::Dots::new(2, 0).scaled(1, 1e-8), true).expect("a small range of actions");
    info(&crate::dots::Dots::new(2, 0).scaled(2, 0.0), false).expect("a constant column");
}

/// A PyTorch file with one negative tensor of the values [1.0, 2.0], in the pickle that `torch.save` writes.
fn negative(path: &Path) {
    let text = |text: &str| [b"X".as_slice(), &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    let pickle = [
        b"\x80\x02}q\x00".to_vec(),
        [text("w"), b"q\x01ctorch._utils\n_rebuild_tensor_v2\nq\x02((".to_vec()].concat(),
        [text("storage"), b"q\x03ctorch\nFloatStorage\nq\x04".to_vec()].concat(),
        [text("0"), b"q\x05".to_vec(), text("cpu"), b"q\x06K\x02tq\x07QK\x00K\x02\x85q\x08K\x01\x85q\x09".to_vec()]
            .concat(),
        b"\x89ccollections\nOrderedDict\nq\x0a)Rq\x0b}q\x0c".to_vec(),
        [text("neg"), b"q\x0d\x88stq\x0eRq\x0fs.".to_vec()].concat(),
    ]
    .concat();
    let values = [1.0_f32.to_le_bytes(), 2.0_f32.to_le_bytes()].concat();
    archive(path, &pickle, &values);
}

#[test]
fn tensors_with_the_negative_bit_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("negative.pt");
    negative(&path);
    let error = weights::read(&path).expect_err("the values have the opposite sign").to_string();
    assert!(error.contains("negative bit") && error.contains("resolve_neg"), "{error}");
}

#[test]
fn nested_weights_with_the_name_of_another_weight_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("doubled.ckpt");
    let text = |text: &str| [b"X".as_slice(), &(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    // A tensor of the first two values, as in `negative`.
    let tensor = [
        b"ctorch._utils\n_rebuild_tensor_v2\n((".to_vec(),
        [text("storage"), b"ctorch\nFloatStorage\n".to_vec(), text("0"), text("cpu")].concat(),
        b"K\x02tQK\x00K\x02\x85K\x01\x85\x89ccollections\nOrderedDict\n)RtR".to_vec(),
    ]
    .concat();
    let values = [1.0_f32.to_le_bytes(), 2.0_f32.to_le_bytes()].concat();
    let write = |other: &str| {
        let nested = [text("state_dict"), b"}(".to_vec(), text("w"), tensor.clone(), b"u".to_vec()].concat();
        let entries = [nested, text(other), tensor.clone()].concat();
        archive(&path, &[&b"\x80\x02}("[..], &entries, b"u."].concat(), &values);
        weights::read(&path)
    };
    assert_eq!(write("state").expect("different names").len(), 1);
    // Each number in a list below a long key would have a long name.
    let wide = [text(&"k".repeat(1 << 20)), b"](".to_vec(), b"K\x01".repeat(1 << 20), b"e".to_vec()].concat();
    archive(&path, &[&b"\x80\x02}("[..], &text("w"), &tensor, &wide, b"u."].concat(), &values);
    assert_eq!(weights::read(&path).expect("one tensor").len(), 1);
    let error = write("state_dict.w").expect_err("one of two weights").to_string();
    assert!(error.contains("two entries of the name 'state_dict.w'"), "{error}");
}

#[test]
fn weights_that_are_not_finite_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("diverged.pt");
    for value in [f32::NAN, f32::NEG_INFINITY] {
        repeated(&path, 3, value);
        let error = weights::read(&path).expect_err("no weights of a model").to_string();
        assert!(error.contains("'w' has values that are not finite"), "{error}");
    }
}
