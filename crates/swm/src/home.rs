//! Folders of named datasets and checkpoints: `$STABLEWM_HOME` (default `~/.stable_worldmodel`) with `datasets/`,
//! `checkpoints/` and `weights/`.

use crate::zoo;
use std::iter::once;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{Error, Result};
use swm_data::{FORMATS, Location, Reader};

/// The format of new datasets whose name has no suffix.
const DEFAULT_FORMAT: &str = "lance";

/// Returns the folder of all named datasets, checkpoints and weights.
///
/// # Errors
/// When neither `STABLEWM_HOME` nor `HOME` is set, as of all functions below that read a name.
pub fn home() -> Result<PathBuf> {
    swm_core::home::folder()
}

/// Returns the folder of named datasets.
///
/// # Errors
/// As [`home`].
pub fn datasets() -> Result<PathBuf> {
    Ok(home()?.join("datasets"))
}

/// Returns the folder of named checkpoints.
///
/// # Errors
/// As [`home`].
pub fn checkpoints() -> Result<PathBuf> {
    Ok(home()?.join("checkpoints"))
}

/// Returns the folder of downloaded pretrained weights.
///
/// # Errors
/// As [`home`].
pub fn weights() -> Result<PathBuf> {
    Ok(home()?.join("weights"))
}

/// The file name suffixes of all dataset formats. A named dataset is found without its suffix.
fn suffixes() -> impl Iterator<Item = &'static str> {
    FORMATS.rows.iter().flat_map(|format| format.suffixes).copied()
}

/// Returns the path of a dataset given as a path or as a name in [`datasets`]. If no such dataset exists, the path has
/// the suffix of the default format.
///
/// # Errors
/// As [`home`], if it is a name.
pub fn dataset(given: &str) -> Result<PathBuf> {
    for suffix in once(DEFAULT_FORMAT).chain(suffixes()).chain(once("")) {
        let path = named(given, datasets, suffix)?;
        if path.exists() {
            return Ok(path);
        }
    }
    named(given, datasets, DEFAULT_FORMAT)
}

/// Returns the location of a dataset given as a path, as a URI, or as a name in [`datasets`].
///
/// # Errors
/// When the text is empty, or a URI of an unknown scheme.
pub fn location(given: &str) -> Result<Location> {
    check_name("dataset", given)?;
    if given.contains("://") { Location::parse(given) } else { Ok(dataset(given)?.into()) }
}

/// Returns the path of a checkpoint given as a path, as a name in [`checkpoints`], or as `zoo:NAME`.
///
/// # Errors
/// As [`home`], if it is a name, and when the [zoo](zoo) has no such capsule.
pub fn checkpoint(given: &str) -> Result<PathBuf> {
    match given.strip_prefix(zoo::PREFIX) {
        Some(name) => zoo::find(name),
        None => named(given, checkpoints, ""),
    }
}

/// Returns the path of a checkpoint to write, given as a path or as a name in [`checkpoints`].
///
/// # Errors
/// When the text is empty.
pub fn new_checkpoint(given: &str) -> Result<PathBuf> {
    check_name("checkpoint", given)?;
    named(given, checkpoints, "")
}

/// Opens a dataset given as a path, as a URI, or as a name in [`datasets`].
///
/// # Errors
/// When the dataset does not exist (the message names the closest name), or is damaged.
pub fn open_dataset(given: &str) -> Result<Arc<dyn Reader>> {
    swm_data::open(find_dataset(given)?)
}

/// Returns the location of an existing dataset given as a path, as a URI, or as a name in [`datasets`].
///
/// # Errors
/// When the dataset does not exist; the message names the closest name. The existence of a URI is not checked.
pub fn find_dataset(given: &str) -> Result<Location> {
    let location = location(given)?;
    match location.path() {
        Some(path) if !path.exists() => Err(unknown("dataset", given, path, datasets())),
        _ => Ok(location),
    }
}

