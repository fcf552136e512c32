//! The output folder of a command.

use std::path::Path;
use swm_core::files::Lock;
use swm_core::{Error, Result};

/// Creates the folder that a command writes these files to, and keeps other writers away until the lock is dropped. A
/// command calls this before its work, so that hours of it are not lost because its results cannot be written.
///
/// # Errors
/// When the folder cannot be created or written to, another process writes to it, or one of the files is a folder.
pub fn claim(folder: &Path, files: &[&str]) -> Result<Lock> {
    if folder.exists() && !folder.is_dir() {
        return Err(Error::config(folder.display().to_string(), "is not a folder", "give a folder with --output"));
    }
    let lock = Lock::folder(folder)?;
    check_writable(folder)?;
    match files.iter().map(|name| folder.join(name)).find(|path| path.is_dir()) {
        None => Ok(lock),
        Some(path) => {
            let fix = "remove it, or give another folder with --output";
            Err(Error::config(path.display().to_string(), "is a folder; a file is written there", fix))
        }
    }
}

/// Checks, before the work, that a command can write its one output file.
///
/// # Errors
/// When the path is a folder, or its folder does not exist or cannot be written to.
pub fn check_file(path: &Path) -> Result<()> {
    if path.is_dir() {
        return Err(Error::config(path.display().to_string(), "is a folder", "give the path of a file"));
    }
    check_writable(path.parent().filter(|folder| *folder != Path::new("")).unwrap_or_else(|| Path::new(".")))
}

fn check_writable(folder: &Path) -> Result<()> {
    tempfile::tempfile_in(folder).map(drop).map_err(|error| Error::io(folder, "writing to the folder", error))
}
