//! Byte access to a local file or an object in a store.

use crate::dataset::Location;
use crate::dataset::objects::{Bytes, ObjectFile};
use crate::formats::opened::{self, State};
use hdf5_pure::FormatError;
use std::collections::{BTreeSet, HashMap, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result, files};

/// Size of a cached block of a remote file, in bytes.
const BLOCK: u64 = 256 << 10;
/// Maximum number of cached blocks of a remote file.
const CACHED_BLOCKS: usize = 256;
/// Size of the largest file whose blocks are all cached, in bytes.
const CACHE_BYTES: u64 = CACHED_BLOCKS as u64 * BLOCK;
/// Size of the longest range that is read through the blocks of a larger file, in bytes.
const LONGEST_CACHED_RANGE: u64 = 1 << 20;
/// Maximum ratio of the bytes of blocks to the bytes that are asked for, in a larger file.
const MAX_OVERHEAD: u64 = 4;

/// A readable file. Clones share the open file.
#[derive(Clone)]
pub(super) struct Source(Arc<Kind>);

enum Kind {
    Local { file: File, path: PathBuf, len: AtomicU64 },
    Remote { file: ObjectFile, label: PathBuf, blocks: Mutex<Blocks> },
}

/// Cached blocks of a remote file, for the many small reads of its structure and of chunks that several reads share.
#[derive(Default)]
struct Blocks {
    by_index: HashMap<u64, Bytes>,
    /// Block indices, oldest first.
    order: VecDeque<u64>,
}

impl Source {
    /// Opens a file.
    ///
    /// # Errors
    /// If the file does not exist or cannot be read.
    pub fn open(location: &Location) -> Result<Self> {
        let Some(path) = location.path() else {
            let file = ObjectFile::open(location)?;
            return Ok(Self(Arc::new(Kind::Remote { file, label: location.label(), blocks: Mutex::default() })));
        };
        if !files::exists(path)? {
            let fix = "check the path; `swm datasets` lists the stored datasets";
            return Err(Error::corrupt(path, "there is no such dataset", fix));
        }
        Self::of(files::open(path)?, path)
    }

    /// Wraps an open local file, with the present size of the file.
    pub fn of(file: File, path: &Path) -> Result<Self> {
        let len = file.metadata().map_err(|e| Error::io(path, "reading the size of the file", e))?.len();
        Ok(Self(Arc::new(Kind::Local { file, path: path.to_owned(), len: AtomicU64::new(len) })))
    }

    /// The path or address of the file, for error messages.
    pub fn label(&self) -> &Path {
        match &*self.0 {
            Kind::Local { path, .. } => path,
            Kind::Remote { label, .. } => label,
        }
    }

    /// Size in bytes, as far as it is known: a writer may append to a local file.
    pub fn size(&self) -> u64 {
        match &*self.0 {
            Kind::Local { len, .. } => len.load(Ordering::Relaxed),
            Kind::Remote { file, .. } => file.len(),
        }
    }

    /// Whether the file has the bytes before `end`. Asks a local file for its size again if it was shorter.
    pub fn reaches(&self, end: u64) -> bool {
        if let Kind::Local { file, len, .. } = &*self.0
            && end > len.load(Ordering::Relaxed)
            && let Ok(metadata) = file.metadata()
        {
            len.store(metadata.len(), Ordering::Relaxed);
        }
        end <= self.size()
    }

    /// What changes whenever an open local file is written to; `None` for an object in a store.
    pub fn state(&self) -> Option<State> {
        match &*self.0 {
            Kind::Local { file, .. } => opened::state_of(&file.metadata().ok()?),
            Kind::Remote { .. } => None,
        }
    }

    /// The same local file with its present size; an object in a store as it is.
    ///
    /// # Errors
    /// If the file cannot be accessed.
    pub fn with_present_size(&self) -> Result<Self> {
        match &*self.0 {
            Kind::Local { file, path, .. } => {
                Self::of(file.try_clone().map_err(|e| Error::io(path, "opening it again", e))?, path)
            }
            Kind::Remote { .. } => Ok(self.clone()),
        }
    }

