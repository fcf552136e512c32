//! Opening what is left of a table some of whose data files are damaged or gone.

use super::reader::{self, LanceReader};
use super::store::Store;
use crate::dataset::Location;
use crate::dataset::Reader;
use lance_table::format::{Fragment, Manifest as Table};
use std::sync::Arc;
use swm_core::Result;

/// A table without the fragments that cannot be opened, and what was lost with each of them.
///
/// # Errors
/// When there is no table, or nothing of it can be opened.
pub fn salvage(location: &Location) -> Result<(Arc<dyn Reader>, Vec<String>)> {
    let store = Store::new(location)?;
    let Some(version) = store.latest()? else { return Ok((reader::open(location)?, vec![])) };
    let (mut kept, mut lost) = (vec![], vec![]);
    for fragment in version.manifest.fragments.iter() {
        match LanceReader::of(store.clone(), only(&version.manifest, vec![fragment.clone()])) {
            Ok(_) => kept.push(fragment.clone()),
            Err(error) => {
                let rows = fragment.physical_rows.unwrap_or_default();
                lost.push(format!("{rows} rows of fragment {} are lost: {error}", fragment.id));
            }
        }
    }
    Ok((Arc::new(LanceReader::of(store, only(&version.manifest, kept))?), lost))
}

/// The table with these of its fragments.
fn only(table: &Table, fragments: Vec<Fragment>) -> Arc<Table> {
    let mut table = table.clone();
    table.fragments = Arc::new(fragments);
    Arc::new(table)
}
