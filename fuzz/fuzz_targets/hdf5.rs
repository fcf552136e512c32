//! HDF5 files.

#![no_main]

use std::sync::LazyLock;
use swm_fuzz::{Originals, contained, read_dataset};

static ORIGINALS: LazyLock<Originals> = LazyLock::new(|| {
    Originals::of(&[
        "crates/swm-data/tests/interop/hdf5-layouts.h5",
        "crates/swm-data/tests/interop/hdf5-filters.h5",
        "crates/swm-data/tests/interop/hdf5-reference.h5",
        "crates/swm-data/tests/interop/hdf5-trees.h5",
    ])
});

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::catch_library_panics();
        LazyLock::force(&ORIGINALS);
    },
    |bytes: &[u8]| ORIGINALS.with(bytes, |path| contained(|| read_dataset(path)))
);
