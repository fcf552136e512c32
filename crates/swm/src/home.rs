//! Folders of named datasets and checkpoints: `$STABLEWM_HOME` (default `~/.stable_worldmodel`) with `datasets/`,
//! `checkpoints/`, `weights/` and `hub/`, the cache of `hf://` URIs.

use crate::{remote_checkpoint, zoo};
use std::iter::once;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use swm_core::run::{Control, Event};
use swm_core::{Error, Result};
use swm_data::hub::{Hub, HubUri, RepoKind, check_no_pointer};
use swm_data::{FORMATS, Location, Reader};
use swm_models::StoredCheckpoint;

/// The format of new datasets whose name has no suffix.
const DEFAULT_FORMAT: &str = "lance";

/// Returns the folder of all named datasets, checkpoints and weights.
///
/// # Errors
/// When neither `STABLEWM_HOME` nor `HOME` is set, or the first is a URI, as of all functions below that read a name.
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

/// Returns the folder of files of the Hugging Face hub.
///
/// # Errors
/// As [`home`].
pub fn hub_cache() -> Result<PathBuf> {
    Ok(home()?.join("hub"))
}

/// Makes the control of a download.
type MakeControl = Box<dyn Fn() -> Control<'static> + Send + Sync>;

/// The control of downloads that a name causes, and the URIs with their commits.
static DOWNLOADS: OnceLock<MakeControl> = OnceLock::new();
static PINNED: Mutex<Vec<String>> = Mutex::new(vec![]);

/// Shows the progress of downloads that names cause with the controls that `make` makes, and stops them as these say.
pub fn show_downloads(make: impl Fn() -> Control<'static> + Send + Sync + 'static) {
    // A program that embeds the command line may have set another one.
    let _ = DOWNLOADS.set(Box::new(make));
}

/// Returns the control of downloads for a program that shows none: messages are logged.
fn logging() -> Control<'static> {
    Control::new().with_events(|event| {
        if let Event::Log(line) = event {
            tracing::warn!("{line}");
        }
    })
}

/// Returns the URIs of the hub that this process has read, with their commits.
pub fn pinned_uris() -> Vec<String> {
    PINNED.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

/// Downloads what a URI of the hub names, if it is not cached; returns its path and the URI with its commit.
fn pull(given: &str, kind: RepoKind) -> Result<(PathBuf, String)> {
    let uri = HubUri::parse(given, kind)?;
    let mut control = DOWNLOADS.get().map_or_else(logging, |make| make());
    let pulled = Hub::new(&hub_cache()?)?.pull(&uri, &mut control)?;
    let mut pinned = PINNED.lock().unwrap_or_else(PoisonError::into_inner);
    if !pinned.contains(&pulled.pinned) {
        pinned.push(pulled.pinned.clone());
    }
    Ok((pulled.path, pulled.pinned))
}

/// Returns the name of a dataset with the commit that its revision has now, if it is a URI of the hub; other names as they are.
///
/// # Errors
/// When the hub does not have it, or cannot be reached.
pub fn pinned_dataset(given: &str) -> Result<String> {
    if HubUri::is_uri(given) { Ok(pull(given, RepoKind::Dataset)?.1) } else { Ok(given.to_owned()) }
}

/// As [`pinned_dataset`], for a checkpoint.
///
/// # Errors
/// As [`pinned_dataset`].
pub fn pinned_checkpoint(given: &str) -> Result<String> {
    if HubUri::is_uri(given) { Ok(pull(given, RepoKind::Model)?.1) } else { Ok(given.to_owned()) }
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

/// Returns the path of the dataset of this name in [`datasets`], whatever the current folder has of the name; `None` for a path,
/// and if there is none.
///
/// # Errors
/// As [`home`], if it is a name.
pub fn named_dataset(given: &str) -> Result<Option<PathBuf>> {
    if given.starts_with('~') || given.contains(std::path::is_separator) || Path::new(given).extension().is_some() {
        return Ok(None);
    }
    let path = datasets()?.join(given);
    let mut suffixes = once(DEFAULT_FORMAT).chain(suffixes()).chain(once(""));
    Ok(suffixes.find_map(|suffix| Some(path.with_extension(suffix)).filter(|path| path.exists())))
}

/// Returns the location of a dataset given as a path, as a URI, or as a name in [`datasets`]. A dataset of the hub is downloaded
/// if it is not cached.
///
/// # Errors
/// When the text is empty, or a URI of an unknown scheme.
pub fn location(given: &str) -> Result<Location> {
    check_name("dataset", given)?;
    if HubUri::is_uri(given) {
        return Ok(pull(given, RepoKind::Dataset)?.0.into());
    }
    if given.contains("://") { Location::parse(given) } else { Ok(dataset(given)?.into()) }
}

/// Returns the path of a checkpoint given as a path, as a name in [`checkpoints`], as `zoo:NAME`, or as a URI of the hub, which
/// is downloaded if it is not cached.
///
/// # Errors
/// As [`home`], if it is a name, and when the [zoo] or the hub has no such checkpoint.
pub fn checkpoint(given: &str) -> Result<PathBuf> {
    if HubUri::is_uri(given) {
        return checkpoint_in(pull(given, RepoKind::Model)?.0);
    }
    if given.contains("://") {
        return remote_checkpoint::fetch(given);
    }
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
    check_not_on_hub(given)?;
    if given.contains("://") {
        let fix = "write it to a name or a path; `swm train --on ray` stores runs at URIs (docs/ray.md)";
        return Err(Error::config(given, "is a URI, and a checkpoint is written to a folder", fix));
    }
    named(given, checkpoints, "")
}

/// A downloaded checkpoint: the path itself, or the only capsule of a folder that holds no run.
fn checkpoint_in(path: PathBuf) -> Result<PathBuf> {
    if path.is_file() || StoredCheckpoint::read(&path).is_ok() {
        return Ok(path);
    }
    let entries = std::fs::read_dir(&path).into_iter().flatten().flatten().map(|entry| entry.path());
    let capsules: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|suffix| suffix == "safetensors")).collect();
    match &capsules[..] {
        [only] => Ok(only.clone()),
        _ => Ok(path),
    }
}

