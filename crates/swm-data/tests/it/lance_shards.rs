//! Datasets that several machines write as shards.

use crate::sample::{check, episode, manifest, options, schema, write};
use std::path::Path;
use swm_core::{ColumnSpec, DType, Schema};
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::{CommitPolicy, Constants, Location, WriteMode, WriteOptions, Writer, open};

fn shard_writer(path: &Path, mode: WriteMode, index: usize, count: usize) -> swm_core::Result<Box<dyn Writer>> {
    let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
    // Other numbers of shards are other collections.
    let options = WriteOptions { commit, manifest: Some(manifest(count as u64)), ..options(mode) };
    create_shard(&Location::from(path), &schema(), options, Shard { index, count })
}

fn write_shard(path: &Path, index: usize, count: usize, episodes: std::ops::Range<usize>) {
    let mut writer = shard_writer(path, WriteMode::Create, index, count).expect("creating the shard");
    for e in episodes {
        let constants = Constants::from([("number".to_owned(), e.to_string().into_bytes())]);
        writer.write_episode_with(&episode(e), &constants).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

fn failure(path: &Path) -> String {
    commit_shards(&Location::from(path)).expect_err("the call must fail").to_string()
}

#[test]
fn committed_shards_equal_the_dataset_of_one_writer() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    assert!(failure(&path).contains("no shards to commit"));
    // Two threads, in place of two machines, write shards in any order.
    std::thread::scope(|scope| {
        scope.spawn(|| write_shard(&path, 2, 3, 7..12));
        scope.spawn(|| write_shard(&path, 0, 3, 0..5));
    });
    assert!(failure(&path).contains("shard 1 of 3 is missing"));
    assert!(open(&path).is_err(), "no dataset exists before the commit");
    write_shard(&path, 1, 3, 5..7);
    assert_eq!(commit_shards(&Location::from(&path)).expect("committing the shards"), 12);

    let reader = open(&path).expect("opening the dataset");
    check(&*reader, 0);
    assert_eq!(reader.episodes().iter().map(|e| e.index).collect::<Vec<_>>(), (0..12).collect::<Vec<_>>());
    for e in [0, 4, 5, 11] {
        assert_eq!(reader.constants(e).expect("reading constants")["number"], e.to_string().into_bytes());
    }
    assert!(failure(&path).contains("no shards to commit"), "the logs of the shards are removed");
    // The content equals the dataset of a single writer.
    let single_writer_path = folder.path().join("whole.lance");
    write(&single_writer_path, WriteMode::Create, 100, 0..12);
    let columns = ["pixels", "state", "episode_idx", "step_idx"];
    let all: Vec<_> = (0..12).map(|e| swm_data::StepRange::new(e, 0, reader.episodes()[e].length)).collect();
    let read = |reader: &dyn swm_data::Reader| reader.read(&columns, &all).expect("reading rows");
    let (from_shards, from_one_writer) =
        (read(&*reader), read(&*open(&single_writer_path).expect("opening the dataset")));
    assert!((0..columns.len()).all(|column| from_shards.bytes(column) == from_one_writer.bytes(column)));

    // Appends two more shards, then episodes of an ordinary writer.
    write_shard(&path, 0, 2, 12..14);
    write_shard(&path, 1, 2, 14..16);
    assert_eq!(commit_shards(&Location::from(&path)).expect("committing the shards"), 4);
    write(&path, WriteMode::Append, 1, 16..18);
    let reader = open(&path).expect("opening the dataset");
    assert_eq!(reader.episodes().len(), 18);
    check(&*reader, 0);
}

#[test]
fn interrupted_shard_is_continued_and_finished_shard_is_overwritten() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write_shard(&path, 1, 2, 4..6);
    let mut writer = shard_writer(&path, WriteMode::Create, 0, 2).expect("creating the shard");
    for e in 0..2 {
        writer.write_episode(&episode(e)).expect("writing an episode");
    }
    writer.pause().expect("pausing the shard");
    assert!(failure(&path).contains("shard 0 of 2 is not finished"));
    drop(shard_writer(&path, WriteMode::Append, 0, 2).expect("continuing the shard"));
    assert!(failure(&path).contains("shard 0 of 2 is not finished"));
    assert!(
        shard_writer(&path, WriteMode::Create, 0, 2)
            .err()
            .expect("the call must fail")
            .to_string()
            .contains("already exists")
    );
    let mut writer = shard_writer(&path, WriteMode::Append, 0, 2).expect("continuing the shard");
    assert_eq!(writer.episodes(), 2);
    for e in 2..4 {
        writer.write_episode(&episode(e)).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
    commit_shards(&Location::from(&path)).expect("committing the shards");
    check(&*open(&path).expect("opening the dataset"), 0);

    write_shard(&path, 0, 1, 0..3);
    let mut writer = shard_writer(&path, WriteMode::Overwrite, 0, 1).expect("overwriting the shard");
    writer.write_episode(&episode(6)).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    assert_eq!(commit_shards(&Location::from(&path)).expect("committing the shards"), 1);
    check(&*open(&path).expect("opening the dataset"), 0);
}

#[test]
fn commit_after_a_commit_killed_before_cleanup_adds_no_episodes() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    write_shard(&path, 0, 1, 0..3);
    crate::fuzz::copy_all(&path.join("_shards"), &folder.path().join("kept"));
    assert_eq!(commit_shards(&Location::from(&path)).expect("committing the shards"), 3);
    crate::fuzz::copy_all(&folder.path().join("kept"), &path.join("_shards"));
    assert_eq!(commit_shards(&Location::from(&path)).expect("committing the shards"), 0);
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 3);
    assert!(failure(&path).contains("no shards to commit"));
}

#[test]
fn rejects_inconsistent_shards() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let location = Location::from(&path);
    assert!(
        shard_writer(&path, WriteMode::Create, 3, 3)
            .err()
            .expect("the call must fail")
            .to_string()
            .contains("no shard 3 of 3")
    );
    write_shard(&path, 0, 2, 0..2);
    write_shard(&path, 0, 3, 0..2);
    assert!(failure(&path).contains("there are shards of"));
    drop(shard_writer(&path, WriteMode::Overwrite, 0, 3).expect("overwriting the shard"));
    std::fs::remove_dir_all(path.join("_shards/0-of-3")).expect("removing a folder");
    let other = Schema::new([ColumnSpec::new("other", DType::Float32, [])]).expect("creating the schema");
    let shard = Shard { index: 1, count: 2 };
    create_shard(&location, &other, options(WriteMode::Create), shard)
        .expect("creating the shard")
        .finish()
        .expect("finishing the dataset");
    assert!(failure(&path).contains("writing a shard of"));
}
