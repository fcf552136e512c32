//! Tests of tables whose manifest a stranger made.

use super::LanceReader;
use crate::dataset::Location;
use crate::formats::lance::store::Store;
use crate::formats::lance::writer;
use crate::{Reader as _, WriteOptions};
use lance_table::format::Fragment;
use std::sync::Arc;
use swm_core::{Batch, ColumnSpec, DType, Schema};

/// Opens a table of two rows after a change of its only fragment; returns the error.
fn error(change: impl FnOnce(&mut Fragment)) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    let location = Location::from(folder.path().join("d.lance"));
    let schema = Schema::new([ColumnSpec::new("state", DType::Float32, [2])]).expect("a schema");
    let mut table = writer::create(&location, &schema, WriteOptions::default()).expect("a writer");
    table.write_episode(&Batch::zeros(&schema, 2)).expect("an episode");
    table.finish().expect("a table");
    let store = Store::new(&location).expect("a store");
    let mut manifest = (*store.latest().expect("a version").expect("a table").manifest).clone();
    let mut fragments = manifest.fragments.to_vec();
    assert_eq!(fragments.len(), 1);
    change(&mut fragments[0]);
    manifest.fragments = Arc::new(fragments);
    let opened = LanceReader::of(store, Arc::new(manifest));
    opened.map(|reader| reader.episodes().len()).expect_err("a hostile table").to_string()
}

#[test]
fn row_counts_beyond_the_data_files_allocate_no_memory() {
    for rows in [3, 1 << 31, 1 << 60, usize::MAX] {
        let error = error(|fragment| fragment.physical_rows = Some(rows));
        assert!(error.contains("d.lance"), "{rows}: {error}");
    }
}

#[test]
fn shallow_clone_is_not_called_damaged() {
    let error = error(|fragment| fragment.files[0].base_id = Some(1));
    assert!(error.contains("is a shallow clone") && !error.contains("damaged"), "{error}");
}
