//! Capsules.

#![no_main]

use std::collections::BTreeMap;
use std::path::Path;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_models::capsule::{self, Capsule, Description, Evaluation, Reference};
use swm_models::train::DatasetInfo;
use swm_models::{StoredCheckpoint, lewm};

/// Makes a seed of a capsule with every part.
fn seed() {
    let action = serde_json::json!({"mean": [0.0, 0.0], "std": [1.0, 1.0]});
    let info = serde_json::json!({"action": action, "columns": {}, "env": "swm/TwoRoom-v1"});
    let info: DatasetInfo = serde_json::from_value(info).expect("dataset info");
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates/swm-models/tests/golden/reference/lewm");
    let run = swm_fuzz::scratch().join("lewm");
    lewm::import::import(&golden, info).expect("a world model").save_to(&run).expect("a saved checkpoint");
    let stored = StoredCheckpoint::read(&run).expect("a checkpoint");
    let batch =
        |dtype: DType| Batch::zeros(&Schema::new([ColumnSpec::new("column", dtype, [2])]).expect("a schema"), 2);
    let reference = Reference { inputs: batch(DType::U8), outputs: BTreeMap::new() };
    let record = serde_json::json!({"request": {}});
    let evaluation = Evaluation { record, starts: batch(DType::Float64), rows: Some(batch(DType::Bool)) };
    let rounded = capsule::round(&stored).expect("rounded weights");
    let path = swm_fuzz::scratch().join("seed.safetensors");
    rounded.capsule(Description::default(), reference, Some(evaluation)).write(&path).expect("a capsule");
    swm_fuzz::seed("capsule", &std::fs::read(&path).expect("a capsule"));
}

libfuzzer_sys::fuzz_target!(
    init: seed(),
    |bytes: &[u8]| {
        let _ = Capsule::read(&swm_fuzz::file("capsule.safetensors", bytes));
    }
);
