//! A reader of a dataset that another process replaces never returns rows of both.

use crate::fuzz::copy_all;
use crate::sample::{check, episode, manifest, options, schema, write};
use swm_data::{Mark, Reader, StepRange, WriteMode, WriteOptions, create, open};

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

/// A collection that is continued changes the manifest.
#[test]
fn a_reader_that_has_read_nothing_reads_on_when_the_dataset_grows() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "h5", "folder", "video", "lerobot"] {
        let path = folder.path().join(format!("d.{format}"));
        write(&path, WriteMode::Create, 3, 0..6);
        let readers = [(); 2].map(|()| open(&path).expect("opening the dataset"));
        first_rows(&*readers[1], "pixels").expect("a column");
        let grown = WriteOptions { manifest: Some(manifest(4)), ..options(WriteMode::Append) };
        let mut writer = create(&path, &schema(), grown).expect("continuing");
        (6..150).for_each(|e| writer.write_episode(&episode(e)).expect("writing"));
        writer.finish().expect("finishing");
        for reader in &readers {
            check(&**reader, 0);
            assert_eq!(reader.episodes().len(), 6, "{format}");
        }
    }
}

/// Makes a file look as if it was written a minute later: the clock of a file system may be coarser than a test is fast.
fn touch_later(path: &std::path::Path) {
    let file = std::fs::File::options().write(true).open(path).expect("opening the file");
    let time = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
    file.set_modified(time).expect("setting the time of the file");
}

#[test]
fn an_hdf5_file_that_is_written_over_in_place_is_another_dataset() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let (path, other) = (folder.path().join("a.h5"), folder.path().join("b.h5"));
    write(&path, WriteMode::Create, 3, 0..6);
    write(&other, WriteMode::Create, 3, 7..13);
    let reader = open(&path).expect("opening the dataset");
    first_rows(&*reader, "state").expect("a column");
    // Keeps the file and changes its content, as `cp` does.
    std::fs::copy(&other, &path).expect("copying the file");
    touch_later(&path);
    for column in ["action", "state"] {
        let error = first_rows(&*reader, column).expect_err("rows of another dataset").to_string();
        assert!(error.contains("written over") && error.contains("open the dataset again"), "{column}: {error}");
    }
    check(&*open(&path).expect("opening the new dataset"), 7);
}

#[test]
fn a_reader_of_an_hdf5_file_that_grows_reads_on() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("a.h5");
    write(&path, WriteMode::Create, 3, 0..6);
    let reader = open(&path).expect("opening the dataset");
    first_rows(&*reader, "state").expect("a column");
    write(&path, WriteMode::Append, 3, 6..9);
    touch_later(&path);
    check(&*reader, 0);
    assert_eq!(reader.episodes().len(), 6);
    // A replaced file stays open as it was.
    write(&path, WriteMode::Overwrite, 3, 7..13);
    check(&*reader, 0);
}

#[test]
fn an_hdf5_file_of_another_program_that_is_written_to_is_read_no_more() {
    let folder = tempfile::tempdir().expect("creating a folder");
    let path = folder.path().join("a.h5");
    let third_party = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop/hdf5-unwritten.h5");
    std::fs::copy(third_party, &path).expect("copying the file");
    let reader = open(&path).expect("opening the dataset");
    let column = reader.schema().columns()[2].name.clone();
    let row = [StepRange::new(0, 0, 1)];
    reader.read(&[&column], &row).expect("a row");
    touch_later(&path);
    let error = reader.read(&[&column], &row).expect_err("rows that may be others").to_string();
    assert!(error.contains("written over"), "{error}");
}

#[test]
fn a_dataset_that_is_opened_again_must_be_the_one_of_its_mark() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for format in ["lance", "lance-video", "h5", "folder", "video", "lerobot"] {
        let path = folder.path().join(format!("d.{format}"));
        write(&path, WriteMode::Create, 3, 0..6);
        let mark = Mark::of(&*open(&path).expect("opening the dataset")).expect("a mark");
        let text = serde_json::to_string(&mark).expect("a mark as JSON");
        let mark: Mark = serde_json::from_str(&text).expect("a mark from JSON");
        let check = || mark.check(&*open(&path).expect("opening the dataset"));
        check().expect("the same dataset");
        write(&path, WriteMode::Append, 3, 6..9);
        check().expect("a dataset that has grown");
        // An episode between the first and the last is another one of the same length.
        write(&path, WriteMode::Overwrite, 1, 0..3);
        write(&path, WriteMode::Append, 1, 10..11);
        write(&path, WriteMode::Append, 1, 4..6);
        let error = check().expect_err(format).to_string();
        assert!(error.contains("replaced"), "{format}: {error}");
        // Episodes 7 to 12 have the lengths of episodes 0 to 5; in episodes 0 to 4 one is missing.
        for others in [7..13, 0..5, 7..20] {
            write(&path, WriteMode::Overwrite, 3, others);
            let error = check().expect_err(format).to_string();
            assert!(error.contains("replaced") && error.contains("open the dataset again"), "{format}: {error}");
        }
    }
}

#[test]
fn rows_of_a_table_that_was_replaced_are_not_called_damaged() {
    let folder = tempfile::tempdir().expect("creating a folder");
    for (format, column) in [("lance", "action"), ("lance-video", "pixels")] {
        let path = folder.path().join(format!("d.{format}"));
        // More data files than a reader keeps open.
        write(&path, WriteMode::Create, 1, 0..40);
        let reader = open(&path).expect("opening the dataset");
        write(&path, WriteMode::Overwrite, 3, 7..13);
        // The files of the first episode may be open.
        let error = reader.read(&[column], &[StepRange::new(3, 0, 1)]).expect_err(format).to_string();
        assert!(error.contains("replaced") && error.contains("open the dataset again"), "{format}: {error}");
    }
    // A file that is missing otherwise is damage.
    let path = folder.path().join("d.lance");
    let data = std::fs::read_dir(path.join("data")).expect("listing the files");
    data.for_each(|file| std::fs::remove_file(file.expect("a file").path()).expect("deleting a file"));
    let error = open(&path).and_then(|reader| first_rows(&*reader, "action")).expect_err("deleted files").to_string();
    assert!(error.contains("missing"), "{error}");
}
