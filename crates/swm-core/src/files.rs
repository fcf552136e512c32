//! Reading, writing and deleting files: the only module of the program that deletes, so that nothing a user owns is
//! deleted, and the way to read a file that a stranger may have written.
//!
//! - [`open`] and [`read`] accept regular files only. A pipe or a device could block forever or never end.
//! - [`write()`] replaces a file whole: readers and killed processes see the old content or the new.
//! - [`check_free`] and [`check_own`] refuse to replace a file that the program did not write.
//! - [`delete_named`] removes regular files of a folder by their exact names, [`delete`] by the patterns of names that only
//!   the program gives, and nothing else. [`move_named`] moves them.
//! - [`exists`] and [`entries`] tell what is missing from what may not be read.
//! - [`Lock`] keeps a second writer away from a file or folder.

mod lock;

pub use lock::Lock;

use crate::{Error, Result};
use std::collections::BTreeSet;
use std::fs::{File, FileType};
use std::io::{ErrorKind, Read as _, Seek as _, Write as _};
use std::path::{Component, Path, PathBuf};

/// Serializes a path as text, for `serialize_with`. JSON holds text only, so what is not UTF-8 becomes `\u{fffd}`, as on the terminal.
///
/// # Errors
/// When the serializer fails.
pub fn serialize_path<S: serde::Serializer>(path: &Path, serializer: S) -> std::result::Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}

/// Opens a regular file for reading.
///
/// # Errors
/// When the file does not exist, cannot be read, or is a folder, a pipe, a socket or a device.
pub fn open(path: &Path) -> Result<File> {
    let io = |error| Error::io(path, "opening the file", error);
    let kind = std::fs::metadata(path).map_err(io)?.file_type();
    if !kind.is_file() {
        let problem = if kind.is_dir() { "is a folder" } else { "is not a regular file" };
        return Err(Error::corrupt(path, problem, "give a regular file"));
    }
    File::open(path).map_err(io)
}

/// The length from which a file must take some space on the disk.
const LONG: u64 = 64 << 20;
/// The largest length of a longer file, in bytes of the space that it takes. No file of this program is compressed so far by a
/// file system.
const SPARSE: u64 = 64;

/// Checks that a long file is no sparse one: it would take memory, and none of the disk of who made it.
fn check_not_sparse(path: &Path, file: &File) -> Result<()> {
    let io = |error| Error::io(path, "reading the file", error);
    let metadata = file.metadata().map_err(io)?;
    let length = metadata.len();
    if length <= LONG {
        return Ok(());
    }
    #[cfg(unix)]
    let taken = std::os::unix::fs::MetadataExt::blocks(&metadata).saturating_mul(512);
    #[cfg(not(unix))]
    let taken = length;
    // Some file systems do not say what a file takes; then it does not begin with nothing.
    let is_sparse = match taken {
        0 => {
            let mut start = vec![];
            let mut beginning = file;
            beginning.take(4096).read_to_end(&mut start).map_err(io)?;
            beginning.rewind().map_err(io)?;
            start.iter().all(|&byte| byte == 0)
        }
        taken => taken < length / SPARSE,
    };
    if is_sparse {
        let problem = format!("is a sparse file: {length} bytes long, of which {taken} are on the disk");
        return Err(Error::corrupt(path, problem, "get it again from where it comes from"));
    }
    Ok(())
}

/// Reads a regular file of at most `limit` bytes.
///
/// # Errors
/// As [`open`], and when the file is longer, or is long and sparse.
pub fn read(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = open(path)?;
    let io = |error| Error::io(path, "reading the file", error);
    let length = file.metadata().map_err(io)?.len();
    let too_long =
        || Error::corrupt(path, format!("is longer than {limit} bytes"), "give a file that this program wrote");
    if length > limit {
        return Err(too_long());
    }
    check_not_sparse(path, &file)?;
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(length as usize).map_err(|_| {
        Error::corrupt(path, format!("has {length} bytes, more than the free memory"), "use a machine with more memory")
    })?;
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes).map_err(io)?;
    if bytes.len() as u64 > limit {
        return Err(too_long());
    }
    Ok(bytes)
}

/// Replaces a file by `bytes`: writes a temporary file in the same folder and renames it. A symbolic link is replaced
/// itself; the file that it points to stays as it is.
///
/// # Errors
/// When writing fails; the old file is unchanged and the temporary file is removed.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let io = |error| Error::io(path, "writing the file", error);
    let name = path
        .file_name()
        .ok_or_else(|| Error::config(path.display().to_string(), "has no file name", "give the path of a file"))?;
    let temporary = path.with_file_name(format!(".{}.{}.tmp", name.to_string_lossy(), std::process::id()));
    delete_file(&temporary)?;
    // `create_new` does not follow a link that another process made meanwhile.
    let written = File::create_new(&temporary)
        .and_then(|mut file| file.write_all(bytes).and_then(|()| file.sync_data()))
        .and_then(|()| std::fs::rename(&temporary, path));
    if written.is_err() {
        let _ = unlink(&temporary);
    }
    written.map_err(io)
}

