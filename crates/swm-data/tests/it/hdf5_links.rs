//! HDF5 files with soft links and links to other files (`tests/interop/hdf5_links.py`).

use crate::fuzz;
use crate::video::interop;
use swm_data::{StepRange, WriteMode, WriteOptions, create, open};

fn rows() -> Vec<StepRange> {
    (0..3).map(|episode| StepRange::new(episode, 0, 4)).collect()
}

#[test]
fn datasets_beside_links_are_read() {
    let expected: Vec<f32> = (0..12_u8).map(f32::from).collect();
    for (file, columns) in [("hdf5-links.h5", &["hard alias", "state"][..]), ("hdf5-external-links.h5", &["state"])] {
        let reader = open(interop().join(file)).expect("opening the dataset");
        let names: Vec<&str> = reader.schema().columns()[2..].iter().map(|column| &*column.name).collect();
        assert_eq!(names, columns, "{file}");
        for name in names {
            let read = reader.read(&[name], &rows()).expect("reading rows");
            assert_eq!(read.to_f32(name).expect("numbers"), expected, "{file}, {name}");
        }
    }
    let reader = open(interop().join("hdf5-links.h5")).expect("opening the dataset");
    let links = ["alias", "inner", "shortcut", "zzz nothing"].map(|name| format!("{name} (a soft link)"));
    assert_eq!(reader.unread(), [links.to_vec(), vec!["a group/".to_owned()]].concat());
}

#[test]
fn needed_columns_behind_links_are_named() {
    let error = open(interop().join("hdf5-linked-column.h5")).err().expect("an error").to_string();
    assert!(error.contains("'ep_len' is a soft link, which is not followed"), "{error}");
    assert!(error.contains("hdf5-linked-column.h5") && error.contains("h5py"), "{error}");
    let error = open(interop().join("hdf5-external-column.h5")).err().expect("an error").to_string();
    assert!(error.contains("no list of integers 'ep_len'") && error.contains("links are not followed"), "{error}");
}

#[test]
fn writers_do_not_drop_links() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.h5");
    std::fs::copy(interop().join("hdf5-links.h5"), &path).expect("copying a file");
    let before = std::fs::read(&path).expect("the file");
    let columns = open(&path).expect("opening the dataset").schema().columns()[2..].to_vec();
    let schema = swm_core::Schema::new(columns).expect("a schema");
    let options = WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() };
    let error = create(&path, &schema, options).err().expect("links would be lost").to_string();
    assert!(error.contains("'alias (a soft link)'") && error.contains("appending would lose it"), "{error}");
    assert_eq!(std::fs::read(&path).expect("the file"), before);
}

#[test]
fn damaged_files_with_links_are_refused_or_read() {
    // The tables of names fill a third of the file.
    let report = fuzz::dataset("hdf5-links.h5", &interop().join("hdf5-links.h5"), 400, fuzz::read_everything);
    assert!(report.refused > 20, "{report:?}");
}

#[test]
fn names_with_any_number_of_paths_are_refused() {
    let mut bytes = std::fs::read(interop().join("hdf5-links.h5")).expect("the file");
    let first = bytes.len() as u64;
    // Each node has the node below it twice: 2^60 paths.
    for level in 0..60_u8 {
        let below = first + 64 * u64::from(level.saturating_sub(1));
        bytes.extend(b"TREE\0");
        bytes.extend([level, if level == 0 { 0 } else { 2 }, 0]);
        bytes.extend([u64::MAX, u64::MAX, 0, below, 0, below, 0].map(u64::to_le_bytes).concat());
    }
    // The address of the table in the root's entry of the superblock.
    bytes[80..88].copy_from_slice(&(first + 64 * 59).to_le_bytes());
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.h5");
    std::fs::write(&path, bytes).expect("writing the file");
    let error = open(&path).err().expect("an error").to_string();
    assert!(error.contains("listing its datasets"), "{error}");
}
