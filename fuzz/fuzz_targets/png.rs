//! PNG images.

#![no_main]

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::seed_files("crates/swm-image/tests", ".png");
        swm_fuzz::seed_files("crates/swm-data/tests/interop/folder-reference", ".png");
    },
    |bytes: &[u8]| {
        if bytes.starts_with(b"\x89PNG".as_slice()) {
            swm_fuzz::decode_image(bytes);
        }
    }
);
