//! Damaged Lance datasets and images.
//!
//! The regular tests read several hundred damaged copies. The ignored tests read many thousand copies; run them with
//! `cargo test --release -p swm-data --test it damage -- --ignored`.

use crate::fuzz;
use crate::sample::write;
use std::path::Path;
use swm_data::{ImageCodec, WriteMode, image, open};

/// Damages copies of a Lance dataset: manifests and data files.
fn damaged_datasets(cases: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    let report = fuzz::dataset("lance", &path, cases, fuzz::read_everything);
    // Without its newest manifest, the dataset has the state before the last commit.
    let earlier = |case: &&String| case.contains(".manifest removed");
    let changed: Vec<&String> = report.changed.iter().filter(|case| !earlier(case)).collect();
    assert!(changed.is_empty(), "{changed:#?}");
    assert!(report.refused as u64 > cases / 4, "{report:?}");
}

#[test]
fn rejects_damaged_datasets() {
    damaged_datasets(400);
}

#[test]
#[ignore = "takes minutes"]
fn rejects_ten_thousand_damaged_datasets() {
    damaged_datasets(10_000);
}

#[test]
fn missing_data_files_are_reported() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    for file in fuzz::files(&path.join("data")) {
        std::fs::remove_file(file).expect("removing a file");
    }
    let reader = open(&path as &Path);
    assert!(reader.is_err_and(|e| e.to_string().contains("damaged or missing")));
}

/// A link to itself stands for a folder or file that cannot be read for a moment; the permissions of files do not bind every user.
#[cfg(all(unix, feature = "lerobot", feature = "hdf5"))]
#[test]
fn what_cannot_be_read_is_not_called_missing_or_damaged() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for (name, parts) in [
        ("d.lerobot", &["", "meta", "meta/info.json", "meta/episodes", "meta/episodes/chunk-000", "data"][..]),
        ("d.folder", &["", "ep_len.npz"]),
        ("d.video", &["", "ep_len.npz"]),
        ("d.h5", &[""]),
        ("d.lance", &["_versions"]),
    ] {
        let path = folder.path().join(name);
        write(&path, WriteMode::Create, 1, 0..2);
        for part in parts {
            let (part, away) = (path.components().chain(Path::new(part).components()), folder.path().join("away"));
            let part: std::path::PathBuf = part.collect();
            std::fs::rename(&part, &away).expect("moving a part away");
            std::os::unix::fs::symlink(&part, &part).expect("a link to itself");
            let read = open(&path).and_then(|reader| reader.content_hash());
            let error = read.expect_err("a part that cannot be read").to_string();
            assert!(error.contains("Too many levels of symbolic links"), "{}: {error}", part.display());
            std::fs::remove_file(&part).expect("removing the link");
            std::fs::rename(&away, &part).expect("moving the part back");
        }
        open(&path).and_then(|reader| reader.content_hash()).expect("the dataset is intact");
    }
}

/// Returns an image of 30 x 40 pixels with runs of equal pixels, gradients and noise.
fn image() -> Vec<u8> {
    (0..40_u32 * 30 * 3).map(|i| if i / 3 % 40 < 15 { 90 } else { (i * i % 251 % (1 + i / 360)) as u8 }).collect()
}

/// Damages encoded images. Decoders of QOI and PNG reject a changed size, but decode changed pixels without an error;
/// the content hash of the dataset detects changed pixels.
fn damaged_images(cases: u64) {
    for (name, codec) in
        [("qoi", ImageCodec::Qoi), ("png", ImageCodec::Png), ("jpeg", ImageCodec::Jpeg { quality: 95 })]
    {
        let mut bytes = vec![];
        codec.encode(&image(), 30, 40, &mut bytes).expect("encoding an image");
        let report = fuzz::bytes(name, &bytes, cases, |bytes| {
            image::image_size(bytes)?;
            let mut out = vec![0; 30 * 40 * 3];
            image::decode(bytes, 30, 40, &mut out).map(|()| out)
        });
        assert!(report.refused as u64 > cases / 4, "{report:?}");
    }
}

#[test]
fn decodes_or_rejects_damaged_images() {
    damaged_images(2_000);
}

#[test]
#[ignore = "takes minutes"]
fn decodes_or_rejects_a_hundred_thousand_damaged_images() {
    damaged_images(100_000);
}