/// Opens a file for writing, or creates it; `append` keeps the contents.
///
/// # Errors
/// When `path` is a symbolic link, a folder or a device, or cannot be opened.
pub fn open_to_write(path: &Path, append: bool) -> Result<File> {
    if kind(path)?.is_some_and(|found| !found.is_file()) {
        return Err(Error::corrupt(path, "is not a regular file", "move it away, or choose another folder"));
    }
    let file = File::options().create(true).append(append).write(true).truncate(!append).open(path);
    file.map_err(|error| Error::io(path, "opening the file to write", error))
}

/// Checks that nothing exists at the path of a new file.
///
/// # Errors
/// When something exists there, even a symbolic link to nothing.
pub fn check_free(path: &Path) -> Result<()> {
    if kind(path)?.is_none() {
        return Ok(());
    }
    let fix = "move it away, or choose another path";
    Err(Error::config(path.display().to_string(), "exists already, and is not replaced", fix))
}

/// Checks that an output file may be written: nothing exists at its path, or a file for which `is_own` holds.
///
/// # Errors
/// When a file exists that the program did not write, or a folder, a link or a device.
pub fn check_own(path: &Path, is_own: impl FnOnce(&Path) -> bool) -> Result<()> {
    let problem = match kind(path)? {
        None => return Ok(()),
        Some(found) if found.is_dir() => "is a folder; a file is written there",
        Some(found) if found.is_file() && is_own(path) => return Ok(()),
        // A file that cannot be read may be the program's own.
        Some(found) if found.is_file() && is_unreadable(path) => {
            let problem = "exists, and you have no permission to read it";
            let fix = "change the permissions, or choose another path";
            return Err(Error::config(path.display().to_string(), problem, fix));
        }
        Some(_) => "exists and was not written by this program",
    };
    Err(Error::config(path.display().to_string(), problem, "move it away, or choose another path"))
}

/// Whether the user has no permission to read a file.
fn is_unreadable(path: &Path) -> bool {
    File::open(path).is_err_and(|error| error.kind() == ErrorKind::PermissionDenied)
}

/// Checks that a path does not end in a symbolic link. Folders before its last name may be links.
///
/// # Errors
/// When the path ends in a link.
pub fn check_no_link(path: &Path) -> Result<()> {
    if kind(path)?.is_some_and(|found| found.is_symlink()) {
        let fix = "give the path that it points to, or remove the link";
        return Err(Error::config(path.display().to_string(), "is a symbolic link", fix));
    }
    Ok(())
}

/// Whether something exists at a path. Links are followed.
///
/// # Errors
/// When that is unknown, such as in a folder that may not be read.
pub fn exists(path: &Path) -> Result<bool> {
    match std::fs::metadata(path) {
        Ok(_) => Ok(true),
        Err(error) if is_missing(&error) => Ok(false),
        Err(error) => Err(Error::io(path, "examining the path", error)),
    }
}

/// The paths of what a folder holds, sorted; none if there is no such folder.
///
/// # Errors
/// When the folder cannot be read.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let io = |error| Error::io(folder, "listing the folder", error);
    let found = match std::fs::read_dir(folder) {
        Err(error) if is_missing(&error) => return Ok(vec![]),
        found => found.map_err(io)?,
    };
    let mut paths = found.map(|entry| Ok(entry.map_err(io)?.path())).collect::<Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

/// Whether an error says that nothing exists at a path.
fn is_missing(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory)
}

/// Returns the type of what a path names, without following a link at its end; `None` if nothing exists.
fn kind(path: &Path) -> Result<Option<FileType>> {
    // Without the slash at the end of a path, which would follow a link.
    let path: PathBuf = path.components().collect();
    match std::fs::symlink_metadata(&path) {
        Ok(found) => Ok(Some(found.file_type())),
        Err(error) if is_missing(&error) => Ok(None),
        Err(error) => Err(Error::io(path, "examining the path", error)),
    }
}

