//! JPEG images.

#![no_main]

libfuzzer_sys::fuzz_target!(
    init: {
        swm_fuzz::seed_files("crates/swm-image/tests", ".jpg");
        swm_fuzz::seed_files("crates/swm-image/tests", ".jpeg");
        swm_fuzz::seed_files("crates/swm-data/tests/interop/folder-reference", ".jpg");
        swm_fuzz::seed_files("crates/swm-data/tests/interop/folder-reference", ".jpeg");
    },
    |bytes: &[u8]| {
        if bytes.starts_with(&[0xff, 0xd8]) {
            swm_fuzz::decode_image(bytes);
        }
    }
);
