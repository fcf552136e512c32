//! Damaged Lance datasets and pictures.
//!
//! The suite tries some hundred of each; `cargo test --release -p swm-data --test it damage -- --ignored` many thousand.

use crate::fuzz;
use crate::sample::write;
use std::path::Path;
use swm_data::{ImageCodec, WriteMode, image, open};

/// Each kind of file of a Lance dataset (manifests, data), damaged in all ways.
fn damaged_datasets(cases: u64) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    let report = fuzz::dataset("lance", &path, cases, fuzz::read_everything);
    // Without its newest manifest it is the dataset it was before the last commit.
    let earlier = |case: &&String| case.contains(".manifest removed");
    let changed: Vec<&String> = report.changed.iter().filter(|case| !earlier(case)).collect();
    assert!(changed.is_empty(), "{changed:#?}");
    assert!(report.refused as u64 > cases / 4, "{report:?}");
}

#[test]
fn damaged_datasets_are_refused() {
    damaged_datasets(400);
}

#[test]
#[ignore = "takes minutes"]
fn ten_thousand_damaged_datasets_are_refused() {
    damaged_datasets(10_000);
}

#[test]
fn a_dataset_without_its_data_says_so() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    for file in fuzz::files(&path.join("data")) {
        std::fs::remove_file(file).expect("removes");
    }
    let reader = open(&path as &Path);
    assert!(reader.is_err_and(|e| e.to_string().contains("damaged or missing")));
}

/// A picture with runs, gradients and noise.
fn picture() -> Vec<u8> {
    (0..40_u32 * 30 * 3).map(|i| if i / 3 % 40 < 15 { 90 } else { (i * i % 251 % (1 + i / 360)) as u8 }).collect()
}

/// The codecs' own bytes, damaged in all ways. QOI and PNG notice what changes the size; a flipped pixel is theirs to
/// show, and the dataset's hash to find.
fn damaged_pictures(cases: u64) {
    for (name, codec) in
        [("qoi", ImageCodec::Qoi), ("png", ImageCodec::Png), ("jpeg", ImageCodec::Jpeg { quality: 95 })]
    {
        let mut bytes = vec![];
        codec.encode(&picture(), 30, 40, &mut bytes).expect("encodes");
        let report = fuzz::bytes(name, &bytes, cases, |bytes| {
            image::image_size(bytes)?;
            let mut out = vec![0; 30 * 40 * 3];
            image::decode(bytes, 30, 40, &mut out).map(|()| out)
        });
        assert!(report.refused as u64 > cases / 4, "{report:?}");
    }
}

#[test]
fn damaged_pictures_are_refused_or_shown() {
    damaged_pictures(2_000);
}

#[test]
#[ignore = "takes minutes"]
fn a_hundred_thousand_damaged_pictures_are_refused_or_shown() {
    damaged_pictures(100_000);
}
