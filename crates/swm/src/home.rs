//! Where things live: `$STABLEWM_HOME` (default `~/.stable_worldmodel`) with `datasets/` and `checkpoints/`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{Error, Result};
use swm_data::{Location, Reader};

/// The folder everything without a path of its own lives in.
pub fn home() -> PathBuf {
    match std::env::var_os("STABLEWM_HOME") {
        Some(home) if !home.is_empty() => home.into(),
        _ => Path::new(&std::env::var_os("HOME").unwrap_or_default()).join(".stable_worldmodel"),
    }
}

/// Where named datasets live.
pub fn datasets() -> PathBuf {
    home().join("datasets")
}

/// Where named checkpoints live.
pub fn checkpoints() -> PathBuf {
    home().join("checkpoints")
}

/// Where weights of others are kept, once downloaded.
pub fn weights() -> PathBuf {
    home().join("weights")
}

/// What names under [`datasets`] may end in, and need not be given with; the first is what a new one gets.
const SUFFIXES: [&str; 8] = ["lance", "h5", "hdf5", "lance-video", "video", "folder", "lerobot", ""];

/// The place of a dataset given as a path or as a name under [`datasets`].
pub fn dataset(given: &str) -> PathBuf {
    let home = datasets();
    let named_so = SUFFIXES.iter().map(|suffix| named(given, home.clone(), suffix)).find(|path| path.exists());
    named_so.unwrap_or_else(|| named(given, home, SUFFIXES[0]))
}

/// Where a dataset is that is given as a path, as a URI, or as a name under [`datasets`].
///
/// # Errors
/// When it has the form of a URI and is none of an object store.
pub fn location(given: &str) -> Result<Location> {
    if given.contains("://") { Location::parse(given) } else { Ok(dataset(given).into()) }
}

/// The place of a checkpoint given as a path or as a name under [`checkpoints`].
pub fn checkpoint(given: &str) -> PathBuf {
    named(given, checkpoints(), "")
}

/// Opens a dataset by path, URI or name.
///
/// # Errors
/// When there is none (naming the nearest), or it is damaged.
pub fn open_dataset(given: &str) -> Result<Arc<dyn Reader>> {
    swm_data::open(find_dataset(given)?)
}

/// Where a dataset is that is there, given by path, URI or name.
///
/// # Errors
/// When there is none, naming the nearest. What a URI points to is not looked at.
pub fn find_dataset(given: &str) -> Result<Location> {
    let location = location(given)?;
    match location.path() {
        Some(path) if !path.exists() => Err(unknown("dataset", given, path, &datasets())),
        _ => Ok(location),
    }
}

/// The folder of a checkpoint that is there, by path or name.
///
/// # Errors
/// When there is none, naming the nearest.
pub fn find_checkpoint(given: &str) -> Result<PathBuf> {
    let path = checkpoint(given);
    if path.exists() { Ok(path) } else { Err(unknown("checkpoint", given, &path, &checkpoints())) }
}

/// A name that stands for nothing.
fn unknown(kind: &'static str, given: &str, path: &Path, folder: &Path) -> Error {
    let names = names_in(folder);
    let hint = format!("there is none at {}; `swm {kind}s` lists those at home", path.display());
    Error::unknown(kind, given, names.iter().map(String::as_str), hint)
}

/// The names of what lies in a folder, in order, hidden ones left out.
pub fn names_in(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut names: Vec<String> = entries
        .filter_map(|entry| entry.file_name().into_string().ok())
        .filter(|name| !name.starts_with('.'))
        .map(|name| match name.rsplit_once('.') {
            Some((stem, suffix)) if SUFFIXES.contains(&suffix) => stem.to_owned(),
            _ => name,
        })
        .collect();
    names.sort();
    names
}

/// Where a dataset of a format is to be written that is given as a path, as a URI, or as a name under [`datasets`].
///
/// # Errors
/// As [`location`].
pub fn target(given: &str, format: Option<&str>) -> Result<Location> {
    match format {
        Some(format) if !given.contains("://") => {
            Ok(named(given, datasets(), if format == "hdf5" { "h5" } else { format }).into())
        }
        _ => location(given),
    }
}

/// What has a folder in it, an extension, or exists is a path; the rest are names.
fn named(given: &str, folder: PathBuf, extension: &str) -> PathBuf {
    let path = Path::new(given);
    if path.components().count() > 1 || path.extension().is_some() || path.exists() {
        return path.to_owned();
    }
    folder.join(given).with_extension(extension)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_go_home_and_paths_stay() {
        assert_eq!(dataset("a/b.lance"), Path::new("a/b.lance"));
        assert_eq!(dataset("./b"), Path::new("./b"));
        assert_eq!(dataset("rooms"), datasets().join("rooms.lance"));
        let written = |name, format| target(name, format).expect("a place").to_string();
        assert_eq!(written("rooms", Some("hdf5")), datasets().join("rooms.h5").to_string_lossy());
        assert_eq!(written("a/rooms", Some("video")), "a/rooms");
        assert_eq!(written("rooms", None), datasets().join("rooms.lance").to_string_lossy());
        assert_eq!(checkpoint("lewm-rooms"), checkpoints().join("lewm-rooms"));
    }
}
