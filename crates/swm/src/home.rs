//! Where things live: `$STABLEWM_HOME` (default `~/.stable_worldmodel`) with `datasets/` and `checkpoints/`.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::{Error, Result};
use swm_data::Reader;

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

/// The place of a dataset given as a path or as a name under [`datasets`].
pub fn dataset(given: &str) -> PathBuf {
    named(given, datasets(), "lance")
}

/// The place of a checkpoint given as a path or as a name under [`checkpoints`].
pub fn checkpoint(given: &str) -> PathBuf {
    named(given, checkpoints(), "")
}

/// Opens a dataset by path or name.
///
/// # Errors
/// When there is none (naming the nearest), or it is damaged.
pub fn open_dataset(given: &str) -> Result<Arc<dyn Reader>> {
    let path = dataset(given);
    if !path.exists() {
        return Err(unknown("dataset", given, &path, &datasets()));
    }
    swm_data::open(&path)
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
        .map(|name| name.strip_suffix(".lance").map(str::to_owned).unwrap_or(name))
        .collect();
    names.sort();
    names
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
        assert_eq!(checkpoint("lewm-rooms"), checkpoints().join("lewm-rooms"));
    }
}
