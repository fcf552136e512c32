//! Deletes a table on this machine, and nothing else in its folder; recognises the rest of one that was never committed.

use super::ENTRY;
use super::store::{FOLDERS, Store, hash_file, is_version};
use crate::dataset::Location;
use std::ffi::OsString;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// Deletes a table: the data files of its newest version first, those of no version and temporary files, which a kill leaves,
/// then its versions. Nothing is moved. A data file of no version is recognised by its name, which is the hash of its content.
///
/// # Errors
/// If the newest version cannot be read, another process writes to the table, a file is a symbolic link, or a file cannot
/// be deleted.
pub fn remove(path: &Path) -> Result<()> {
    let store = Store::new(&Location::from(path))?;
    let _lock = store.lock("")?;
    let newest = store.latest()?;
    store.check_no_links()?;
    let fragments = newest.iter().flat_map(|version| version.manifest.fragments.iter());
    let data = fragments.flat_map(|fragment| &fragment.files);
    let mut names: Vec<PathBuf> = data.map(|file| Path::new("data").join(&file.path)).collect();
    let unnamed: Vec<PathBuf> = regular_files(path, "data")?.into_iter().filter(|name| !names.contains(name)).collect();
    for name in unnamed {
        let stem = name.file_stem().and_then(|stem| stem.to_str()).unwrap_or_default();
        // The hash of other files is not computed.
        let is_hash = stem.len() == 64 && name.extension().is_some_and(|suffix| suffix == "lance");
        let io = |e| Error::io(path.join(&name), "hashing a data file", e);
        if is_hash && hash_file(&path.join(&name)).map_err(io)? == stem {
            names.push(name);
        }
    }
    for folder in ["data", "_versions"] {
        names.extend(regular_files(path, folder)?.into_iter().filter(|name| is_temporary(name)));
    }
    if newest.is_some() {
        names.push("_versions/latest_version_hint.json".into());
        let is_version = |name: &PathBuf| name.file_name().and_then(|name| name.to_str()).is_some_and(is_version);
        names.extend(regular_files(path, "_versions")?.into_iter().filter(is_version));
    }
    files::delete_named(path, &names)?;
    FOLDERS.iter().try_for_each(|name| files::remove_empty_folder(&path.join(name)))
}

/// Whether a path below a table is that of a temporary file, as a writer leaves it that was killed. The object store writes
/// `NAME#1` before `NAME`, for data files and versions; Lance writes `.tmp` and six more characters before the number of the
/// newest version.
fn is_temporary(name: &Path) -> bool {
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let in_versions = name.starts_with("_versions");
    let Some(name) = name.file_name().and_then(|name| name.to_str()) else { return false };
    match (name.split_once('#'), name.strip_prefix(".tmp")) {
        (Some((written, number)), _) if is_number(number) => {
            if in_versions {
                is_version(written)
            } else {
                is_data_file(written)
            }
        }
        (None, Some(rest)) => in_versions && rest.len() == 6 && rest.bytes().all(|byte| byte.is_ascii_alphanumeric()),
        _ => false,
    }
}

/// Whether a name is that of a data file: the hash of its content.
fn is_data_file(name: &str) -> bool {
    name.strip_suffix(".lance")
        .is_some_and(|hash| hash.len() == 64 && hash.bytes().all(|byte| byte.is_ascii_hexdigit()))
}

/// The regular files in a folder of a table, as paths below the table; none if the folder does not exist.
fn regular_files(table: &Path, folder: &str) -> Result<Vec<PathBuf>> {
    let io = |e| Error::io(table.join(folder), "listing a folder of the table", e);
    let entries = match std::fs::read_dir(table.join(folder)) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(vec![]),
        entries => entries.map_err(io)?,
    };
    let mut names = vec![];
    for entry in entries {
        let entry = entry.map_err(io)?;
        if entry.file_type().map_err(io)?.is_file() {
            names.push(Path::new(folder).join(entry.file_name()));
        }
    }
    Ok(names)
}

/// Whether a folder with the suffix of a table holds only what a writer leaves that was killed, or whose disk was full, before
/// its first commit: data files, named by the hash of their content, and no version but a temporary one. The logs of shards are no such rest.
pub fn is_unfinished(folder: &Path) -> bool {
    let names = |folder: &Path| -> std::io::Result<Vec<OsString>> {
        std::fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name())).collect()
    };
    // Hidden files and temporary files of the object store begin like the file that they become.
    let is_data = |name: &OsString| {
        name.to_str().is_some_and(|name| {
            name.len() > 64 && name.is_char_boundary(64) && {
                let (hash, rest) = name.split_at(64);
                hash.bytes().all(|byte| byte.is_ascii_hexdigit()) && rest.starts_with(".lance")
            }
        })
    };
    let is_first = |name: &OsString| is_temporary(&Path::new("_versions").join(name));
    let holds_only_data = || -> std::io::Result<bool> {
        Ok(names(folder)?.iter().all(|name| name == "data" || name == "_versions")
            && (!folder.join("_versions").exists() || names(&folder.join("_versions"))?.iter().all(is_first))
            && (!folder.join("data").exists() || names(&folder.join("data"))?.iter().all(is_data)))
    };
    ENTRY.has_suffix(&Location::from(folder)) && folder.is_dir() && holds_only_data().unwrap_or(false)
}
