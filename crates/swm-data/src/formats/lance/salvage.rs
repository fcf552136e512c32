//! Opens the readable part of a table with damaged or missing data files.

use super::reader::{self, LanceReader};
use super::store::Store;
use crate::dataset::Location;
use crate::dataset::Reader;
use lance_table::format::{Fragment, Manifest as Table};
use std::sync::Arc;
use swm_core::Result;

/// The table without unreadable fragments, and a description of each loss.
///
/// # Errors
/// If there is no table, or no fragment can be read.
pub fn salvage(location: &Location) -> Result<(Arc<dyn Reader>, Vec<String>)> {
    let store = Store::new(location)?;
    let Some(version) = store.latest()? else { return Ok((reader::open(location)?, vec![])) };
    let (mut readable, mut lost) = (vec![], vec![]);
    for fragment in version.manifest.fragments.iter() {
        match LanceReader::of(store.clone(), restricted_to(&version.manifest, vec![fragment.clone()])) {
            Ok(_) => readable.push(fragment.clone()),
            Err(error) => {
                let rows = fragment.physical_rows.unwrap_or_default();
                lost.push(format!("{rows} rows of fragment {} are lost: {error}", fragment.id));
            }
        }
    }
    Ok((Arc::new(LanceReader::of(store, restricted_to(&version.manifest, readable))?), lost))
}

/// The table restricted to `fragments`.
fn restricted_to(table: &Table, fragments: Vec<Fragment>) -> Arc<Table> {
    let mut table = table.clone();
    table.fragments = Arc::new(fragments);
    Arc::new(table)
}
