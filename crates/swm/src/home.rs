//! Where things live: `$STABLEWM_HOME` (default `~/.stable_worldmodel`) with `datasets/` and `checkpoints/`.

use std::path::{Path, PathBuf};

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
