//! A dataset to replace stays until an episode is ready to be written in its place.

use crate::fuzz::files;
use crate::replacing::names;
use crate::sample::{check, episode, options, schema, write};
use std::os::unix::fs::symlink;
use swm_core::run::Control;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::{ConvertMode, ConvertOptions, FORMATS, Location, WriteMode, convert, create, open};

#[test]
fn refused_first_episodes_keep_the_old_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "h5", "lerobot"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        let mut without_action = episode(5);
        without_action.get_mut::<f32>("action").expect("the actions")[0] = f32::NAN;
        let mut writer = create(&path, &schema(), options(WriteMode::Overwrite)).expect("replacing");
        writer.write_episode(&without_action).expect_err("a missing action");
        writer.pause().expect("nothing is written");
        let reader = open(&path).expect("opening");
        assert_eq!(reader.episodes().len(), 3, "{format}");
        check(&*reader, 0);

        // The same writer can store the next episode.
        let mut writer = create(&path, &schema(), options(WriteMode::Overwrite)).expect("replacing");
        writer.write_episode(&without_action).expect_err("a missing action");
        writer.write_episode(&episode(7)).expect("writing an episode");
        assert_eq!(writer.episodes(), 1, "{format}");
        writer.finish().expect("finishing");
        let reader = open(&path).expect("opening");
        assert_eq!(reader.episodes().len(), 1, "{format}");
        check(&*reader, 7);
    }
}

#[test]
fn values_that_lance_cannot_store_keep_the_old_table() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("data.lance");
    write(&path, WriteMode::Create, 1, 0..3);
    let schema = Schema::new([ColumnSpec::new("count", DType::Int64, [])]).expect("creating the schema");
    let mut rows = Batch::zeros(&schema, 2);
    rows.get_mut::<i64>("count").expect("the column")[1] = (1 << 24) + 1;
    let mut writer = create(&path, &schema, options(WriteMode::Overwrite)).expect("replacing");
    writer.write_episode(&rows).expect_err("an integer beyond float32");
    drop(writer);
    check(&*open(&path).expect("opening"), 0);
}

#[test]
fn refused_first_episode_keeps_the_old_shard() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("data.lance");
    let location = Location::from(&path);
    let writer = |mode| create_shard(&location, &schema(), options(mode), Shard { index: 0, count: 1 });
    let mut first = writer(WriteMode::Create).expect("creating the shard");
    (0..3).for_each(|e| first.write_episode(&episode(e)).expect("writing an episode"));
    first.finish().expect("finishing the shard");
    let mut without_action = episode(5);
    without_action.get_mut::<f32>("action").expect("the actions")[0] = f32::NAN;
    let mut second = writer(WriteMode::Overwrite).expect("replacing the shard");
    second.write_episode(&without_action).expect_err("a missing action");
    second.pause().expect("nothing is written");
    assert_eq!(commit_shards(&location).expect("committing the shard"), 3);
    check(&*open(&path).expect("opening"), 0);
}

#[test]
fn finished_writer_without_episodes_replaces_the_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "folder", "h5"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        create(&path, &schema(), options(WriteMode::Overwrite)).and_then(|writer| writer.finish()).expect("replacing");
        assert!(open(&path).expect("opening").episodes().is_empty(), "{format}");
    }
}

#[test]
fn interrupted_replacements_are_undone_before_a_target_is_read() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let source = folder.path().join("source.lance");
    write(&source, WriteMode::Create, 1, 3..4);
    for (format, aside) in [("folder", "ep_len.replaced"), ("video", "ep_len.replaced"), ("lerobot", "meta/replaced")] {
        // A name without a suffix, so that the format is recognised by the files.
        for name in [format!("d.{format}"), format!("d-{format}")] {
            let (path, kept) = (folder.path().join(&name), folder.path().join("kept"));
            let entry = FORMATS.get(format).expect("the format");
            let mut writer =
                entry.create(&Location::from(&path), &schema(), options(WriteMode::Create)).expect("creating");
            (0..3).for_each(|e| writer.write_episode(&episode(e)).expect("writing an episode"));
            writer.finish().expect("finishing");
            // As a kill leaves it before the first commit of the new dataset.
            std::fs::rename(&path, &kept).expect("moving the dataset");
            std::fs::create_dir_all(path.join(aside).parent().expect("a folder")).expect("creating a folder");
            std::fs::rename(&kept, path.join(aside)).expect("moving the dataset");
            let error = open(&path).err().expect("nothing to read").to_string();
            assert!(error.contains("its old files are in"), "{name}: {error}");
            let options = ConvertOptions { mode: ConvertMode::Append, ..ConvertOptions::default() };
            convert(&open(&source).expect("the source"), &Location::from(&path), &options, &mut Control::new())
                .expect("appending");
            let reader = open(&path).expect("opening");
            assert_eq!((reader.episodes().len(), path.join(aside).exists()), (4, false), "{name}");
            check(&*reader, 0);
        }
    }
}

