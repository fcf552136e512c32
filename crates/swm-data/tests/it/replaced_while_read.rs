//! A reader of a dataset that another process replaces never returns rows of both.

use crate::fuzz::copy_all;
use crate::sample::{check, episode, write};
use swm_data::{Reader, StepRange, WriteMode, open};

/// The formats whose readers open files by name when they are needed.
const FORMATS: [&str; 3] = ["folder", "video", "lerobot"];

/// Reads the first rows of a column of episode 0.
fn first_rows(reader: &dyn Reader, column: &str) -> swm_core::Result<Vec<u8>> {
    let batch = reader.read(&[column], &[StepRange::new(0, 0, 3)])?;
    Ok(batch.bytes(0).to_vec())
}

#[test]
fn columns_and_images_of_another_dataset_are_refused() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FORMATS {
        let path = folder.path().join(format!("d.{format}"));
        // Episodes 7 to 12 have the lengths of episodes 0 to 5.
        write(&path, WriteMode::Create, 3, 0..6);
        for first in [7, 0] {
            let reader = open(&path).expect("opening the dataset");
            first_rows(&*reader, "state").expect("a column");
            write(&path, WriteMode::Overwrite, 3, first..first + 6);
            for column in ["action", "pixels"] {
                let error = first_rows(&*reader, column).expect_err(format).to_string();
                assert!(error.contains("replaced") && error.contains("open the dataset again"), "{format}: {error}");
            }
            check(&*open(&path).expect("opening the new dataset"), first);
        }
    }
}

#[test]
fn files_that_are_copied_over_the_dataset_are_another_one() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FORMATS {
        let (path, other) = (folder.path().join(format!("a.{format}")), folder.path().join(format!("b.{format}")));
        write(&path, WriteMode::Create, 3, 0..6);
        write(&other, WriteMode::Create, 3, 7..13);
        let reader = open(&path).expect("opening the dataset");
        first_rows(&*reader, "state").expect("a column");
        copy_all(&other, &path);
        let error = first_rows(&*reader, "action").expect_err(format).to_string();
        assert!(error.contains("replaced"), "{format}: {error}");
    }
}

#[test]
fn a_dataset_in_a_new_folder_is_another_one() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FORMATS {
        let path = folder.path().join(format!("d.{format}"));
        write(&path, WriteMode::Create, 3, 0..6);
        let reader = open(&path).expect("opening the dataset");
        first_rows(&*reader, "state").expect("a column");
        std::fs::rename(&path, folder.path().join(format!("old.{format}"))).expect("moving the dataset");
        write(&path, WriteMode::Create, 3, 7..13);
        let error = first_rows(&*reader, "action").expect_err(format).to_string();
        assert!(error.contains("replaced"), "{format}: {error}");
    }
}

#[test]
fn a_reader_of_a_dataset_that_grows_reads_on() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in FORMATS {
        let path = folder.path().join(format!("d.{format}"));
        write(&path, WriteMode::Create, 3, 0..6);
        write(&path, WriteMode::Overwrite, 3, 0..6);
        let reader = open(&path).expect("opening the dataset");
        first_rows(&*reader, "state").expect("a column");
        write(&path, WriteMode::Append, 3, 6..9);
        assert_eq!(first_rows(&*reader, "action").expect("a column"), episode(0).bytes(1)[..24], "{format}");
        check(&*reader, 0);
        assert_eq!(reader.episodes().len(), 6, "{format}");
        // Appended datasets remember that they were replaced.
        let grown = open(&path).expect("opening the dataset");
        write(&path, WriteMode::Overwrite, 3, 0..9);
        assert!(first_rows(&*grown, "action").is_err(), "{format}");
    }
}
