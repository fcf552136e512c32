//! Weights in the format safetensors.

#![no_main]

use swm_models::weights;

libfuzzer_sys::fuzz_target!(
    init: {
        for name in ["weights-same.safetensors", "weights-single.safetensors", "reference-lewm.safetensors"] {
            swm_fuzz::seed_files(&format!("crates/swm-models/tests/golden/{name}"), "");
        }
    },
    |bytes: &[u8]| {
        let _ = weights::read(&swm_fuzz::file("weights.safetensors", bytes));
    }
);
