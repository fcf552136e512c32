//! Checkpoints: `config.json`, `manifest.json` and the weights of several families.

#![no_main]

use std::path::Path;
use std::sync::LazyLock;
use swm_fuzz::{Originals, contained};
use swm_models::Device;
use swm_models::train::DatasetInfo;
use swm_models::{gcrl, lewm, pldm};

/// The checkpoints of the reference implementation in the repository, as checkpoints of this program.
static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    let mut originals = Originals::default();
    let info = |dim: usize| -> DatasetInfo {
        let action = serde_json::json!({"mean": vec![0.0; dim], "std": vec![1.0; dim]});
        let info = serde_json::json!({"action": action, "columns": {}, "env": "swm/TwoRoom-v1"});
        serde_json::from_value(info).expect("dataset info")
    };
    let golden = |name: &str| {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../crates/swm-models/tests/golden/reference").join(name)
    };
    let out = |name: &str| swm_fuzz::scratch().join(name);
    let mut policy = gcrl::import::import::<gcrl::Gcivl>(&golden("gcivl"), info(2)).expect("a policy");
    policy.save_to(&out("gcivl")).expect("a saved checkpoint");
    let mut model = lewm::import::import(&golden("lewm"), info(2)).expect("a world model");
    model.save_to(&out("lewm")).expect("a saved checkpoint");
    let mut model = pldm::import::import(&golden("pldm"), info(4)).expect("a world model");
    model.save_to(&out("pldm")).expect("a saved checkpoint");
    ["gcivl", "lewm", "pldm"].iter().for_each(|name| originals.add(&out(name)));
    originals
});

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::catch_library_panics();
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| {
        ORIGINALS.with(bytes, |path| contained(|| drop(swm_models::load(path, &Device::flex()))));
    }
);