#[test]
fn datasets_whose_files_are_being_set_aside_are_not_read() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let cases = [
        ("folder", "pixels/ep_2_step_0.jpeg", "ep_len.replaced"),
        ("video", "pixels/ep_2.mp4", "ep_len.replaced"),
        ("lerobot", "meta/stats.json", "meta/replaced"),
    ];
    for (format, name, aside) in cases {
        let path = folder.path().join(format!("d.{format}"));
        write(&path, WriteMode::Create, 1, 0..3);
        // As a kill leaves it before the metadata is moved.
        let moved = path.join(aside).join(name);
        std::fs::create_dir_all(moved.parent().expect("a folder")).expect("creating a folder");
        std::fs::rename(path.join(name), &moved).expect("moving a file");
        let error = open(&path).err().expect("a part of a dataset").to_string();
        assert!(error.contains("its old files are in"), "{format}: {error}");
        write(&path, WriteMode::Append, 1, 3..4);
        let reader = open(&path).expect("opening");
        assert_eq!((reader.episodes().len(), path.join(aside).exists()), (4, false), "{format}");
        check(&*reader, 0);
    }
}

#[test]
fn files_set_aside_by_a_stranger_are_not_moved_through_links() {
    for (format, aside, column) in [
        ("folder", "ep_len.replaced", "pixels"),
        ("video", "ep_len.replaced", "pixels"),
        ("lerobot", "meta/replaced", "data"),
    ] {
        let folder = tempfile::tempdir().expect("creating a folder");
        let (path, outside) = (folder.path().join(format!("d.{format}")), folder.path().join("outside"));
        write(&path, WriteMode::Create, 1, 0..2);
        std::fs::create_dir_all(&outside).expect("creating a folder");
        std::fs::rename(path.join(column), path.join("moved")).expect("moving a folder");
        symlink(&outside, path.join(column)).expect("making a link");
        let key = path.join(aside).join(column).join("authorized_keys");
        std::fs::create_dir_all(key.parent().expect("a folder")).expect("creating a folder");
        std::fs::write(&key, "a key").expect("writing a file");
        for mode in [WriteMode::Append, WriteMode::Overwrite, WriteMode::Create] {
            let error = create(&path, &schema(), options(mode)).err().expect("a link").to_string();
            assert!(error.contains("symbolic link"), "{format}: {error}");
            assert!(key.exists() && names(&outside).is_empty(), "{format}");
        }
    }
}

#[test]
fn removal_of_a_table_takes_what_a_kill_leaves() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.lance");
    let orphan = format!("data/{}.lance", blake3::hash(b"written before a kill").to_hex());
    let other = format!("data/{}.lance", blake3::hash(b"something else").to_hex());
    let staged = format!("{other}#1");
    let temporary = [staged.as_str(), "_versions/18446744073709551614.manifest#12", "_versions/.tmpa1B2c3"];
    let of_user = ["_versions/.tmp-notes", "_versions/thesis.manifest#1", other.as_str(), "data/thesis.lance#1"];
    // Without a version, as a kill before the first commit leaves it, and with one.
    for is_committed in [false, true] {
        if is_committed {
            write(&path, WriteMode::Create, 1, 0..2);
        }
        for name in ["data", "_versions"] {
            std::fs::create_dir_all(path.join(name)).expect("creating a folder");
        }
        for name in temporary.into_iter().chain(of_user).chain([orphan.as_str()]) {
            std::fs::write(path.join(name), "written before a kill").expect("writing a file");
        }
        FORMATS.get("lance").expect("the format").remove(&path).expect("removing the dataset");
        let expected = of_user.map(|name| path.join(name));
        assert_eq!(files(&path), expected, "{is_committed}");
    }
}