/// Deletes regular files of `folder`, given by their relative paths, in this order, and removes the folders below `folder` that
/// this empties. Files that do not exist are skipped. The last file that exists is deleted after those folders: it may be the
/// metadata that names the others, so that after a kill the deletion can be repeated.
///
/// # Errors
/// When one of the paths leads out of the folder or through a symbolic link, or names something other than a regular file:
/// then nothing is deleted. Also when a file cannot be deleted.
pub fn delete_named(folder: &Path, names: &[PathBuf]) -> Result<()> {
    let (mut folders, mut found) = (BTreeSet::new(), vec![]);
    check_folder(folder)?;
    for name in names {
        let inside = name.components().all(|part| matches!(part, Component::Normal(_)));
        if !inside {
            let problem = format!("the file name '{}' leads outside of the folder", name.display());
            return Err(Error::corrupt(folder, problem, "delete the files by hand"));
        }
        let parents: Vec<&Path> = name.ancestors().skip(1).filter(|parent| !parent.as_os_str().is_empty()).collect();
        // The outermost folder first: a link among the folders would lead the next ones elsewhere.
        let mut missing = false;
        for parent in parents.iter().rev().filter(|parent| !folders.contains(**parent)) {
            missing |= check_folder(&folder.join(parent))?;
        }
        let path = folder.join(name);
        match kind(&path)? {
            _ if missing => {}
            None => {}
            Some(kind) if kind.is_file() => {
                found.push(path);
                folders.extend(parents.iter().map(|parent| parent.to_path_buf()));
            }
            Some(_) => return Err(Error::corrupt(path, "is not a regular file", "remove it by hand")),
        }
    }
    let (others, last) = found.split_at(found.len().saturating_sub(1));
    for files in [others, last] {
        for path in files {
            unlink(path).map_err(|error| Error::io(path, "deleting the file", error))?;
        }
        // A folder follows its parent in a sorted set.
        folders.iter().rev().try_for_each(|name| remove_empty_folder(&folder.join(name)))?;
    }
    Ok(())
}

/// Moves regular files of the folder `from`, given by their relative paths, in this order, to the same paths in `to`, on the
/// same file system. Files that do not exist are skipped. Then removes the folders below `from` that this emptied.
///
/// # Errors
/// When a path leads through a symbolic link, something exists at the new path of a file, or a file cannot be moved. The
/// files before it are moved then.
pub fn move_named(from: &Path, names: &[PathBuf], to: &Path) -> Result<()> {
    let mut folders = BTreeSet::new();
    for name in names {
        let (old, new) = (from.join(name), to.join(name));
        for folder in [from, to] {
            // The outermost folder first: a link among the folders would lead the next ones elsewhere.
            let parents: Vec<&Path> = name.ancestors().skip(1).collect();
            parents.into_iter().rev().try_for_each(|parent| check_folder(&folder.join(parent)).map(drop))?;
        }
        if !kind(&old)?.is_some_and(|found| found.is_file()) {
            continue;
        }
        check_free(&new)?;
        if let Some(folder) = new.parent() {
            std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating the folder", error))?;
        }
        std::fs::rename(&old, &new).map_err(|error| Error::io(&old, "moving the file", error))?;
        folders.extend(name.ancestors().skip(1).filter(|parent| !parent.as_os_str().is_empty()).map(Path::to_path_buf));
    }
    // A folder follows its parent in a sorted set.
    folders.iter().rev().try_for_each(|name| remove_empty_folder(&from.join(name)))
}

/// The relative paths of the regular files in a folder and its folders. Links are left out.
///
/// # Errors
/// When a folder cannot be read.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let (mut names, mut folders) = (vec![], vec![PathBuf::new()]);
    while let Some(below) = folders.pop() {
        let path = folder.join(&below);
        let io = |error| Error::io(&path, "reading the folder", error);
        for entry in std::fs::read_dir(&path).map_err(io)? {
            let entry = entry.map_err(io)?;
            let (kind, name) = (entry.file_type().map_err(io)?, below.join(entry.file_name()));
            if kind.is_dir() {
                folders.push(name);
            } else if kind.is_file() {
                names.push(name);
            }
        }
    }
    names.sort();
    Ok(names)
}

/// Checks that a path is a folder, or that nothing exists there. Returns whether nothing exists.
fn check_folder(path: &Path) -> Result<bool> {
    match kind(path)? {
        None => Ok(true),
        Some(found) if found.is_dir() => Ok(false),
        Some(_) => Err(Error::corrupt(path, "is a file or a symbolic link", "give the folder itself")),
    }
}

/// Deletes the files of the program in `folder`. `patterns` are relative paths such as `checkpoint/config.json` or
/// `events.*.swm`; a `*` stands for any text within one name. Only regular files are deleted; symbolic links are neither
/// followed nor deleted. A folder in which files were deleted is removed if it is empty then. Returns the remaining
/// entries of `folder`, sorted.
///
/// # Errors
/// When `folder` is a symbolic link or not a folder, or a file cannot be removed. A missing folder is not an error.
pub fn delete(folder: &Path, patterns: &[&str]) -> Result<Vec<PathBuf>> {
    // A folder cannot be removed by a path that ends in `.` or `..`.
    let folder = match folder.file_name() {
        Some(_) => folder.components().collect(),
        None => folder.canonicalize().map_err(|error| Error::io(folder, "deleting files", error))?,
    };
    if check_folder(&folder)? { Ok(vec![]) } else { delete_in(&folder, patterns).map(|(_, remaining)| remaining) }
}

