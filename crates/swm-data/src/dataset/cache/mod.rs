//! Caches of decoded rows: in memory, or on disk, where the operating system's page cache serves as memory.
//!
//! A cache stores rows in the order in which they are first read, up to its limit in bytes, and never evicts a row. A
//! loader reads every row about once per epoch in random order, so the least recently used row is as likely to be read
//! next as any other row. Eviction would not add hits, but would cost a copy for every miss.

mod disk;
mod memory;

use crate::dataset::episodes::EpisodeRows;
use crate::dataset::reader::{Constants, Episode, Irregularity, Reader, StepRange};
use disk::DiskRowCache;
use memory::MemoryRowCache;
use std::cell::RefCell;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock};
use swm_core::{ColumnSpec, Manifest, Result, Schema};

/// Storage and size limit of a cache of decoded rows.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum CacheConfig {
    /// No cache: every row is decoded whenever it is read.
    #[default]
    Off,
    /// Rows of all columns are cached in memory.
    Memory {
        /// Maximum size in bytes.
        bytes: usize,
    },
    /// Images are cached in files, in a subfolder named after the dataset's content hash; columns without images, which
    /// are small, are cached in memory. If several processes use the same files, one process fills them and all
    /// processes read them.
    Disk {
        /// The folder; several datasets may share it.
        folder: PathBuf,
        /// Maximum size for this dataset, in bytes.
        bytes: usize,
    },
}

impl CacheConfig {
    /// Wraps a reader with a cache for `columns`.
    ///
    /// # Errors
    /// If a column does not exist, the dataset's content cannot be hashed, or the folder cannot be written.
    pub fn over(&self, reader: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
        self.wrap(reader, columns, ColumnSpec::is_image)
    }

    /// As [`CacheConfig::over`], for columns that are expensive to read: each row is cached as images are, whatever its
    /// size.
    ///
    /// # Errors
    /// As [`CacheConfig::over`].
    pub fn by_row(&self, reader: Arc<dyn Reader>, columns: &[&str]) -> Result<Arc<dyn Reader>> {
        self.wrap(reader, columns, |_| true)
    }

    fn wrap(
        &self,
        reader: Arc<dyn Reader>,
        columns: &[&str],
        by_row: fn(&ColumnSpec) -> bool,
    ) -> Result<Arc<dyn Reader>> {
        let bytes = match *self {
            Self::Off => return Ok(reader),
            Self::Memory { bytes } | Self::Disk { bytes, .. } => bytes,
        };
        let budget = Arc::new(Budget { left: AtomicUsize::new(bytes) });
        let mut rows_of_episodes = EpisodeRows::default();
        reader.episodes().iter().for_each(|episode| rows_of_episodes.push(episode.length));
        let rows = rows_of_episodes.total() as usize;
        let mut caches: Vec<ColumnCache> = reader.schema().columns().iter().map(|_| ColumnCache::Uncached).collect();
        let mut identity = None;
        for name in columns {
            let index = reader.schema().index(name)?;
            let spec = &reader.schema().columns()[index];
            caches[index] = match self {
                // Columns without images are cached as a whole if they fit into the budget, because caching their small
                // rows one by one costs more than reading them.
                _ if !by_row(spec) => match budget.take(rows.saturating_mul(spec.row_bytes())) {
                    true => ColumnCache::Whole(OnceLock::new(), Mutex::default()),
                    false => ColumnCache::Uncached,
                },
                Self::Disk { folder, .. } => {
                    let identity = match &identity {
                        Some(identity) => identity,
                        None => identity.insert(reader.cache_key()?),
                    };
                    ColumnCache::ByRow(Box::new(DiskRowCache::open(folder, identity, spec, rows, Arc::clone(&budget))?))
                }
                _ => ColumnCache::ByRow(Box::new(MemoryRowCache::new(rows, Arc::clone(&budget)))),
            };
        }
        Ok(Arc::new(CachedReader { inner: reader, rows_of_episodes, columns: caches }))
    }
}

/// Remaining bytes of a cache.
pub(crate) struct Budget {
    left: AtomicUsize,
}

impl Budget {
    /// Reserves `bytes` if enough bytes are left, and returns whether it reserved them.
    fn take(&self, bytes: usize) -> bool {
        self.left.fetch_update(Ordering::Relaxed, Ordering::Relaxed, |left| left.checked_sub(bytes)).is_ok()
    }
}

/// Cached rows of one column. Several threads may use a cache at the same time.
trait RowCache: Send + Sync {
    /// Copies a row to `out` if it is cached, and returns whether the row is cached.
    fn get(&self, row: usize, out: &mut [u8]) -> bool;

