//! Decoded rows that are kept, so that they need not be decoded again: in memory, or on disk where the system's page
//! cache holds as much of them as memory allows.
//!
//! A cache is filled by whoever reads, first come, first kept, up to its limit in bytes; nothing is ever replaced. A
//! loader asks for every row about once an epoch, in a new order each time: what was used least recently is then no
//! less likely to come next than anything else. Replacing would keep no more hits, and cost a copy for every miss.

mod disk;
mod memory;

use crate::dataset::episodes::Rows;
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use disk::DiskRows;
use memory::MemoryRows;
use std::cell::RefCell;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock};
use swm_core::{Manifest, Result, Schema};

/// Where decoded rows are kept.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum CacheConfig {
    /// Nowhere: every row is decoded whenever it is asked for.
    #[default]
    Off,
    /// In memory.
    Memory {
        /// How much, in bytes.
        bytes: usize,
    },
    /// Pictures in files below a folder, named by the content they belong to; other columns, which are small, in
    /// memory. Of several processes with the same files one fills them, and all read what is there.
    Disk {
        /// The folder, shared by any number of datasets.
        folder: PathBuf,
        /// How much of this dataset, in bytes.
        bytes: usize,
    },
}

impl CacheConfig {
    /// A reader that keeps what it reads of these columns.
    ///
    /// # Errors
    /// When a column does not exist, the dataset's content cannot be hashed, or the folder cannot be written.
    pub fn over(&self, reader: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
        let bytes = match *self {
            Self::Off => return Ok(reader),
            Self::Memory { bytes } | Self::Disk { bytes, .. } => bytes,
        };
        let budget = Arc::new(Budget { left: AtomicUsize::new(bytes) });
        let mut places = Rows::default();
        reader.episodes().iter().for_each(|episode| places.push(episode.length));
        #[allow(clippy::cast_possible_truncation)]
        let rows = places.total() as usize;
        let mut kept: Vec<Kept> = reader.schema().columns().iter().map(|_| Kept::Not).collect();
        let mut identity = None;
        for name in columns {
            let index = reader.schema().index(name)?;
            let spec = &reader.schema().columns()[index];
            kept[index] = match self {
                // A column of numbers is read as a whole, if it fits: row by row it would be mostly bookkeeping.
                _ if !spec.is_image() => match budget.take(rows.saturating_mul(spec.row_bytes())) {
                    true => Kept::Whole(OnceLock::new(), Mutex::default()),
                    false => Kept::Not,
                },
                Self::Disk { folder, .. } => {
                    let identity = match &identity {
                        Some(identity) => identity,
                        None => identity.insert(reader.content_hash()?),
                    };
                    Kept::Rows(Box::new(DiskRows::open(folder, identity, spec, rows, Arc::clone(&budget))?))
                }
                _ => Kept::Rows(Box::new(MemoryRows::new(rows, Arc::clone(&budget)))),
            };
        }
        Ok(Arc::new(CachedReader { inner: reader, places, kept }))
    }
}

/// Bytes that may still be kept.
pub(crate) struct Budget {
    left: AtomicUsize,
}

impl Budget {
    /// Takes so many bytes if they are left.
    fn take(&self, bytes: usize) -> bool {
        self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(bytes)).is_ok()
    }
}

/// Rows of one column, kept one by one. Used by several threads at once.
trait KeptRows: Send + Sync {
    /// Copies a row, if it is kept.
    fn get(&self, row: usize, out: &mut [u8]) -> bool;

    /// Keeps a row, if there is room. That it cannot be kept is no error: it will be decoded again.
    fn put(&self, row: usize, bytes: &[u8]);
}

/// What is kept of a column.
enum Kept {
    /// Nothing.
    Not,
    /// All of it, once it was asked for; the lock is held by who reads it.
    Whole(OnceLock<Vec<u8>>, Mutex<()>),
    /// Row by row.
    Rows(Box<dyn KeptRows>),
}

/// A reader that keeps what it reads.
struct CachedReader {
    inner: Arc<dyn Reader>,
    /// Where every episode lies in the whole dataset.
    places: Rows,
    /// For every column of the schema.
    kept: Vec<Kept>,
}

