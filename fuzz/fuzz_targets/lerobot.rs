//! Parquet and JSON files of LeRobot datasets.

#![no_main]

use std::sync::LazyLock;
use swm_fuzz::{Originals, contained, read_dataset};

static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    Originals::of(&["crates/swm-data/tests/interop/lerobot-v21", "crates/swm-data/tests/interop/lerobot-v30-h264"])
});

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::catch_library_panics();
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| ORIGINALS.with(bytes, |path| contained(|| read_dataset(path)))
);
