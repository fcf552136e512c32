//! Replacing a dataset deletes the dataset's own files only.

use crate::sample::{check, options, schema, write};
use std::path::Path;
use swm_data::{WriteMode, WriteOptions, create, open};

fn overwrite(path: &Path) -> Option<swm_core::Error> {
    create(path, &schema(), WriteOptions { exclusive: true, ..options(WriteMode::Overwrite) }).err()
}

#[test]
fn files_of_another_kind_are_not_replaced() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let text = b"a thesis, not a dataset";
    // The second file begins like an HDF5 file whose creation was killed.
    for (name, content) in
        [("thesis.h5", &text[..]), ("zeros.h5", &[0; 100]), ("thesis.lance", text), ("a.folder", text)]
    {
        let path = folder.path().join(name);
        std::fs::write(&path, content).expect("writing a file");
        for mode in [WriteMode::Overwrite, WriteMode::Append, WriteMode::Create] {
            assert!(create(&path, &schema(), options(mode)).is_err(), "{name}");
            assert_eq!(std::fs::read(&path).expect("the file"), content, "{name}");
        }
    }
    for name in ["a.lance", "b.folder", "c.video", "d.lerobot"] {
        let file = folder.path().join(name).join("meta/info.json");
        std::fs::create_dir_all(file.parent().expect("a folder")).expect("creating a folder");
        std::fs::write(&file, text).expect("writing a file");
        assert!(overwrite(file.parent().and_then(Path::parent).expect("a folder")).is_some(), "{name}");
        assert_eq!(std::fs::read(&file).expect("the file"), text, "{name}");
    }
}

#[test]
fn other_files_in_the_folder_of_a_dataset_stay() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "folder", "video", "lerobot"] {
        let path = folder.path().join(format!("data.{format}"));
        write(&path, WriteMode::Create, 1, 0..2);
        let notes: Vec<_> =
            ["thesis.txt", "notes/deep/a.txt", "pixels/ep_notes.txt"].map(|name| path.join(name)).into();
        for file in &notes {
            std::fs::create_dir_all(file.parent().expect("a folder")).expect("creating a folder");
            std::fs::write(file, "notes").expect("writing a file");
        }
        write(&path, WriteMode::Overwrite, 1, 0..1);
        for file in &notes {
            assert_eq!(std::fs::read_to_string(file).expect("the file"), "notes", "{format}");
        }
        let reader = open(&path).expect("opening");
        assert_eq!(reader.episodes().len(), 1);
        check(&*reader, 0);
    }
    assert_eq!(folder.path().read_dir().expect("listing").count(), 5, "no folder of a replaced dataset remains");
}
