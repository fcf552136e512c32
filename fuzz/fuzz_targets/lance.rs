//! Manifests and data files of Lance tables.

#![no_main]

use std::sync::LazyLock;
use swm_fuzz::{Originals, contained, read_dataset};

static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    Originals::of(&[
        "crates/swm-data/tests/interop/reference.lance",
        "crates/swm-data/tests/interop/reference-text.lance",
        "crates/swm-data/tests/interop/single.lance",
    ])
});

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::catch_library_panics();
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| ORIGINALS.with(bytes, |path| contained(|| read_dataset(path)))
);