/// Returns the folder or the capsule of an existing checkpoint, given as a path, as a name in [`checkpoints`], or as
/// `zoo:NAME`.
///
/// # Errors
/// When the checkpoint does not exist; the message names the closest name.
pub fn find_checkpoint(given: &str) -> Result<PathBuf> {
    check_name("checkpoint", given)?;
    let path = checkpoint(given)?;
    if path.exists() { Ok(path) } else { Err(unknown("checkpoint", given, &path, checkpoints())) }
}

/// Returns an error for an empty name: the path that it stands for is the folder of all names.
fn check_name(kind: &str, given: &str) -> Result<()> {
    if given.trim().is_empty() {
        return Err(Error::config(
            format!("the name of a {kind}"),
            "it is empty",
            format!("`swm {kind}s` lists the names"),
        ));
    }
    Ok(())
}

/// Returns the error for a name that does not exist, with the closest name in `folder`.
fn unknown(kind: &'static str, given: &str, path: &Path, folder: Result<PathBuf>) -> Error {
    let names = folder.map_or(vec![], |folder| names_in(&folder));
    let hint = format!("{} does not exist; `swm {kind}s` lists the known {kind}s", path.display());
    Error::unknown(kind, given, names.iter().map(String::as_str), hint)
}

/// Returns the sorted names of the entries of a folder without dataset suffixes; hidden entries are left out.
pub fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !name.starts_with('.'))
        .map(|name| match name.rsplit_once('.') {
            Some((stem, suffix)) if suffixes().any(|known| known == suffix) => stem.to_owned(),
            _ => name,
        })
        .collect();
    names.sort();
    names
}

/// Returns the location of a dataset to write, given as a path, as a URI, or as a name in [`datasets`]. A name gets the
/// first suffix of the format.
///
/// # Errors
/// As [`location`], and when the format is unknown.
pub fn target(given: &str, format: Option<&str>) -> Result<Location> {
    match format {
        Some(format) if !given.contains("://") => {
            check_name("dataset", given)?;
            let suffix = FORMATS.get(format)?.suffixes.first().copied().unwrap_or(format);
            Ok(named(given, datasets, suffix)?.into())
        }
        _ => location(given),
    }
}

/// Returns `given` unchanged if it is a path, and the entry of `folder` with this suffix if it is a name. A text is a
/// path if it contains a folder or an extension, or if a file of this name exists.
///
/// # Errors
/// When it is a name and there is no folder.
fn named(given: &str, folder: fn() -> Result<PathBuf>, suffix: &str) -> Result<PathBuf> {
    let path = Path::new(given);
    if path.components().count() > 1 || path.extension().is_some() || path.exists() {
        return Ok(path.to_owned());
    }
    Ok(folder()?.join(given).with_extension(suffix))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_home_folder_and_paths_are_unchanged() {
        let datasets = datasets().expect("a home folder");
        let dataset = |given| dataset(given).expect("a path");
        assert_eq!(dataset("a/b.lance"), Path::new("a/b.lance"));
        assert_eq!(dataset("./b"), Path::new("./b"));
        assert_eq!(dataset("rooms"), datasets.join("rooms.lance"));
        let target = |name, format| target(name, format).expect("a location").to_string();
        assert_eq!(target("rooms", Some("hdf5")), datasets.join("rooms.h5").to_string_lossy());
        assert_eq!(target("a/rooms", Some("video")), "a/rooms");
        assert_eq!(target("rooms", None), datasets.join("rooms.lance").to_string_lossy());
        let folder = checkpoints().expect("a home folder");
        assert_eq!(checkpoint("lewm-rooms").expect("a path"), folder.join("lewm-rooms"));
    }

    #[test]
    fn every_format_has_a_suffix() {
        assert!(suffixes().any(|suffix| suffix == DEFAULT_FORMAT));
        assert!(FORMATS.rows.iter().all(|format| !format.suffixes.is_empty()));
    }
}
