//! Damaged Lance datasets and pictures.
//!
//! The suite tries some hundred of each; `cargo test --release -p swm-data --test it damage -- --ignored` many thousand.

use crate::fuzz;
use crate::sample::write;
use std::path::Path;
use swm_data::{WriteMode, open};

/// Each kind of file of a Lance dataset (manifests, data), damaged in all ways.
fn damaged_datasets(cases: u64) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    let report = fuzz::dataset("lance", &path, cases, fuzz::read_everything);
    assert!(report.changed.is_empty(), "{:#?}", report.changed);
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
