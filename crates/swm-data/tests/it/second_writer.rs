//! Two writers of one dataset: exclusive writers refuse each other, so that two continued collections cannot store the
//! same episodes twice.

use crate::sample::{check, episode, manifest, options, schema, write};
use swm_core::run::Control;
use swm_data::lance::{Shard, create_shard};
use swm_data::{
    CommitPolicy, Continued, ConvertMode, ConvertOptions, Location, WriteMode, WriteOptions, convert, create, open,
};

fn exclusive(mode: WriteMode) -> WriteOptions {
    let commit = CommitPolicy { episodes: 1, ..CommitPolicy::default() };
    WriteOptions { exclusive: true, commit, ..options(mode) }
}

#[test]
fn second_collection_into_a_dataset_is_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "h5", "lerobot"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        let mut first = create(&path, &schema(), exclusive(WriteMode::Append)).expect("continuing");
        for mode in [WriteMode::Append, WriteMode::Overwrite] {
            let error = create(&path, &schema(), exclusive(mode)).err().expect("a second writer");
            assert!(error.is_usage() && error.to_string().contains("another process writes"), "{format}: {error}");
        }
        first.write_episode(&episode(2)).expect("writing");
        first.finish().expect("finishing");
        let reader = open(&path).expect("opening");
        assert_eq!(reader.episodes().len(), 3, "{format}");
        check(&*reader, 0);
    }
}

/// A writer waits for the lock of one that replaces the dataset whose episodes the caller has read.
#[test]
fn a_dataset_that_was_replaced_is_not_continued() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "h5", "lerobot"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        let continues = Some(Continued::of(&*open(&path).expect("opening")).expect("an identity"));
        let append = || WriteOptions { continues: continues.clone(), ..exclusive(WriteMode::Append) };
        create(&path, &schema(), append()).expect("continuing").finish().expect("finishing");
        let mut other = options(WriteMode::Overwrite);
        other.manifest = Some(manifest(9));
        let mut replacing = create(&path, &schema(), other).expect("replacing");
        (5..7).for_each(|e| replacing.write_episode(&episode(e)).expect("writing"));
        replacing.finish().expect("finishing");
        let error = create(&path, &schema(), append()).err().expect("another dataset");
        assert!(error.is_usage() && error.to_string().contains("another program replaced it"), "{format}: {error}");
        let reader = open(&path).expect("opening");
        assert_eq!((reader.episodes().len(), reader.manifest().map(|found| found.seed)), (2, Some(9)), "{format}");
        check(&*reader, 5);
    }
}

#[test]
fn a_file_that_is_moved_while_it_is_written_is_an_error() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let (path, moved) = (folder.path().join("data.h5"), folder.path().join("moved.h5"));
    for is_copied_back in [false, true] {
        write(&path, WriteMode::Overwrite, 1, 0..2);
        let mut writer = create(&path, &schema(), exclusive(WriteMode::Append)).expect("continuing");
        std::fs::rename(&path, &moved).expect("moving");
        if is_copied_back {
            std::fs::copy(&moved, &path).expect("copying");
        }
        writer.write_episode(&episode(2)).expect("writing");
        let error = writer.finish().expect_err("a moved file").to_string();
        assert!(error.contains("moved, deleted or replaced"), "{error}");
        assert_eq!(open(&moved).expect("opening").episodes().len(), 3);
        std::fs::remove_file(&moved).expect("deleting");
    }
}

#[test]
fn writers_that_replace_a_table_do_not_mix_their_episodes() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for existing in [false, true] {
        let path = folder.path().join(format!("data-{existing}.lance"));
        if existing {
            write(&path, WriteMode::Create, 1, 0..2);
        }
        let mut first = create(&path, &schema(), options(WriteMode::Overwrite)).expect("replacing");
        let error = create(&path, &schema(), options(WriteMode::Overwrite)).err().expect("a second writer");
        assert!(error.is_usage() && error.to_string().contains("another process writes"), "{error}");
        first.write_episode(&episode(0)).expect("writing");
        first.finish().expect("finishing");
        let reader = open(&path).expect("opening");
        assert_eq!(reader.episodes().len(), 1);
        check(&*reader, 0);
    }
}

#[test]
fn exclusive_writer_fails_when_another_writer_commits() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("data.lance");
    write(&path, WriteMode::Create, 1, 0..2);
    let mut writer = create(&path, &schema(), exclusive(WriteMode::Append)).expect("continuing");
    // As in an object store, the other writer takes no lock.
    write(&path, WriteMode::Append, 1, 2..3);
    let failed = writer.write_episode(&episode(2)).and_then(|()| writer.finish()).expect_err("another writer");
    assert!(failed.to_string().contains("another process writes to it"), "{failed}");
    let reader = open(&path).expect("opening");
    assert_eq!(reader.episodes().len(), 3);
    check(&*reader, 0);
}

#[test]
fn second_conversion_into_a_dataset_is_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let (path, target) = (folder.path().join("source.lance"), folder.path().join("target.lance"));
    write(&path, WriteMode::Create, 1, 0..2);
    write(&target, WriteMode::Create, 1, 0..1);
    let source = open(&path).expect("opening");
    let append = ConvertOptions { mode: ConvertMode::Append, ..ConvertOptions::default() };
    let first = create(&target, &schema(), exclusive(WriteMode::Append)).expect("continuing");
    let refused =
        convert(&source, &Location::from(&target), &append, &mut Control::new()).expect_err("a second writer");
    assert!(refused.to_string().contains("another process writes"), "{refused}");
    drop(first);
    // Another program adds an episode after the conversion has counted those of the target.
    let mut late = true;
    let mut control = Control::new().with_events(|_| {
        if std::mem::take(&mut late) {
            write(&target, WriteMode::Append, 1, 1..2);
        }
    });
    let refused = convert(&source, &Location::from(&target), &append, &mut control).expect_err("a changed target");
    assert!(refused.to_string().contains("it had 1 episodes, now 2"), "{refused}");
    assert_eq!(open(&target).expect("opening").episodes().len(), 2);
    let report = convert(&source, &Location::from(&target), &append, &mut Control::new()).expect("appending");
    assert_eq!(report.episodes, 4);
}

#[test]
fn second_writer_of_a_shard_is_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let location = Location::from(folder.path().join("data.lance"));
    let shard = |index| create_shard(&location, &schema(), exclusive(WriteMode::Append), Shard { index, count: 2 });
    let _first = shard(0).expect("creating");
    let error = shard(0).err().expect("a second writer").to_string();
    assert!(error.contains("another process writes"), "{error}");
    shard(1).expect("another shard");
}