    /// Whether the file is in an object store. Requests to a store are slow and should run concurrently.
    pub fn is_remote(&self) -> bool {
        matches!(&*self.0, Kind::Remote { .. })
    }

    /// Reads the bytes from `offset` on.
    ///
    /// # Errors
    /// If the file is shorter, or reading fails.
    pub fn read(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        if !offset.checked_add(out.len() as u64).is_some_and(|end| self.reaches(end)) {
            let given = format!("{} bytes from byte {offset}", out.len());
            return Err(Error::mismatch(
                format!("reading {}", self.label().display()),
                given,
                format!("bytes below {}", self.size()),
            ));
        }
        match &*self.0 {
            Kind::Local { file, path, .. } => {
                file.read_exact_at(out, offset).map_err(|e| Error::io(path, "reading the file", e))
            }
            Kind::Remote { file, blocks, .. } => {
                let range = offset..offset + out.len() as u64;
                let found = cached_blocks(file, blocks, std::slice::from_ref(&range))?;
                copy_from_blocks(&found, &range, out);
                Ok(())
            }
        }
    }

    /// Reads all ranges of a remote file concurrently, returned in the given order. Returns an empty list for a local
    /// file. Ranges of a small file are read through the cached blocks, and those of a larger one that later reads share
    /// and that fill much of the blocks.
    ///
    /// # Errors
    /// As [`Source::read`].
    pub fn fetch(&self, ranges: &[Range<u64>], are_shared: bool) -> Result<Vec<Bytes>> {
        let Kind::Remote { file, blocks, .. } = &*self.0 else { return Ok(vec![]) };
        let exists = |range: &Range<u64>| range.start < range.end && range.end <= file.len();
        let is_cached = ranges.iter().all(exists)
            && ranges.iter().map(|range| range.end - range.start).sum::<u64>() <= CACHE_BYTES
            && (file.len() <= CACHE_BYTES || (are_shared && fill_blocks(ranges)));
        if !is_cached {
            return file.read(ranges);
        }
        let found = cached_blocks(file, blocks, ranges)?;
        let bytes = ranges.iter().map(|range| {
            let mut bytes = vec![0; (range.end - range.start) as usize];
            copy_from_blocks(&found, range, &mut bytes);
            Bytes::from(bytes)
        });
        Ok(bytes.collect())
    }
}

/// The indices of the blocks that a range overlaps.
fn indices(range: &Range<u64>) -> Range<u64> {
    range.start / BLOCK..range.end.div_ceil(BLOCK)
}

/// Whether ranges of a large file are short, and fill much of the blocks that they overlap.
fn fill_blocks(ranges: &[Range<u64>]) -> bool {
    let bytes: u64 = ranges.iter().map(|range| range.end - range.start).sum();
    let blocks: BTreeSet<u64> = ranges.iter().flat_map(indices).collect();
    ranges.iter().all(|range| range.end - range.start <= LONGEST_CACHED_RANGE)
        && blocks.len() as u64 * BLOCK <= CACHE_BYTES.min(MAX_OVERHEAD * bytes)
}

/// Returns the blocks that the ranges overlap. Those that are not cached are fetched together, and cached.
fn cached_blocks(file: &ObjectFile, blocks: &Mutex<Blocks>, ranges: &[Range<u64>]) -> Result<HashMap<u64, Bytes>> {
    let lock = || blocks.lock().unwrap_or_else(PoisonError::into_inner);
    let (mut found, mut missing) = (HashMap::new(), BTreeSet::new());
    {
        let cached = lock();
        for index in ranges.iter().flat_map(indices) {
            match cached.by_index.get(&index) {
                Some(block) => drop(found.insert(index, block.clone())),
                None => drop(missing.insert(index)),
            }
        }
    }
    if missing.is_empty() {
        return Ok(found);
    }
    let requests: Vec<Range<u64>> =
        missing.iter().map(|index| index * BLOCK..((index + 1) * BLOCK).min(file.len())).collect();
    let fetched = file.read(&requests)?;
    let mut cached = lock();
    for (index, bytes) in missing.into_iter().zip(fetched) {
        // A slice would keep the whole response in memory.
        let block = Bytes::copy_from_slice(&bytes);
        found.insert(index, block.clone());
        if cached.by_index.insert(index, block).is_none() {
            cached.order.push_back(index);
        }
    }
    while cached.order.len() > CACHED_BLOCKS
        && let Some(oldest) = cached.order.pop_front()
    {
        cached.by_index.remove(&oldest);
    }
    Ok(found)
}

