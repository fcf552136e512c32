//! Deletes a table on this machine, and nothing else in its folder.

use super::store::{FOLDERS, Store, is_version};
use crate::dataset::Location;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// Deletes a table: the data files of its newest version first, then its versions. Nothing is moved.
///
/// # Errors
/// If the newest version cannot be read, another process writes to the table, a file is a symbolic link, or a file cannot
/// be deleted.
pub fn remove(path: &Path) -> Result<()> {
    let store = Store::new(&Location::from(path))?;
    let _lock = store.lock("")?;
    let Some(newest) = store.latest()? else { return Ok(()) };
    let data = newest.manifest.fragments.iter().flat_map(|fragment| &fragment.files);
    let mut names: Vec<PathBuf> = data.map(|file| Path::new("data").join(&file.path)).collect();
    let io = |e| Error::io(path, "listing the versions", e);
    names.push("_versions/latest_version_hint.json".into());
    for entry in std::fs::read_dir(path.join("_versions")).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        if name.to_str().is_some_and(is_version) {
            names.push(Path::new("_versions").join(name));
        }
    }
    files::delete_named(path, &names)?;
    FOLDERS.iter().try_for_each(|name| files::remove_empty_folder(&path.join(name)))
}
