//! HDF5 files in object stores, read by byte ranges.

use crate::{format_suite, objects};
use rand::Rng as _;
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::{Batch, ColumnSpec, DType, Key, Schema};
use swm_data::{Location, Reader, StepRange, WriteMode, WriteOptions, create, open};

/// A folder with a bucket that has a dataset, and the path of the dataset.
fn bucket() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    let path = folder.path().join("bucket/d.h5");
    format_suite::write(&path, WriteMode::Create, 0..30);
    (folder, path)
}

/// As [`bucket`], with a file of 2 MB that has 40 episodes of noise.
fn bucket_of_noise() -> (tempfile::TempDir, PathBuf) {
    const ROWS: usize = 4;
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    let path = folder.path().join("bucket/d.h5");
    let columns = [
        ColumnSpec::image("pixels", 64, 64),
        ColumnSpec::new("action", DType::Float32, [2]),
        ColumnSpec::new("state", DType::Float64, [3]),
        ColumnSpec::new("reward", DType::Float32, []),
    ];
    let schema = Schema::new(columns).expect("creating the schema");
    let mut writer = create(&path, &schema, WriteOptions::default()).expect("creating the dataset");
    for episode in 0..40 {
        let (mut rows, mut rng) = (Batch::zeros(&schema, ROWS), Key::new(5).at(episode).rng());
        rng.fill(rows.bytes_mut(0));
        rows.row_mut(ROWS - 1).set(1, &[f32::NAN; 2]);
        writer.write_episode(&rows).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
    (folder, path)
}

/// All rows of all episodes.
fn all_rows(reader: &dyn Reader) -> Vec<StepRange> {
    reader.episodes().iter().enumerate().map(|(i, episode)| StepRange::new(i, 0, episode.length)).collect()
}

#[test]
fn a_pass_over_a_file_fetches_it_about_once() {
    let (folder, path) = bucket_of_noise();
    let ranges = Arc::default();
    let web = objects::serve_counted(folder.path(), false, &ranges);
    let reader = open(Location::parse(&format!("{web}/bucket/d.h5")).expect("a location")).expect("the dataset");
    for episode in all_rows(&*reader) {
        reader.read(&["pixels", "action", "state", "reward"], &[episode]).expect("reading an episode");
    }
    let (size, ranges) = (path.metadata().expect("the file").len(), ranges.lock().expect("the ranges"));
    let bytes: u64 = ranges.iter().map(|range| range.end - range.start).sum();
    assert!(size > 1_900_000 && bytes >= size / 2, "{bytes} of {size} bytes");
    assert!(ranges.len() < 20 && bytes < size * 3 / 2, "{} requests, {bytes} of {size} bytes", ranges.len());
}

#[test]
fn reads_files_in_a_bucket_and_on_a_web_server() {
    let (folder, path) = bucket();

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
fn objects_that_are_written_over_while_they_are_open_are_refused() {
    let (folder, path) = bucket_of_noise();
    let web = objects::serve(folder.path(), false);
    let reader = open(Location::parse(&format!("{web}/bucket/d.h5")).expect("a location")).expect("the dataset");
    reader.read(&["state"], &[StepRange::new(0, 0, 2)]).expect("reading rows");
    // Another content of the same size, at the same time: the tag differs.
    let time = path.metadata().and_then(|found| found.modified()).expect("a time");
    let mut content = std::fs::read(&path).expect("the file");
    let middle = content.len() / 2;
    content[middle] ^= 1;
    std::fs::write(&path, content).expect("writing it over");
    let file = std::fs::File::options().append(true).open(&path).expect("the file");
    file.set_modified(time).expect("setting the time");
    let error = reader.read(&["pixels", "action"], &all_rows(&*reader)).expect_err("another file").to_string();
    assert!(error.contains("written over while it was read"), "{error}");
    assert!(error.contains("or several servers answer with other tags"), "{error}");
    assert!(error.matches("bytes with the tag ").count() == 2 && !error.contains("the tag none"), "{error}");
    open(Location::parse(&format!("{web}/bucket/d.h5")).expect("a location")).expect("opening it again");
}

#[test]
fn signatures_and_tokens_do_not_follow_redirections_to_another_host() {
    use std::io::{Read as _, Write as _};
    let listen = || std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let (store, other) = (listen(), listen());
    let elsewhere = other.local_addr().expect("an address");
    let bucket = format!("http://{}", store.local_addr().expect("an address"));
    std::thread::spawn(move || {
        for mut stream in store.incoming().flatten() {
            let mut request = [0; 4096];
            let _ = stream.read(&mut request);
            let head = "HTTP/1.1 307 Temporary Redirect\r\nContent-Length: 0\r\nConnection: close";
            let _ = write!(stream, "{head}\r\nLocation: http://{elsewhere}/d.h5\r\n\r\n");
        }
    });
    let output = objects::child("child_that_reads", &bucket, "s3://bucket/d.h5")
        .env("AWS_SESSION_TOKEN", "a-secret")
        .output()
        .expect("running the child process");
    let text = objects::finished(&output);
    assert!(text.contains("failed: "), "{text}");
    other.set_nonblocking(true).expect("a listener");
    assert!(other.accept().is_err(), "a request arrived at the other host");
}

#[test]
fn does_not_write_to_a_web_server() {
    let location = Location::parse("http://127.0.0.1:9/d.h5").expect("parsing the location");
    let error = format_suite::writer(&location, WriteMode::Create).err().expect("the call must fail").to_string();
    assert!(error.contains("hdf5") && error.contains("copy the dataset"), "{error}");
}
