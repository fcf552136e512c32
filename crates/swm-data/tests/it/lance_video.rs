//! The format `lance-video`. Run the long tests with:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored lance_video::
//! ```

use crate::sample::{check, episode, manifest, schema};
use crate::{format_suite, fuzz};
use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use swm_core::Schema;
use swm_data::{CommitPolicy, Constants, ImageCodec, WriteMode, WriteOptions, create, open};

fn write(path: &std::path::Path, mode: WriteMode, codec: ImageCodec, episodes: std::ops::Range<usize>) {
    let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
    let options = WriteOptions { mode, codec, manifest: Some(manifest(3)), commit, exclusive: false, continues: None };
    let mut writer = create(path, &schema(), options).expect("creating the dataset");
    for e in episodes {
        let constants = Constants::from([("scene.xml".to_owned(), format!("<{e}/>").into_bytes())]);
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

#[test]
fn written_episodes_are_read_with_their_images() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for (name, codec) in [("a", ImageCodec::Png), ("b", ImageCodec::Jpeg { quality: 95 })] {
        let path = folder.path().join(format!("{name}.lance-video"));
        write(&path, WriteMode::Create, codec, 0..5);
        write(&path, WriteMode::Append, codec, 5..8);
        let reader = open(&path).expect("opening the dataset");
        assert_eq!(reader.episodes().len(), 8);
        let names = |schema: &Schema| -> Vec<String> {
            schema.columns().iter().map(|c| c.name.clone()).filter(|name| name != "step_idx").collect()
        };
        assert_eq!(names(reader.schema())[1..], names(&schema()));
        check(&*reader, 0);
        if codec == ImageCodec::Png {
            format_suite::check(&*reader, 0);
        }
        assert_eq!(
            reader.constants(6).expect("reading constants"),
            Constants::from([("scene.xml".to_owned(), b"<6/>".to_vec())])
        );
        assert_eq!(reader.manifest(), Some(manifest(3)));
        let hash = reader.content_hash().expect("hashing the content");
        write(&path, WriteMode::Overwrite, codec, 3..5);
        let reader = open(&path).expect("opening the dataset");
        assert_eq!(reader.episodes().len(), 2);
        check(&*reader, 3);
        assert_ne!(reader.content_hash().expect("hashing the content"), hash);
        let error = create(&path, &schema(), WriteOptions::default())
            .err()
            .expect("creating an existing dataset must be an error")
            .to_string();
        assert!(error.contains("exists already"), "{error}");
        let few = Schema::new(schema().columns()[..4].to_vec()).expect("creating the schema");
        let options = WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() };
        assert!(create(&path, &few, options).is_err(), "appending other columns must fail");
    }
    assert!(open(folder.path().join("none.lance-video")).is_err(), "opening a missing dataset must fail");
    let images = Schema::new(schema().columns()[..1].to_vec()).expect("creating the schema");
    let path = folder.path().join("images.lance-video");
    let error = create(&path, &images, WriteOptions::default())
        .err()
        .expect("a schema without a numeric column must be an error")
        .to_string();
    assert!(error.contains("format video"), "{error}");
}

/// Kills a writer after some episodes. Committed episodes must be readable, and the next writer continues.
fn killed(kills: usize) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance-video");
    write(&path, WriteMode::Create, ImageCodec::Jpeg { quality: 95 }, 0..2);
    let mut stored = 2;
    for kill in 0..kills {
        let mut command = Command::new(std::env::current_exe().expect("finding the test executable"));
        command.args(["--exact", "interruption::child_that_writes", "--nocapture"]);
        command.env("SWM_TEST_CHILD_TARGET", &path).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().expect("starting the child process");
        let mut lines = BufReader::new(child.stdout.take().expect("the output of the child process")).lines();
        let mut seen = 0;
        while seen < 3 + 5 * kill % 11 {
            seen += usize::from(lines.next().expect("another line").expect("a line of text").contains("episode "));
        }
        child.kill().expect("killing the child process");
        child.wait().expect("waiting for the child process");
        let reader = open(&path).expect("opening the dataset");
        check(&*reader, 0);
        // A commit has three episodes; more may wait for the committing thread.
        let now = reader.episodes().len();
        assert!(now >= stored && now + 9 > stored + seen, "{now} episodes after {stored} and {seen}");
        stored = now;
    }
    write(&path, WriteMode::Append, ImageCodec::Jpeg { quality: 95 }, stored..stored + 1);
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), stored + 1);
    check(&*reader, 0);
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    killed(3);
}

#[test]
#[ignore = "takes a minute"]
fn writer_killed_50_times_keeps_committed_episodes() {
    killed(50);
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance-video");
    write(&path, WriteMode::Create, ImageCodec::Png, 0..3);
    let report = fuzz::dataset("lance-video", &path, cases, fuzz::read_everything);
    assert!(report.refused > 0, "{report:?}");
}

#[test]
fn reads_or_rejects_damaged_tables() {
    damaged(300);
}

#[test]
#[ignore = "takes minutes"]
fn reads_or_rejects_tables_damaged_in_10000_ways() {
    damaged(10_000);
}
