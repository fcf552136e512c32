//! Datasets in object stores, against an S3 server on loopback. The address and credentials of a store come from
//! environment variables, so tests that use a store run in child processes.

use crate::sample::{check, episode, manifest, options, schema, write};
use hyper_util::rt::{TokioExecutor, TokioIo};
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;
use std::ops::Range;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::{Arc, Mutex};
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::objects::{ObjectFile, list_names};
use swm_data::{CommitPolicy, Constants, Location, StepRange, WriteMode, WriteOptions, create, open};

/// Environment variable of child processes: the location of the dataset.
const TARGET: &str = "SWM_TEST_OBJECTS";
/// The access key and the secret key of the server.
const KEYS: [&str; 2] = ["AKEXAMPLE", "secret/example"];

/// Serves the subfolders of `root` as buckets until the process ends; if `keys` is set, only to clients with [`KEYS`].
/// Returns the server's address. Unlike S3, this server checks for an existing object and writes in two steps, so
/// writes are serialised.
pub fn serve(root: &Path, keys: bool) -> String {
    serve_counted(root, keys, &Arc::default())
}

/// As [`serve`]; notes the byte ranges of all requests.
pub fn serve_counted(root: &Path, keys: bool, ranges: &Arc<Mutex<Vec<Range<u64>>>>) -> String {
    let ranges = Arc::clone(ranges);
    let mut service =
        S3ServiceBuilder::new(s3s_fs::FileSystem::new(root).expect("creating the file system of the server"));
    if keys {
        service.set_auth(SimpleAuth::from_single(KEYS[0], KEYS[1]));
    }
    let service = service.build();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("binding a port");
    let address = listener.local_addr().expect("reading the local address");
    listener.set_nonblocking(true).expect("making the listener non-blocking");
    std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let writing = Arc::new(tokio::sync::Mutex::new(()));
        runtime.expect("a runtime").block_on(async move {
            let listener = tokio::net::TcpListener::from_std(listener).expect("creating the TCP listener");
            while let Ok((socket, _)) = listener.accept().await {
                let server = hyper_util::server::conn::auto::Builder::new(TokioExecutor::new());
                let (service, writing, ranges) = (service.clone(), Arc::clone(&writing), Arc::clone(&ranges));
                let serialised = hyper::service::service_fn(move |request: hyper::Request<_>| {
                    ranges.lock().expect("the ranges").extend(requested_range(request.headers()));
                    let (service, writing) = (service.clone(), Arc::clone(&writing));
                    async move {
                        let writes = request.method() == hyper::Method::PUT;
                        let _guard = if writes { Some(writing.lock().await) } else { None };
                        hyper::service::Service::call(&service, request).await
                    }
                });
                tokio::spawn(async move {
                    let _ = server.serve_connection(TokioIo::new(socket), serialised).await;
                });
            }
        });
    });
    format!("http://{address}")
}

/// The bytes that a request asks for; `None` for all of an object.
fn requested_range(headers: &hyper::HeaderMap) -> Option<Range<u64>> {
    let (first, last) = headers.get("range")?.to_str().ok()?.strip_prefix("bytes=")?.split_once('-')?;
    Some(first.parse().ok()?..last.parse::<u64>().ok()? + 1)
}

/// A process that runs one of the child tests below.
pub fn child(test: &str, endpoint: &str, target: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().expect("finding the test executable"));
    command.args(["--exact", &format!("objects::{test}"), "--nocapture"]).env(TARGET, target);
    command.env("AWS_ENDPOINT_URL", endpoint).env("AWS_REGION", "us-east-1");
    command.env("AWS_ACCESS_KEY_ID", KEYS[0]).env("AWS_SECRET_ACCESS_KEY", KEYS[1]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    command
}

pub fn finished(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{text}\n{}", String::from_utf8_lossy(&output.stderr));
    text
}

fn target() -> Option<Location> {
    Some(Location::parse(&std::env::var(TARGET).ok()?).expect("parsing the location"))
}

fn write_to(location: &Location, mode: WriteMode, episodes: Range<usize>) {
    let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
    let mut writer =
        create(location, &schema(), WriteOptions { commit, ..options(mode) }).expect("creating the dataset");
    for e in episodes {
        let constants = Constants::from([("number".to_owned(), e.to_string().into_bytes())]);
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

/// A child process of other tests: writes, appends to, replaces and reads a dataset.
#[test]
fn child_that_writes_and_reads() {
    let Some(location) = target() else { return };
    assert!(open(&location).is_err(), "no dataset exists yet");
    write_to(&location, WriteMode::Create, 0..5);
    let error = create(&location, &schema(), options(WriteMode::Create)).err().expect("the call must fail").to_string();
    assert!(error.contains("exists already"), "{error}");
    write_to(&location, WriteMode::Append, 5..9);
    let reader = open(&location).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 9);
    check(&*reader, 0);
    assert_eq!(reader.constants(7).expect("reading constants")["number"], b"7");
    assert!(reader.footprint().expect("listing the files").iter().map(|(_, bytes)| bytes).sum::<u64>() > 5_000);

    write_to(&location, WriteMode::Overwrite, 2..4);
    let reader = open(&location).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 2);
    check(&*reader, 2);

    for index in 0..2 {
        let shard = Shard { index, count: 2 };
        // The dataset has episodes of another collection.
        let options = WriteOptions { manifest: Some(manifest(4)), ..options(WriteMode::Create) };
        let mut writer = create_shard(&location, &schema(), options, shard).expect("creating the shard");
        writer.write_episode(&episode(4 + index)).expect("writing an episode");
        writer.finish().expect("finishing the dataset");
    }
    assert_eq!(commit_shards(&location).expect("committing the shards"), 2);
    let reader = open(&location).expect("opening the dataset");
    check(&*reader, 2);
    let Location::Uri(mut prefix) = location else { panic!("a URI") };
    for (path, names) in [("/runs", &["d.lance"][..]), ("/", &["runs"]), ("/none", &[])] {
        prefix.set_path(path);
        assert_eq!(list_names(&Location::Uri(prefix.clone())).expect("a list"), names, "{prefix}");
    }
    println!("hash {}", reader.content_hash().expect("hashing the content"));
}

