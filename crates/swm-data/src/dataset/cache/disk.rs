//! Rows in a file that is mapped into memory.
//!
//! A cache is two files in a folder that is named by the dataset's content hash: `COLUMN.rows`, where row `r` lies at `r *
//! row_bytes` (rows that are not kept are holes and take no space), and `COLUMN.marks`, eight bytes a row: zero, or the
//! beginning of the BLAKE3 hash of the row's bytes. A row is written first and marked afterwards, and its mark is compared
//! when a process meets it for the first time. So a row that was half written when the power went, or that somebody
//! changed, is decoded again instead of being believed; and as the name follows the content, a dataset that changed finds
//! no cache at all.
//!
//! Who holds the lock on the marks fills the cache; others read what they find.

use super::{Budget, KeptRows};
use memmap2::Mmap;
use std::fs::{File, OpenOptions};
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use swm_core::{ColumnSpec, Error, Result};

/// Bytes of a mark.
const MARK: usize = 8;

/// What this process knows of a row.
const UNKNOWN: u8 = 0;
const SOUND: u8 = 1;
const ABSENT: u8 = 2;

/// Rows of a column in a mapped file.
pub struct DiskRows {
    map: Mmap,
    file: File,
    marks: File,
    row_bytes: usize,
    known: Vec<AtomicU8>,
    /// Whether this process fills the cache.
    fills: bool,
    budget: Arc<Budget>,
}

impl DiskRows {
    /// Opens the cache of a column, or makes it.
    pub fn open(folder: &Path, identity: &str, column: &ColumnSpec, rows: usize, budget: Arc<Budget>) -> Result<Self> {
        let folder = folder.join(identity);
        std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, "making the cache's folder", e))?;
        // Column names may hold what file names may not.
        let name = &blake3::hash(column.name.as_bytes()).to_hex()[..16];
        let open = |suffix: &str, size: usize| {
            let path = folder.join(format!("{name}.{suffix}"));
            let io = |e| Error::io(&path, "opening the cache", e);
            let file =
                OpenOptions::new().read(true).write(true).create(true).truncate(false).open(&path).map_err(io)?;
            if file.metadata().map_err(io)?.len() != size as u64 {
                file.set_len(size as u64).map_err(io)?;
            }
            Ok(file)
        };
        let row_bytes = column.row_bytes();
        let (file, marks) = (open("rows", rows * row_bytes)?, open("marks", rows * MARK)?);
        let fills = marks.try_lock().is_ok();
        let map = map(&file).map_err(|e| Error::io(&folder, "mapping the cache", e))?;
        let cache = Self {
            map,
            file,
            marks,
            row_bytes,
            known: (0..rows).map(|_| AtomicU8::new(UNKNOWN)).collect(),
            fills,
            budget,
        };
        // What is kept already counts.
        let kept = cache.marked().map_err(|e| Error::io(&folder, "reading the cache's marks", e))?;
        for _ in 0..kept {
            cache.budget.take(row_bytes);
        }
        Ok(cache)
    }

    /// How many rows are marked.
    fn marked(&self) -> std::io::Result<usize> {
        let mut marks = vec![0; self.known.len() * MARK];
        self.marks.read_exact_at(&mut marks, 0)?;
        Ok(marks.chunks_exact(MARK).filter(|mark| mark.iter().any(|&byte| byte != 0)).count())
    }

    fn mark(&self, row: usize) -> Option<[u8; MARK]> {
        let mut mark = [0; MARK];
        self.marks.read_exact_at(&mut mark, (row * MARK) as u64).ok()?;
        (mark != [0; MARK]).then_some(mark)
    }

    fn row(&self, row: usize) -> &[u8] {
        &self.map[row * self.row_bytes..(row + 1) * self.row_bytes]
    }
}

impl KeptRows for DiskRows {
    fn get(&self, row: usize, out: &mut [u8]) -> bool {
        match self.known[row].load(Ordering::Acquire) {
            SOUND => {
                out.copy_from_slice(self.row(row));
                return true;
            }
            // Who does not fill looks again: the other process may have come by.
            ABSENT if self.fills => return false,
            _ => {}
        }
        let Some(mark) = self.mark(row) else {
            self.known[row].store(ABSENT, Ordering::Release);
            return false;
        };
        out.copy_from_slice(self.row(row));
        let sound = hash(out) == mark;
        self.known[row].store(if sound { SOUND } else { ABSENT }, Ordering::Release);
        sound
    }

    fn put(&self, row: usize, bytes: &[u8]) {
        if !self.fills || self.known[row].load(Ordering::Acquire) == SOUND || !self.budget.take(bytes.len()) {
            return;
        }
        // A full disk, say: the row is simply not kept.
        let written = self.file.write_all_at(bytes, (row * self.row_bytes) as u64).is_ok()
            && self.marks.write_all_at(&hash(bytes), (row * MARK) as u64).is_ok();
        if written {
            self.known[row].store(SOUND, Ordering::Release);
        }
    }
}

/// The mark of a row: never zero.
fn hash(bytes: &[u8]) -> [u8; MARK] {
    let mut mark = [0; MARK];
    mark.copy_from_slice(&blake3::hash(bytes).as_bytes()[..MARK]);
    mark[0] |= 1;
    mark
}

#[allow(unsafe_code)]
fn map(file: &File) -> std::io::Result<Mmap> {
    // SAFETY: the file is ours, and as long as it is mapped it is neither made shorter (it has the size that the dataset's
    // content gives it before anybody maps it) nor changed where a row was handed out: a row is written once, before it
    // is marked, and read only when it is marked. A row whose bytes do not fit its mark is copied, compared and not used.
    unsafe { Mmap::map(file) }
}