/// Returns an error for a URI of the hub, to which nothing is written but by `swm push`.
fn check_not_on_hub(given: &str) -> Result<()> {
    if HubUri::is_uri(given) {
        let fix = format!("write it to a name or a path, then `swm push PATH {given}`");
        return Err(Error::config(given, "is on the hub, which is written to by uploads only", fix));
    }
    Ok(())
}

/// Opens a dataset given as a path, as a URI, or as a name in [`datasets`].
///
/// # Errors
/// When the dataset does not exist (the message names the closest name), or is damaged.
pub fn open_dataset(given: &str) -> Result<Arc<dyn Reader>> {
    let location = find_dataset(given)?;
    let opened = swm_data::open(location.clone());
    match (&opened, location.path()) {
        // What Git left in place of a large file says more than an error of the format.
        (Err(_), Some(path)) => check_no_pointer(path).and(opened),
        _ => opened,
    }
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
    if !path.exists() {
        return Err(unknown("checkpoint", given, &path, checkpoints()));
    }
    check_no_pointer(&path)?;
    Ok(path)
}

/// As [`find_checkpoint`], for a checkpoint that is changed: one on this machine.
///
/// # Errors
/// As [`find_checkpoint`], and when it is a URI.
pub fn own_checkpoint(given: &str) -> Result<PathBuf> {
    if given.contains("://") {
        let fix = "name a checkpoint on this machine; a run on Ray is continued by the command that began it";
        return Err(Error::config(given, "is a URI, of which this machine has a copy only", fix));
    }
    find_checkpoint(given)
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
    check_not_on_hub(given)?;
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
/// path if it contains a folder or an extension, or if a file of this name exists. A path of `~/` is one in the user's home.
///
/// # Errors
/// When it is a name and there is no folder.
fn named(given: &str, folder: fn() -> Result<PathBuf>, suffix: &str) -> Result<PathBuf> {
    let path = Path::new(given);
    if let Some(path) = swm_core::home::of_tilde(path) {
        return Ok(path);
    }
    // A name has no slash, not even at its end.
    if given.contains(std::path::is_separator) || path.extension().is_some() || path.exists() {
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
        assert_eq!(dataset("b/"), Path::new("b/"));
        let user = swm_core::home::of_user().expect("a user's home");
        assert_eq!(dataset("~/a/b.lance"), user.join("a/b.lance"));
        assert_eq!(dataset("~b.lance"), Path::new("~b.lance"));
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
