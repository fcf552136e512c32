//! HDF5 files in object stores, read by byte ranges.

use crate::{format_suite, objects};
use swm_data::{Location, StepRange, WriteMode, open};

#[test]
fn reads_files_in_a_bucket_and_on_a_web_server() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    let path = folder.path().join("bucket/d.h5");
    format_suite::write(&path, WriteMode::Create, 0..30);

    let web = objects::serve(folder.path(), false);
    let location = Location::parse(&format!("{web}/bucket/d.h5")).expect("parsing the location");
    let reader = open(&location).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 30);
    format_suite::check(&*reader, 0);
    let local = open(&path).expect("opening the dataset");
    assert_eq!(reader.content_hash().expect("hashing the content"), local.content_hash().expect("hashing the content"));
    assert_eq!(reader.constants(7).expect("reading constants"), local.constants(7).expect("reading constants"));
    // A batch in random order, with some rows twice.
    let ranges: Vec<StepRange> = (0..60).map(|i| StepRange::new(i * 7 % 30, i % 4, 2)).collect();
    let names = ["pixels", "action", "state"];
    let (local_rows, remote_rows) =
        (local.read(&names, &ranges).expect("reading rows"), reader.read(&names, &ranges).expect("reading rows"));
    (0..3).for_each(|column| assert!(local_rows.bytes(column) == remote_rows.bytes(column), "{}", names[column]));

    let bucket = objects::serve(folder.path(), true);
    let output =
        objects::child("child_that_reads", &bucket, "s3://bucket/d.h5").output().expect("running the child process");
    let text = objects::finished(&output);
    assert!(text.contains("read 30 episodes"), "{text}");
    let output =
        objects::child("child_that_reads", &bucket, "s3://bucket/none.h5").output().expect("running the child process");
    let text = objects::finished(&output);
    assert!(text.contains("failed: s3://bucket/none.h5"), "{text}");
}

#[test]
fn does_not_write_to_a_web_server() {
    let location = Location::parse("http://127.0.0.1:9/d.h5").expect("parsing the location");
    let error = format_suite::writer(&location, WriteMode::Create).err().expect("the call must fail").to_string();
    assert!(error.contains("hdf5") && error.contains("copy the dataset"), "{error}");
}