#[test]
fn stores_datasets_in_a_bucket() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    let endpoint = serve(folder.path(), true);
    let output = child("child_that_writes_and_reads", &endpoint, "s3://bucket/runs/d.lance")
        .output()
        .expect("running the child process");
    let text = finished(&output);
    // The objects in the bucket equal the files of a local dataset.
    let reader = open(folder.path().join("bucket/runs/d.lance")).expect("opening the dataset");
    check(&*reader, 2);
    assert!(text.contains(&reader.content_hash().expect("hashing the content")), "{text}");
    assert_eq!(std::fs::read_dir(folder.path().join("bucket/runs/d.lance/data")).expect("listing a folder").count(), 5);

    let mut wrong = child("child_that_reads", &endpoint, "s3://bucket/runs/d.lance");
    wrong.env("AWS_SECRET_ACCESS_KEY", "no");
    let text = finished(&wrong.output().expect("running the child process"));
    assert!(text.contains("failed: s3://bucket/runs/d.lance"), "{text}");
    let text = finished(
        &child("child_that_reads", &endpoint, "s3://bucket/none.lance").output().expect("running the child process"),
    );
    assert!(text.contains("it holds no Lance table"), "{text}");
}

/// A child process of other tests: opens a dataset and prints the result.
#[test]
fn child_that_reads() {
    let Some(location) = target() else { return };
    match open(&location) {
        Ok(reader) => {
            check(&*reader, 0);
            println!("read {} episodes", reader.episodes().len());
        }
        Err(error) => println!("failed: {error}"),
    }
}

/// A child process of other tests: appends one episode at a time.
#[test]
fn child_that_appends() {
    let Some(location) = target() else { return };
    let commit = CommitPolicy { episodes: 1, ..CommitPolicy::default() };
    let options = WriteOptions { commit, ..options(WriteMode::Append) };
    let mut writer = create(&location, &schema(), options).expect("continuing the dataset");
    for e in 0..12 {
        writer.write_episode(&episode(e)).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

#[test]
fn concurrent_processes_append_to_a_bucket() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    std::fs::create_dir(folder.path().join("bucket")).expect("creating a bucket");
    let endpoint = serve(folder.path(), true);
    let children: Vec<_> = (0..3)
        .map(|_| {
            child("child_that_appends", &endpoint, "s3://bucket/d.lance").spawn().expect("starting the child process")
        })
        .collect();
    for child in children {
        finished(&child.wait_with_output().expect("waiting for the child process"));
    }
    let reader = open(folder.path().join("bucket/d.lance")).expect("opening the dataset");
    let indices: Vec<i64> = reader.episodes().iter().map(|episode| episode.index).collect();
    assert_eq!(indices, (0..36).collect::<Vec<_>>());
    let firsts: Vec<StepRange> = (0..36).map(|at| StepRange::new(at, 0, 1)).collect();
    let states = reader.read(&["state"], &firsts).expect("reading rows");
    let mut found: Vec<f64> = states.get::<f64>("state").expect("reading the states").chunks(3).map(|s| s[0]).collect();
    found.sort_by(f64::total_cmp);
    assert_eq!(found, (0..36).map(|at| f64::from(at / 3)).collect::<Vec<_>>());
}

#[test]
fn reads_from_but_does_not_write_to_a_web_server() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    write(&folder.path().join("bucket/d.lance"), WriteMode::Create, 2, 0..5);
    let endpoint = serve(folder.path(), false);
    let location = Location::parse(&format!("{endpoint}/bucket/d.lance")).expect("parsing the location");
    let reader = open(&location).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 5);
    check(&*reader, 0);
    assert!(reader.footprint().is_ok_and(|parts| !parts.is_empty()), "a web server lists no files");
    let error = create(&location, &schema(), options(WriteMode::Append)).err().expect("the call must fail").to_string();
    assert!(error.contains("cannot be written"), "{error}");
    let missing = Location::parse(&format!("{endpoint}/bucket/none.lance")).expect("parsing the location");
    assert!(open(&missing).is_err());

    let bytes: Vec<u8> = (0..400_000_u32).map(|i| ((i * i) >> 5) as u8).collect();
    std::fs::write(folder.path().join("bucket/file.h5"), &bytes).expect("writing a file");
    let file = Location::parse(&format!("{endpoint}/bucket/file.h5")).expect("parsing the location");
    let file = ObjectFile::open(&file).expect("opening a file");
    assert_eq!(file.len(), 400_000);
    let parts = file.read(&[300_000..400_000, 5..9]).expect("reading byte ranges");
    assert!(parts[0] == bytes[300_000..] && parts[1] == bytes[5..9]);
}

#[test]
fn unreachable_store_is_not_reported_as_damage() {
    let unused_address = std::net::TcpListener::bind("127.0.0.1:0")
        .expect("binding a port")
        .local_addr()
        .expect("reading the local address");
    let location = Location::parse(&format!("http://{unused_address}/d.lance")).expect("parsing the location");
    let error = open(&location).err().expect("opening without a server must be an error").to_string();
    assert!(!error.contains("damaged") && error.contains(&unused_address.to_string()), "{error}");
}
