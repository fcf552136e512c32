//! A cache of decoded rows in files.
//!
//! The cache of a column consists of two files, in a folder named after the dataset's content hash. `COLUMN.rows`
//! stores row `r` at `r * row_bytes`; rows that are not cached are file holes, which take no disk space. `COLUMN.marks`
//! stores eight bytes per row, its mark: zero, or the first bytes of a BLAKE3 hash of the dataset, the number of the row and its
//! content, with the lowest bit set.
//!
//! A row is written before its mark, and each process verifies the mark when it first reads the row, and again after another
//! program wrote to the file. A row that was only half written at a power failure, was changed later, or was copied from the
//! cache of another dataset is therefore decoded again. A dataset with changed content has another folder name and starts with an
//! empty cache. Rows are read, not mapped into memory, because a mapped file that another program shortens ends the process.
//!
//! The process that holds the lock on the marks file fills the cache; other processes only read it.

use super::{Budget, RowCache};
use std::fs::{File, OpenOptions};
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU32, Ordering};
use swm_core::{ColumnSpec, Error, Result, files};

/// Size of a mark in bytes.
const MARK_BYTES: usize = 8;

/// State of a row whose mark this process has not checked.
const UNKNOWN: u32 = 0;
/// State of a row that has no mark, or does not match its mark.
const ABSENT: u32 = u32::MAX;

/// Cached rows of a column in a file.
pub struct DiskRowCache {
    file: File,
    marks: File,
    /// The key of the hashes: the dataset and the column.
    key: [u8; blake3::KEY_LEN],
    row_bytes: usize,
    /// State of each row in this process: [`UNKNOWN`], [`ABSENT`], or the version of the file in which the row matched its mark.
    states: Vec<AtomicU32>,
    /// The time of the last change of the file that this process knows, in nanoseconds.
    changed: AtomicI64,
    /// Counts the changes of the file by other programs, from 1 on.
    version: AtomicU32,
    /// Whether this process fills the cache.
    fills: bool,
    budget: Arc<Budget>,
}

impl DiskRowCache {
    /// Opens or creates the cache of a column.
    pub fn open(folder: &Path, identity: &str, column: &ColumnSpec, rows: usize, budget: Arc<Budget>) -> Result<Self> {
        let folder = folder.join(identity);
        std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, "creating the cache's folder", e))?;
        // Column names may contain characters that are not allowed in file names.
        let name = &blake3::hash(column.name.as_bytes()).to_hex()[..16];
        let open = |suffix: &str, size: usize| {
            let path = folder.join(format!("{name}.{suffix}"));
            files::check_no_link(&path)?;
            let io = |e| Error::io(&path, "opening the cache", e);
            let file =
                OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).map_err(io)?;
            if file.metadata().map_err(io)?.len() != size as u64 {
                file.set_len(size as u64).map_err(io)?;
            }
            Ok(file)
        };
        let row_bytes = column.row_bytes();
        let (file, marks) = (open("rows", rows * row_bytes)?, open("marks", rows * MARK_BYTES)?);
        let fills = marks.try_lock().is_ok();
        let cache = Self {
            changed: AtomicI64::new(changed(&file)),
            version: AtomicU32::new(1),
            file,
            marks,
            key: *blake3::hash(format!("{identity}/{}", column.name).as_bytes()).as_bytes(),
            row_bytes,
            states: (0..rows).map(|_| AtomicU32::new(UNKNOWN)).collect(),
            fills,
            budget,
        };
        // Rows that are already cached count towards the budget.
        let count = cache.count_marks().map_err(|e| Error::io(&folder, "reading the list of cached rows", e))?;
        for _ in 0..count {
            cache.budget.take(row_bytes);
        }
        Ok(cache)
    }

    /// Number of rows with a mark.
    fn count_marks(&self) -> std::io::Result<usize> {
        let mut marks = vec![0; self.states.len() * MARK_BYTES];
        self.marks.read_exact_at(&mut marks, 0)?;
        Ok(marks.chunks_exact(MARK_BYTES).filter(|mark| mark.iter().any(|&byte| byte != 0)).count())
    }

    fn mark(&self, row: usize) -> Option<[u8; MARK_BYTES]> {
        let mut mark = [0; MARK_BYTES];
        self.marks.read_exact_at(&mut mark, (row * MARK_BYTES) as u64).ok()?;
        (mark != [0; MARK_BYTES]).then_some(mark)
    }

    /// The mark of a row with this content; never zero.
    fn hash(&self, row: usize, bytes: &[u8]) -> [u8; MARK_BYTES] {
        let hash = blake3::Hasher::new_keyed(&self.key).update(&(row as u64).to_le_bytes()).update(bytes).finalize();
        let mut mark = [0; MARK_BYTES];
        mark.copy_from_slice(&hash.as_bytes()[..MARK_BYTES]);
        mark[0] |= 1;
        mark
    }

    /// The present version of the file.
    fn version(&self) -> u32 {
        let now = changed(&self.file);
        if self.changed.swap(now, Ordering::AcqRel) == now {
            return self.version.load(Ordering::Acquire);
        }
        // After 2^32 changes, a row could count as checked that was checked long ago.
        self.version.fetch_add(1, Ordering::AcqRel) + 1
    }
}

/// The time of the last change of a file, in nanoseconds.
fn changed(file: &File) -> i64 {
    file.metadata()
        .map_or(0, |metadata| metadata.mtime().wrapping_mul(1_000_000_000).wrapping_add(metadata.mtime_nsec()))
}

impl RowCache for DiskRowCache {
    fn get(&self, row: usize, out: &mut [u8]) -> bool {
        let (version, state) = (self.version(), self.states[row].load(Ordering::Acquire));
        // A process that does not fill the cache checks again, because the filling process may have added the row.
        if state == ABSENT && self.fills {
            return false;
        }
        let read = |out: &mut [u8]| self.file.read_exact_at(out, (row * self.row_bytes) as u64).is_ok();
        let intact = if state == version {
            read(out)
        } else {
            self.mark(row).is_some_and(|mark| read(out) && self.hash(row, out) == mark)
        };
        self.states[row].store(if intact { version } else { ABSENT }, Ordering::Release);
        intact
    }

    fn put(&self, row: usize, bytes: &[u8]) {
        let version = self.version();
        if !self.fills || self.states[row].load(Ordering::Acquire) == version || !self.budget.take(bytes.len()) {
            return;
        }
        // If writing fails, for example because the disk is full, the row is not cached.
        let written = self.file.write_all_at(bytes, (row * self.row_bytes) as u64).is_ok()
            && self.marks.write_all_at(&self.hash(row, bytes), (row * MARK_BYTES) as u64).is_ok();
        if written {
            self.changed.store(changed(&self.file), Ordering::Release);
            self.states[row].store(version, Ordering::Release);
        }
    }
}