/// As [`delete`], for an existing folder; also returns whether a file was deleted.
fn delete_in(folder: &Path, patterns: &[&str]) -> Result<(bool, Vec<PathBuf>)> {
    let io = |error| Error::io(folder, "deleting files", error);
    let (mut deleted, mut remaining) = (false, vec![]);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let (name, path) = (entry.file_name(), entry.path());
        // The type of a directory entry is that of a link, not of the link's target.
        let kind = entry.file_type().map_err(io)?;
        let below: Vec<&str> = patterns.iter().filter_map(|pattern| after_name(pattern, name.to_str()?)).collect();
        if kind.is_file() && below.contains(&"") {
            unlink(&path).map_err(|error| Error::io(&path, "deleting the file", error))?;
            deleted = true;
        } else if kind.is_dir() && below.iter().any(|pattern| !pattern.is_empty()) {
            let (inside, rest) = delete_in(&path, &below)?;
            deleted |= inside;
            if !inside || !rest.is_empty() {
                remaining.push(path);
            }
        } else {
            remaining.push(path);
        }
    }
    remaining.sort();
    if deleted && remaining.is_empty() {
        std::fs::remove_dir(folder).map_err(io)?;
    }
    Ok((deleted, remaining))
}

/// Returns the part of a pattern below its first component, or `None` if `name` does not match that component.
fn after_name<'a>(pattern: &'a str, name: &str) -> Option<&'a str> {
    let (first, below) = pattern.split_once('/').unwrap_or((pattern, ""));
    let matches = match first.split_once('*') {
        Some((start, end)) => name.len() >= start.len() + end.len() && name.starts_with(start) && name.ends_with(end),
        None => name == first,
    };
    matches.then_some(below)
}

/// Deletes one regular file of the program, such as a temporary file. A missing file is not an error.
///
/// # Errors
/// When `path` is a folder, a symbolic link or a device, or the file cannot be removed.
pub fn delete_file(path: &Path) -> Result<()> {
    match kind(path)? {
        None => Ok(()),
        Some(found) if found.is_file() => unlink(path).map_err(|error| Error::io(path, "deleting the file", error)),
        Some(_) => Err(Error::corrupt(path, "is not a regular file", "remove it by hand")),
    }
}

/// Deletes the temporary files that a kill during [`write()`] leaves, of the files with these names. The caller holds the
/// [`Lock`] of the folder: the temporary file of a writer that still runs looks the same.
///
/// # Errors
/// When the folder cannot be read, or a file cannot be deleted.
pub fn delete_temporary(folder: &Path, is_written: impl Fn(&str) -> bool) -> Result<()> {
    let io = |error| Error::io(folder, "reading the folder", error);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.file_name();
        let parts = name.to_str().and_then(|name| name.strip_prefix('.')?.strip_suffix(".tmp")?.rsplit_once('.'));
        let is_temporary = |(written, process): (&str, &str)| is_written(written) && process.parse::<u32>().is_ok();
        if parts.is_some_and(is_temporary) {
            delete_file(&entry.path())?;
        }
    }
    Ok(())
}

/// Removes a folder if it exists and is empty. A symbolic link is no folder.
///
/// # Errors
/// When an empty folder cannot be removed.
pub fn remove_empty_folder(folder: &Path) -> Result<()> {
    match std::fs::remove_dir(folder) {
        Err(error)
            if !matches!(
                error.kind(),
                ErrorKind::DirectoryNotEmpty | ErrorKind::NotFound | ErrorKind::NotADirectory
            ) =>
        {
            Err(Error::io(folder, "removing an empty folder", error))
        }
        _ => Ok(()),
    }
}

/// Removes the empty folders in a folder, then the folder itself if it is empty. Links are not followed.
///
/// # Errors
/// When a folder cannot be read, or an empty folder cannot be removed.
pub fn remove_empty_folders(folder: &Path) -> Result<()> {
    let io = |error| Error::io(folder, "reading the folder", error);
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        if entry.file_type().map_err(io)?.is_dir() {
            remove_empty_folders(&entry.path())?;
        }
    }
    remove_empty_folder(folder)
}

fn unlink(path: &Path) -> std::io::Result<()> {
    std::fs::remove_file(path)
}

#[cfg(test)]
mod tests;