    /// Caches a row if the budget allows. Failing to cache is not an error, because the row can be decoded again.
    fn put(&self, row: usize, bytes: &[u8]);
}

/// How one column is cached.
enum ColumnCache {
    /// The column is not cached.
    Uncached,
    /// The whole column is read at the first access; the mutex is held during that read.
    Whole(OnceLock<Vec<u8>>, Mutex<()>),
    /// Each row is cached when it is read.
    ByRow(Box<dyn RowCache>),
}

/// A reader that caches the rows of another reader.
struct CachedReader {
    inner: Arc<dyn Reader>,
    /// First row and length of every episode; rows are counted over the whole dataset.
    rows_of_episodes: EpisodeRows,
    /// One entry per column of the schema.
    columns: Vec<ColumnCache>,
}

impl CachedReader {
    /// The rows of a range, counted over the whole dataset, if they exist.
    fn rows(&self, range: &StepRange) -> Option<Range<usize>> {
        self.rows_of_episodes.range(range).ok().map(|rows| rows.start as usize..rows.end as usize)
    }

    /// The bytes of a column that is cached as a whole. The first call reads the column.
    fn whole_column<'a>(&self, column: &str, cache: &'a OnceLock<Vec<u8>>, reading: &Mutex<()>) -> Result<&'a [u8]> {
        if let Some(bytes) = cache.get() {
            return Ok(bytes);
        }
        let _reading = crate::dataset::sync::lock(reading);
        if let Some(bytes) = cache.get() {
            return Ok(bytes);
        }
        let episodes = self.inner.episodes();
        let all: Vec<StepRange> = (0..episodes.len()).map(|i| StepRange::new(i, 0, episodes[i].length)).collect();
        let rows = self.rows_of_episodes.total() as usize;
        let mut bytes = vec![0; rows * self.schema().column(column)?.row_bytes()];
        self.inner.read_column(column, &all, &mut bytes)?;
        Ok(cache.get_or_init(|| bytes))
    }
}

thread_local! {
    /// Buffer of a loader thread for rows that are not cached. Allocating a buffer for each batch would take as long as
    /// decoding.
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
        let requested: usize = ranges.iter().map(|range| range.length).sum();
        let valid = out.len() == requested * n && ranges.iter().all(|range| self.rows(range).is_some());
        let rows = ranges.iter().filter_map(|range| self.rows(range));
        match &self.columns[index] {
            // The inner reader reports invalid requests.
            _ if !valid => self.inner.read_column(column, ranges, out),
            ColumnCache::Uncached => self.inner.read_column(column, ranges, out),
            ColumnCache::Whole(cache, reading) => {
                let bytes = self.whole_column(column, cache, reading)?;
                let mut out = out;
                for rows in rows {
                    let (slot, rest) = out.split_at_mut(rows.len() * n);
                    slot.copy_from_slice(&bytes[rows.start * n..rows.end * n]);
                    out = rest;
                }
                Ok(())
            }
            ColumnCache::ByRow(cache) => {
                // `(position in the output, row, range of that row)` of all rows that are not cached.
                let mut missing: Vec<(usize, usize, StepRange)> = vec![];
                let mut slot = 0;
                for (range, rows) in ranges.iter().zip(rows) {
                    for (i, row) in rows.enumerate() {
                        if !cache.get(row, &mut out[slot * n..(slot + 1) * n]) {
                            missing.push((slot, row, StepRange::new(range.episode, range.start + i, 1)));
                        }
                        slot += 1;
                    }
                }
                if missing.is_empty() {
                    return Ok(());
                }
                let ranges: Vec<StepRange> = missing.iter().map(|&(_, _, range)| range).collect();
                if missing.len() == requested {
                    self.inner.read_column(column, &ranges, out)?;
                    missing.iter().zip(out.chunks_exact(n)).for_each(|((_, row, _), bytes)| cache.put(*row, bytes));
                    return Ok(());
                }
                // Takes the buffer out of the cell while it is in use, because the inner reader may also be a cache.
                let mut decoded = DECODED.take();
                decoded.resize(missing.len() * n, 0);
                let read = self.inner.read_column(column, &ranges, &mut decoded);
                for ((slot, row, _), bytes) in missing.iter().zip(decoded.chunks_exact(n)).filter(|_| read.is_ok()) {
                    out[slot * n..(slot + 1) * n].copy_from_slice(bytes);
                    cache.put(*row, bytes);
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

    fn check_files(&self) -> Result<()> {
        self.inner.check_files()
    }

    fn sources(&self) -> Vec<PathBuf> {
        self.inner.sources()
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

    fn cache_key(&self) -> Result<String> {
        self.inner.cache_key()
    }
}
