//! A cache of decoded rows in memory-mapped files.
//!
//! The cache of a column consists of two files, in a folder named after the dataset's content hash. `COLUMN.rows`
//! stores row `r` at `r * row_bytes`; rows that are not cached are file holes, which take no disk space. `COLUMN.marks`
//! stores eight bytes per row, its mark: zero, or the first bytes of the BLAKE3 hash of the row, with the lowest bit
//! set.
//!
//! A row is written before its mark, and each process verifies the mark when it first reads the row. A row that was
//! only half written at a power failure, or that was changed later, is therefore decoded again. A dataset with changed
//! content has another folder name and starts with an empty cache.
//!
//! The process that holds the lock on the marks file fills the cache; other processes only read it.

use super::{Budget, RowCache};
use memmap2::Mmap;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use swm_core::{ColumnSpec, Error, Result, files};

/// Size of a mark in bytes.
const MARK_BYTES: usize = 8;

/// State of a row whose mark this process has not checked.
const UNKNOWN: u8 = 0;
/// State of a row that matches its mark.
const VALID: u8 = 1;
/// State of a row that has no mark, or does not match its mark.
const ABSENT: u8 = 2;

/// Cached rows of a column in a memory-mapped file.
pub struct DiskRowCache {
    map: Mmap,
    file: File,
    marks: File,
    row_bytes: usize,
    /// State of each row in this process: [`UNKNOWN`], [`VALID`] or [`ABSENT`].
    states: Vec<AtomicU8>,
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
        let map = map(&file).map_err(|e| Error::io(&folder, "mapping the cache", e))?;
        let cache = Self {
            map,
            file,
            marks,
            row_bytes,
            states: (0..rows).map(|_| AtomicU8::new(UNKNOWN)).collect(),
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

    fn row(&self, row: usize) -> &[u8] {
        &self.map[row * self.row_bytes..(row + 1) * self.row_bytes]
    }
}

impl RowCache for DiskRowCache {
    fn get(&self, row: usize, out: &mut [u8]) -> bool {
        match self.states[row].load(Ordering::Acquire) {
            VALID => {
                out.copy_from_slice(self.row(row));
                return true;
            }
            // A process that does not fill the cache checks again, because the filling process may have added the row.
            ABSENT if self.fills => return false,
            _ => {}
        }
        let Some(mark) = self.mark(row) else {
            self.states[row].store(ABSENT, Ordering::Release);
            return false;
        };
        out.copy_from_slice(self.row(row));
        let intact = hash(out) == mark;
        self.states[row].store(if intact { VALID } else { ABSENT }, Ordering::Release);
        intact
    }

    fn put(&self, row: usize, bytes: &[u8]) {
        if !self.fills || self.states[row].load(Ordering::Acquire) == VALID || !self.budget.take(bytes.len()) {
            return;
        }
        // If writing fails, for example because the disk is full, the row is not cached.
        let written = self.file.write_all_at(bytes, (row * self.row_bytes) as u64).is_ok()
            && self.marks.write_all_at(&hash(bytes), (row * MARK_BYTES) as u64).is_ok();
        if written {
            self.states[row].store(VALID, Ordering::Release);
        }
    }
}

/// The mark of a row; never zero.
fn hash(bytes: &[u8]) -> [u8; MARK_BYTES] {
    let mut mark = [0; MARK_BYTES];
    mark.copy_from_slice(&blake3::hash(bytes).as_bytes()[..MARK_BYTES]);
    mark[0] |= 1;
    mark
}

#[allow(unsafe_code, reason = "mapping a file")]
fn map(file: &File) -> std::io::Result<Mmap> {
    // SAFETY: the cache owns the file. Its size follows from the dataset's content and is set before any process maps
    // it, so the file never shrinks while it is mapped. A row is written once, before its mark, and only marked rows
    // are read. A row that does not match its mark is copied and compared, but not used.
    unsafe { Mmap::map(file) }
}