impl CachedReader {
    /// The rows of a range in the whole dataset, if they exist.
    #[allow(clippy::cast_possible_truncation)]
    fn rows(&self, range: &StepRange) -> Option<Range<usize>> {
        self.places.range(range).ok().map(|rows| rows.start as usize..rows.end as usize)
    }

    /// A column as a whole.
    fn whole<'a>(&self, column: &str, kept: &'a OnceLock<Vec<u8>>, reading: &Mutex<()>) -> Result<&'a [u8]> {
        if let Some(bytes) = kept.get() {
            return Ok(bytes);
        }
        let _reading = crate::dataset::sync::lock(reading);
        if let Some(bytes) = kept.get() {
            return Ok(bytes);
        }
        let episodes = self.inner.episodes();
        let all: Vec<StepRange> = (0..episodes.len()).map(|i| StepRange::new(i, 0, episodes[i].length)).collect();
        #[allow(clippy::cast_possible_truncation)]
        let rows = self.places.total() as usize;
        let mut bytes = vec![0; rows * self.schema().column(column)?.row_bytes()];
        self.inner.read_column(column, &all, &mut bytes)?;
        Ok(kept.get_or_init(|| bytes))
    }
}

thread_local! {
    /// Where a loader's thread decodes what is not kept; fresh memory for every batch would cost as much as decoding.
    static DECODED: RefCell<Vec<u8>> = const { RefCell::new(vec![]) };
}

impl Reader for CachedReader {
    fn schema(&self) -> &Schema {
        self.inner.schema()
    }

    fn episodes(&self) -> &[Episode] {
        self.inner.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.schema().index(column)?;
        let n = self.schema().columns()[index].row_bytes();
        let wanted: usize = ranges.iter().map(|range| range.length).sum();
        let sound = out.len() == wanted * n && ranges.iter().all(|range| self.rows(range).is_some());
        let rows = ranges.iter().filter_map(|range| self.rows(range));
        match &self.kept[index] {
            // What makes no sense, the dataset itself explains best.
            _ if !sound => self.inner.read_column(column, ranges, out),
            Kept::Not => self.inner.read_column(column, ranges, out),
            Kept::Whole(kept, reading) => {
                let bytes = self.whole(column, kept, reading)?;
                let mut out = out;
                for rows in rows {
                    let (place, rest) = out.split_at_mut(rows.len() * n);
                    place.copy_from_slice(&bytes[rows.start * n..rows.end * n]);
                    out = rest;
                }
                Ok(())
            }
            Kept::Rows(kept) => {
                // The places whose row is not kept, and their rows as ranges of one.
                let mut missing: Vec<(usize, usize, StepRange)> = vec![];
                let mut place = 0;
                for (range, rows) in ranges.iter().zip(rows) {
                    for (i, row) in rows.enumerate() {
                        if !kept.get(row, &mut out[place * n..(place + 1) * n]) {
                            missing.push((place, row, StepRange::new(range.episode, range.start + i, 1)));
                        }
                        place += 1;
                    }
                }
                if missing.is_empty() {
                    return Ok(());
                }
                let ranges: Vec<StepRange> = missing.iter().map(|&(_, _, range)| range).collect();
                if missing.len() == wanted {
                    self.inner.read_column(column, &ranges, out)?;
                    missing.iter().zip(out.chunks_exact(n)).for_each(|((_, row, _), bytes)| kept.put(*row, bytes));
                    return Ok(());
                }
                // Taken while it is used: the reader below may be a cache as well.
                let mut decoded = DECODED.take();
                decoded.resize(missing.len() * n, 0);
                let read = self.inner.read_column(column, &ranges, &mut decoded);
                for ((place, row, _), bytes) in missing.iter().zip(decoded.chunks_exact(n)).filter(|_| read.is_ok()) {
                    out[place * n..(place + 1) * n].copy_from_slice(bytes);
                    kept.put(*row, bytes);
                }
                DECODED.set(decoded);
                read
            }
        }
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        self.inner.constants(episode)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        self.inner.irregularities()
    }

    fn manifest(&self) -> Option<Manifest> {
        self.inner.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.inner.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        self.inner.content_hash()
    }
}
