//! What a writer leaves that was killed, or whose disk was full, before its first commit is continued and replaced; files of the user
//! are not.

use crate::sample::{check, options, schema, write};
use std::path::Path;
use swm_data::{WriteMode, create, has_no_dataset, open};

/// Writes a file, and the folders that it is in.
fn put(path: &Path, content: &[u8]) {
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("creating a folder");
    std::fs::write(path, content).expect("writing a file");
}

/// The first rows of no episodes, as a writer leaves them whose disk is full at the next file.
fn no_rows(folder: &Path) -> Vec<u8> {
    let path = folder.join("empty.folder");
    if !path.exists() {
        drop(create(&path, &schema(), options(WriteMode::Create)).expect("a dataset without episodes"));
    }
    std::fs::read(path.join("ep_offset.npz")).expect("the first rows")
}

/// A format, and files with their contents.
type Left<'a> = (&'a str, &'a [(&'a str, &'a [u8])]);

#[test]
fn first_files_of_killed_writers_are_continued_and_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let no_rows = no_rows(folder.path());
    let left: [Left<'_>; 7] = [
        ("folder", &[("ep_offset.npz", &no_rows)]),
        ("video", &[("ep_offset.npz", &no_rows), ("ep_len.tmp", b"PK")]),
        ("lerobot", &[("meta/info.json.tmp", b"")]),
        ("lerobot", &[("meta/info.json.tmp", b"{\"codebase_version\": \"v3")]),
        ("lance-video", &[("steps.lance/_versions/18446744073709551614.manifest#1", b"")]),
        ("lance-video", &[]),
        ("lerobot", &[]),
    ];
    for (index, (format, files)) in left.into_iter().enumerate() {
        for mode in [WriteMode::Append, WriteMode::Overwrite, WriteMode::Create] {
            let path = folder.path().join(format!("{mode:?}-{index}.{format}"));
            let empty = ["meta", "steps.lance"][usize::from(format == "lance-video")];
            std::fs::create_dir_all(if files.is_empty() { path.join(empty) } else { path.clone() }).expect("a folder");
            files.iter().for_each(|(name, content)| put(&path.join(name), content));
            assert!(has_no_dataset(&path), "{}", path.display());
            write(&path, mode, 1, 0..2);
            check(&*open(&path).expect("opening"), 0);
            assert!(!path.join("meta/info.json.tmp").exists());
        }
    }
}

#[test]
#[cfg(feature = "hdf5")]
fn hdf5_files_that_are_being_created_are_called_so() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("d.h5");
    write(&path, WriteMode::Create, 1, 0..2);
    let whole = std::fs::read(&path).expect("the file");
    // The signature is written last when a file is created.
    let begun = [&[0; 8], &whole[8..16]].concat();
    for content in [&[][..], &begun] {
        put(&path, content);
        let error = open(&path).err().expect("a file without a signature").to_string();
        assert!(error.contains("is being created") && error.contains("open it again in a moment"), "{error}");
    }
    put(&path, &whole);
    check(&*open(&path).expect("opening"), 0);
    put(&path, b"thesis, which is no HDF5 file");
    let error = open(&path).err().expect("a file of another program").to_string();
    assert!(!error.contains("being created"), "{error}");
}

#[test]
fn files_of_the_user_with_such_names_stay() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let no_rows = no_rows(folder.path());
    let own: [Left<'_>; 5] = [
        ("folder", &[("ep_offset.npz", b"thesis")]),
        ("video", &[("ep_offset.npz", &no_rows), ("thesis.txt", b"thesis")]),
        ("lerobot", &[("meta/info.json.tmp", b"thesis")]),
        ("lerobot", &[("meta/info.json.tmp", b"{"), ("meta/thesis.txt", b"thesis")]),
        ("lerobot", &[("meta/info.json.tmp", b"{"), ("thesis.txt", b"thesis")]),
    ];
    for (index, (format, files)) in own.into_iter().enumerate() {
        let path = folder.path().join(format!("own-{index}.{format}"));
        files.iter().for_each(|(name, content)| put(&path.join(name), content));
        assert!(!has_no_dataset(&path), "{}", path.display());
        for mode in [WriteMode::Append, WriteMode::Overwrite, WriteMode::Create] {
            let error = create(&path, &schema(), options(mode)).err().expect("a refusal").to_string();
            assert!(error.contains("holds other files"), "{error}");
        }
        files.iter().for_each(|(name, content)| assert_eq!(std::fs::read(path.join(name)).expect("a file"), *content));
    }
}
