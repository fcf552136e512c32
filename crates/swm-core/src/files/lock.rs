//! [`Lock`]: one writer at a time for a file or folder.

use crate::{Error, Result};
use std::fs::{File, Metadata, OpenOptions, TryLockError};
use std::io::{self, ErrorKind};
use std::ops::Deref;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

/// An exclusive lock of a file or folder, held until it is dropped or the process ends, also by a kill. It is advisory:
/// it keeps away other writers that take a [`Lock`], on any machine that shares the file system. File systems without
/// locks (some network file systems) keep no one away.
#[derive(Debug)]
pub struct Lock(File);

impl Lock {
    /// Locks a folder, and creates it if it does not exist.
    ///
    /// # Errors
    /// When another writer holds the lock, or the folder cannot be created or opened.
    pub fn folder(path: &Path) -> Result<Self> {
        // Without the slash at the end of a path, with which a file does not exist.
        let path: PathBuf = path.components().collect();
        if let Some(file) = path.ancestors().find(|part| part.exists()).filter(|part| !part.is_dir()) {
            let below = if file == path { String::new() } else { format!("{} ", file.display()) };
            return Err(Error::corrupt(&path, format!("{below}is not a folder"), "choose another path"));
        }
        Self::acquire(&path, || {
            std::fs::create_dir_all(&path).map_err(|error| Error::io(&path, "creating the folder", error))?;
            File::open(&path).map_err(|error| locking(&path, error))
        })
    }

    /// Opens a file for reading and writing, creates it and its folder if they do not exist, and locks it. The lock
    /// dereferences to the file.
    ///
    /// # Errors
    /// When another writer holds the lock, the path names something other than a regular file, or the file cannot be
    /// created or opened.
    pub fn file(path: &Path) -> Result<Self> {
        if path.exists() {
            super::open(path)?;
        }
        Self::acquire(path, || {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder).map_err(|error| Error::io(folder, "creating the folder", error))?;
            }
            let file = OpenOptions::new().read(true).write(true).create(true).truncate(false).open(path);
            file.map_err(|error| Error::io(path, "creating the file", error))
        })
    }

    fn acquire(path: &Path, open: impl Fn() -> Result<File>) -> Result<Self> {
        let io = |error| locking(path, error);
        loop {
            let file = open()?;
            match file.try_lock() {
                Err(TryLockError::WouldBlock) => {
                    let problem = "another process writes to it";
                    let fix = "wait until that process has ended, or choose another path";
                    return Err(Error::config(path.display().to_string(), problem, fix));
                }
                Err(TryLockError::Error(error)) if !has_no_locks(&error) => return Err(io(error)),
                _ => {}
            }
            // Another process may have replaced the file between opening and locking.
            let opened = file.metadata().map_err(io)?;
            match std::fs::metadata(path) {
                Ok(named) if is_same(&named, &opened) => return Ok(Self(file)),
                Err(error) if error.kind() != ErrorKind::NotFound => return Err(io(error)),
                _ => {}
            }
        }
    }
}

fn locking(path: &Path, error: io::Error) -> Error {
    Error::io(path, "taking the lock against other writers", error)
}

impl Deref for Lock {
    type Target = File;

    fn deref(&self) -> &File {
        &self.0
    }
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Forked processes inherit the descriptor; closing this one would not release the lock.
        let _ = self.0.unlock();
    }
}

/// Whether the file system has no locks, or, like NFS, none for folders.
fn has_no_locks(error: &io::Error) -> bool {
    const EBADF: i32 = 9;
    const ENOLCK: i32 = 37;
    error.kind() == ErrorKind::Unsupported || matches!(error.raw_os_error(), Some(EBADF | ENOLCK))
}

fn is_same(a: &Metadata, b: &Metadata) -> bool {
    (a.dev(), a.ino()) == (b.dev(), b.ino())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn folders_that_cannot_be_created_are_named() {
        let file = std::env::temp_dir().join(format!("swm-lock-file-{}", std::process::id()));
        fs::write(&file, "").expect("writing a file");
        let error = Lock::file(&file.join("sub/data.h5")).expect_err("a folder below a file").to_string();
        fs::remove_file(&file).expect("removing the file");
        assert!(error.contains("/sub: creating the folder: "), "{error}");
    }

    #[test]
    fn second_lock_is_refused_until_the_first_is_dropped() {
        let root = std::env::temp_dir().join(format!("swm-lock-{}", std::process::id()));
        let (folder, file) = (root.join("run"), root.join("new/data.h5"));
        let held =
            (Lock::folder(&folder).expect("locking a new folder"), Lock::file(&file).expect("locking a new file"));
        for error in [
            Lock::folder(&folder).expect_err("locking a locked path"),
            Lock::file(&file).expect_err("locking a locked path"),
        ] {
            assert!(error.is_usage() && error.to_string().contains("another process writes to it"), "{error}");
        }
        // A file that replaces the locked one has its own lock.
        fs::write(root.join("other"), "other").expect("writing a file");
        fs::rename(root.join("other"), &file).expect("replacing the file");
        assert_eq!(
            Lock::file(&file).expect("locking another file").metadata().expect("reading the length of the file").len(),
            5
        );
        drop(held);
        Lock::folder(&folder).expect("locking a folder without a writer");
        Lock::file(&folder).expect_err("a folder is not a file");
        fs::remove_dir_all(&root).expect("removing the folder of the test");
    }
}
