//! Weights that `torch.save` wrote, of both of its formats.

#![no_main]

use swm_models::weights;

libfuzzer_sys::fuzz_target!(
    init: {
        for name in ["weights-zip.pt", "weights-legacy.pth", "weights-training.ckpt"] {
            swm_fuzz::seed_files(&format!("crates/swm-models/tests/golden/{name}"), "");
        }
    },
    |bytes: &[u8]| {
        let _ = weights::read(&swm_fuzz::file("weights.pt", bytes));
    }
);
