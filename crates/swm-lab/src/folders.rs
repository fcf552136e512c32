//! Folders that the lab was started with, and their entries by name. A name is looked up in a listing and never joined to a
//! path, and an entry that links to somewhere else is refused, so that no request reaches another folder.

use std::path::{Path, PathBuf};
use swm_core::{Error, Result};

/// The longest name of a dataset that the lab writes.
const LONGEST: usize = 64;
/// The largest number of entries that are listed in a folder.
pub const MOST: usize = 5_000;

/// Folders, in the order in which they are shown.
#[derive(Clone, Debug, Default)]
pub struct Folders(Vec<PathBuf>);

impl Folders {
    /// These folders. They need not exist yet.
    pub fn new(folders: Vec<PathBuf>) -> Self {
        Self(folders)
    }

    /// The folders.
    pub fn paths(&self) -> &[PathBuf] {
        &self.0
    }

    /// The entries of all folders that satisfy `wanted`, with the index of their folder, sorted by name. Entries of folders
    /// that are not wanted are searched to this depth.
    pub fn list(&self, depth: usize, wanted: impl Fn(&Path) -> bool) -> Vec<Found> {
        let mut found = vec![];
        for (index, folder) in self.0.iter().enumerate() {
            let Ok(home) = folder.canonicalize() else { continue };
            let mut of_folder = vec![];
            search(&home, "", depth, &wanted, &mut of_folder);
            of_folder.sort_by(|(a, _), (b, _)| a.cmp(b));
            found.extend(of_folder.into_iter().map(|(name, path)| Found { folder: index, name, path }));
        }
        found
    }

    /// The wanted entry of this name in the folder with this index.
    ///
    /// # Errors
    /// When there is no such entry.
    pub fn find(&self, folder: usize, name: &str, depth: usize, wanted: impl Fn(&Path) -> bool) -> Result<PathBuf> {
        let found = self.list(depth, wanted);
        let entry = found.iter().find(|entry| entry.folder == folder && entry.name == name);
        entry.map(|entry| entry.path.clone()).ok_or_else(|| {
            let names = found.iter().map(|entry| entry.name.as_str());
            Error::unknown("entry", name, names, "reload the page, which lists the folders of the lab")
        })
    }
}

/// An entry of a folder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// The index of its folder.
    pub folder: usize,
    /// The path from the folder, with `/` between the parts.
    pub name: String,
    /// The path.
    pub path: PathBuf,
}

/// Returns the path of a dataset to write: a plain name in a folder.
///
/// # Errors
/// As [`check_name`], or when the dataset, or a part of it, is a symbolic link: what it names would be written elsewhere.
pub fn new_dataset(folder: &Path, name: &str) -> Result<PathBuf> {
    check_name("the name of a dataset", name)?;
    let path = folder.join(format!("{name}.lance"));
    let parts = std::fs::read_dir(&path).into_iter().flatten().flatten().map(|part| part.path());
    let mut all = std::iter::once(path.clone()).chain(parts);
    if let Some(link) = all.find(|path| path.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink())) {
        let problem = format!("{} is a symbolic link", link.display());
        return Err(Error::config("the name of a dataset", problem, "choose another name"));
    }
    Ok(path)
}

/// Checks a plain name, which stays in its folder. `what` has it.
///
/// # Errors
/// When the name is empty, too long, or has other characters than letters, digits, `-` and `_`.
pub fn check_name(what: &str, name: &str) -> Result<()> {
    let valid = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if name.is_empty() || name.len() > LONGEST || !name.chars().all(valid) || name.starts_with('-') {
        let fix = format!("write 1 to {LONGEST} letters, digits, - or _");
        return Err(Error::config(what, format!("'{name}' is not one"), fix));
    }
    Ok(())
}

/// Adds the wanted entries of a folder. `path` is canonical, so an entry that links elsewhere does not begin with it.
fn search(
    path: &Path,
    prefix: &str,
    depth: usize,
    wanted: &impl Fn(&Path) -> bool,
    found: &mut Vec<(String, PathBuf)>,
) {
    for entry in std::fs::read_dir(path).into_iter().flatten().flatten().take(MOST) {
        let Ok(name) = entry.file_name().into_string() else { continue };
        let is_link = entry.file_type().map_or(true, |kind| kind.is_symlink());
        if name.starts_with('.') || is_link {
            continue;
        }
        let (name, child) = (format!("{prefix}{name}"), entry.path());
        if wanted(&child) {
            found.push((name, child));
        } else if depth > 1 && child.is_dir() {
            search(&child, &format!("{name}/"), depth - 1, wanted, found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn entries_of_the_folders_are_found_and_nothing_else() {
        let root = tempfile::tempdir().expect("a folder");
        let (inside, outside) = (root.path().join("inside"), root.path().join("outside"));
        for folder in [inside.join("a"), inside.join("deep/b"), outside.join("secret")] {
            fs::create_dir_all(&folder).expect("a folder");
            fs::write(folder.join("log"), "").expect("a file");
        }
        std::os::unix::fs::symlink(outside.join("secret"), inside.join("link")).expect("a link");
        let folders = Folders::new(vec![inside, root.path().join("missing")]);
        let wanted = |path: &Path| path.join("log").is_file();
        let names = |depth| folders.list(depth, wanted).into_iter().map(|entry| entry.name).collect::<Vec<_>>();
        assert_eq!((names(1), names(2)), (vec!["a".to_owned()], vec!["a".to_owned(), "deep/b".to_owned()]));
        assert!(folders.find(0, "deep/b", 2, wanted).is_ok());
        for name in ["../outside/secret", "link", "a/../../outside/secret", "", ".", "/etc", "a\0"] {
            assert!(folders.find(0, name, 2, wanted).is_err(), "{name}");
        }
        assert!(folders.find(1, "a", 2, wanted).is_err());
    }

    #[test]
    fn links_are_no_new_datasets() {
        let root = tempfile::tempdir().expect("a folder");
        let (home, outside) = (root.path().join("home"), root.path().join("outside"));
        fs::create_dir_all(home.join("own.lance")).expect("a folder");
        fs::create_dir_all(&outside).expect("a folder");
        assert!(new_dataset(&home, "own").is_ok());
        std::os::unix::fs::symlink(&outside, home.join("linked.lance")).expect("a link");
        std::os::unix::fs::symlink(&outside, home.join("own.lance/data")).expect("a link");
        for name in ["linked", "own"] {
            let error = new_dataset(&home, name).expect_err("a link").to_string();
            assert!(error.contains("symbolic link"), "{error}");
        }
    }

    #[test]
    fn names_of_new_datasets_stay_in_the_folder() {
        let folder = Path::new("/home/datasets");
        assert_eq!(new_dataset(folder, "my-demos_2").expect("a path"), Path::new("/home/datasets/my-demos_2.lance"));
        for name in ["", "..", "../a", "a/b", "/etc/passwd", ".hidden", "a.b", "s3://b", "-o", &"a".repeat(65)] {
            assert!(new_dataset(folder, name).is_err(), "{name}");
        }
    }
}