/// Copies a range from the blocks that it overlaps.
fn copy_from_blocks(found: &HashMap<u64, Bytes>, range: &Range<u64>, out: &mut [u8]) {
    for index in indices(range) {
        let start = index * BLOCK;
        let (from, to) = (range.start.max(start), range.end.min(start + BLOCK));
        out[(from - range.start) as usize..(to - range.start) as usize]
            .copy_from_slice(&found[&index][(from - start) as usize..(to - start) as usize]);
    }
}

impl hdf5_pure::Source for Source {
    /// The present size: a writer may append what the structure of the file names next.
    fn len(&self) -> u64 {
        self.reaches(u64::MAX);
        self.size()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> std::result::Result<(), FormatError> {
        self.read(offset, out).map_err(|e| FormatError::Source(e.to_string()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file that is read as an object of a store.
    fn remote(path: &Path, size: u64) -> Source {
        let file = File::create(path).expect("creating a file");
        file.set_len(size).expect("setting its size");
        file.write_all_at(b"shared", BLOCK - 3).expect("writing the file");
        let file = ObjectFile::open(&Location::from(path)).expect("opening the file");
        Source(Arc::new(Kind::Remote { file, label: path.to_owned(), blocks: Mutex::default() }))
    }

    #[test]
    fn ranges_are_cached_where_they_are_read_again() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let cached = |source: &Source| match &*source.0 {
            Kind::Remote { blocks, .. } => blocks.lock().expect("the blocks").by_index.len(),
            Kind::Local { .. } => 0,
        };
        let fetch = |source: &Source, range: Range<u64>, are_shared: bool| {
            source.fetch(std::slice::from_ref(&range), are_shared)
        };
        let range = BLOCK - 3..BLOCK + 3;
        let large = remote(&folder.path().join("large"), CACHE_BYTES + 9);
        for (range, are_shared, blocks) in [
            (range.clone(), false, 0),
            (0..LONGEST_CACHED_RANGE + 1, true, 0),
            (range.clone(), true, 0),
            (BLOCK / 2..BLOCK * 3 / 2, true, 2),
            (CACHE_BYTES - BLOCK..CACHE_BYTES + 9, true, 4),
        ] {
            let read = fetch(&large, range.clone(), are_shared).expect("reading a range");
            assert_eq!((read[0].len() as u64, cached(&large)), (range.end - range.start, blocks), "{range:?}");
        }
        // Many blocks for a few bytes of each are not fetched.
        let scattered: Vec<Range<u64>> = (0..100).map(|i| 2 * i * BLOCK..2 * i * BLOCK + (4 << 10)).collect();
        let read = large.fetch(&scattered, true).expect("reading scattered ranges");
        assert!(read.iter().all(|bytes| bytes.len() == 4 << 10) && cached(&large) == 4);
        let small = remote(&folder.path().join("small"), CACHE_BYTES);
        for source in [&large, &small] {
            assert_eq!(source.fetch(&[range.clone(), 0..9], false).expect("reading ranges")[0], b"shared"[..]);
            assert!(fetch(source, CACHE_BYTES..CACHE_BYTES + 10, true).is_err(), "beyond the end");
        }
        assert_eq!(cached(&small), 2);
        // The oldest blocks are dropped.
        for index in 0..CACHED_BLOCKS as u64 {
            large.read(index * BLOCK, &mut [0]).expect("reading a block");
        }
        assert_eq!(cached(&large), CACHED_BLOCKS);
    }
}
