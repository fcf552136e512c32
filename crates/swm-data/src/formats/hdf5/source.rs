//! Byte access to a local file or an object in a store.

use crate::dataset::Location;
use crate::dataset::objects::{Bytes, ObjectFile};
use crate::formats::opened::{self, State};
use hdf5_pure::FormatError;
use std::collections::{HashMap, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result, files};

/// Block size for reading the structure of a remote file, in bytes.
const BLOCK: u64 = 256 << 10;
/// Maximum number of cached blocks of a remote file.
const CACHED_BLOCKS: usize = 256;

/// A readable file. Clones share the open file.
#[derive(Clone)]
pub(super) struct Source(Arc<Kind>);

enum Kind {
    Local { file: File, path: PathBuf, len: AtomicU64 },
    Remote { file: ObjectFile, label: PathBuf, blocks: Mutex<Blocks> },
}

/// Cached blocks of a remote file, for the many small reads of its structure.
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
        if !path.exists() {
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
                let mut at = offset;
                let mut rest = out;
                while !rest.is_empty() {
                    let index = at / BLOCK;
                    let block = block(file, blocks, index)?;
                    let begin = (at - index * BLOCK) as usize;
                    let size = rest.len().min(block.len() - begin);
                    let (now, later) = rest.split_at_mut(size);
                    now.copy_from_slice(&block[begin..begin + size]);
                    (at, rest) = (at + size as u64, later);
                }
                Ok(())
            }
        }
    }

    /// Reads all ranges of a remote file concurrently, returned in the given order. Returns an empty list for a local
    /// file.
    ///
    /// # Errors
    /// As [`Source::read`].
    pub fn fetch(&self, ranges: &[Range<u64>]) -> Result<Vec<Bytes>> {
        match &*self.0 {
            Kind::Local { .. } => Ok(vec![]),
            Kind::Remote { file, .. } => file.read(ranges),
        }
    }
}

fn block(file: &ObjectFile, blocks: &Mutex<Blocks>, index: u64) -> Result<Bytes> {
    let lock = || blocks.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(block) = lock().by_index.get(&index) {
        return Ok(block.clone());
    }
    let range = index * BLOCK..((index + 1) * BLOCK).min(file.len());
    let block = file.read(&[range])?.pop().unwrap_or_default();
    let mut cached = lock();
    if cached.by_index.insert(index, block.clone()).is_none() {
        cached.order.push_back(index);
        if cached.order.len() > CACHED_BLOCKS
            && let Some(oldest) = cached.order.pop_front()
        {
            cached.by_index.remove(&oldest);
        }
    }
    Ok(block)
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
