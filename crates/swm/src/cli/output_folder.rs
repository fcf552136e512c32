//! The output folder of a command.

use std::path::Path;
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};

/// Creates the folder that a command writes these files to, and keeps other writers away until the lock is dropped. A
/// command calls this before its work, so that hours of it are not lost because its results cannot be written.
///
/// # Errors
/// When the folder cannot be created or written to, another process writes to it, or one of the files exists and was not
/// written by this program.
pub fn claim(folder: &Path, names: &[&str]) -> Result<Lock> {
    if folder.exists() && !folder.is_dir() {
        return Err(Error::config(folder.display().to_string(), "is not a folder", "give a folder with --output"));
    }
    let lock = Lock::folder(folder)?;
    check_writable(folder)?;
    names.iter().try_for_each(|name| files::check_own(&folder.join(name), is_own))?;
    Ok(lock)
}

/// Returns whether an existing output file was written by this program: a page names it, results have a manifest, and
/// traces lie beside results.
fn is_own(path: &Path) -> bool {
    let contains = |path: &Path, mark: &str| {
        let bytes = files::read(path, MAX_OUTPUT_BYTES).unwrap_or_default();
        bytes.windows(mark.len()).any(|part| part == mark.as_bytes())
    };
    let results = path.with_file_name("results.json");
    match path.file_name().and_then(|name| name.to_str()) {
        Some("index.html") => contains(path, PAGE_MARK),
        _ => contains(&results, "\"swm_version\""),
    }
}

/// The heading of every page of this program.
const PAGE_MARK: &str = "<p class=\"eyebrow\">stable-worldmodel</p>";
/// The largest existing output file that is recognised as the program's own.
const MAX_OUTPUT_BYTES: u64 = 1 << 30;

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
