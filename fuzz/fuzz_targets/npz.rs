//! Column files (`.npz`) of folders of images and of videos.

#![no_main]

use std::sync::LazyLock;
use swm_fuzz::{Originals, contained, read_dataset};

static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    Originals::of(&["crates/swm-data/tests/interop/folder-reference", "crates/swm-data/tests/interop/reference-video"])
});

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::catch_library_panics();
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| ORIGINALS.with(bytes, |path| contained(|| read_dataset(path)))
);
