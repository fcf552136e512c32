//! Where the bytes of a file come from: this machine or an object store.

use crate::dataset::Location;
use crate::dataset::objects::{Bytes, ObjectFile};
use hdf5_pure::FormatError;
use std::collections::{HashMap, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Result};

/// The structure of a remote file is fetched in pieces of this size,
const PIECE: u64 = 256 << 10;
/// of which so many are kept.
const KEPT: usize = 256;

/// The bytes of a file. Cheap to clone.
#[derive(Clone)]
pub(super) struct Source(Arc<Kind>);

enum Kind {
    Local { file: File, path: PathBuf, len: u64 },
    Remote { file: ObjectFile, label: PathBuf, pieces: Mutex<ObjectRanges> },
}

/// ObjectRanges of a remote file, for the many small reads that its structure takes.
#[derive(Default)]
struct ObjectRanges {
    by_number: HashMap<u64, Bytes>,
    /// Oldest first.
    order: VecDeque<u64>,
}

impl Source {
    /// Opens a file.
    ///
    /// # Errors
    /// When there is none, or it cannot be read.
    pub fn open(location: &Location) -> Result<Self> {
        let Some(path) = location.path() else {
            let file = ObjectFile::open(location)?;
            return Ok(Self(Arc::new(Kind::Remote { file, label: location.label(), pieces: Mutex::default() })));
        };
        let file = File::open(path).map_err(|e| match e.kind() {
            std::io::ErrorKind::NotFound => {
                Error::corrupt(path, "there is no such dataset", "check the path; `swm datasets` lists those at home")
            }
            _ => Error::io(path, "opening the file", e),
        })?;
        Self::of(file, path)
    }

    /// The bytes of an open file, as many as it has now.
    pub fn of(file: File, path: &Path) -> Result<Self> {
        let len = file.metadata().map_err(|e| Error::io(path, "reading its size", e))?.len();
        Ok(Self(Arc::new(Kind::Local { file, path: path.to_owned(), len })))
    }

    /// What messages call the file.
    pub fn label(&self) -> &Path {
        match &*self.0 {
            Kind::Local { path, .. } => path,
            Kind::Remote { label, .. } => label,
        }
    }

    /// How many bytes it has.
    pub fn size(&self) -> u64 {
        match &*self.0 {
            Kind::Local { len, .. } => *len,
            Kind::Remote { file, .. } => file.len(),
        }
    }

    /// Whether a request takes so long that many should be made at once.
    pub fn is_remote(&self) -> bool {
        matches!(&*self.0, Kind::Remote { .. })
    }

    /// The bytes from `offset` on.
    ///
    /// # Errors
    /// When there are not as many, or the disk or the store fails.
    pub fn read(&self, offset: u64, out: &mut [u8]) -> Result<()> {
        if offset.checked_add(out.len() as u64).is_none_or(|end| end > self.size()) {
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
            Kind::Remote { file, pieces, .. } => {
                let mut at = offset;
                let mut rest = out;
                while !rest.is_empty() {
                    let number = at / PIECE;
                    let piece = piece(file, pieces, number)?;
                    let begin = (at - number * PIECE) as usize;
                    let size = rest.len().min(piece.len() - begin);
                    let (now, later) = rest.split_at_mut(size);
                    now.copy_from_slice(&piece[begin..begin + size]);
                    (at, rest) = (at + size as u64, later);
                }
                Ok(())
            }
        }
    }

    /// All ranges of a remote file at once, in the given order; of a local one nothing.
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

fn piece(file: &ObjectFile, pieces: &Mutex<ObjectRanges>, number: u64) -> Result<Bytes> {
    let lock = || pieces.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(piece) = lock().by_number.get(&number) {
        return Ok(piece.clone());
    }
    let range = number * PIECE..((number + 1) * PIECE).min(file.len());
    let piece = file.read(&[range])?.pop().unwrap_or_default();
    let mut kept = lock();
    if kept.by_number.insert(number, piece.clone()).is_none() {
        kept.order.push_back(number);
        if kept.order.len() > KEPT
            && let Some(oldest) = kept.order.pop_front()
        {
            kept.by_number.remove(&oldest);
        }
    }
    Ok(piece)
}

impl hdf5_pure::Source for Source {
    fn len(&self) -> u64 {
        self.size()
    }

    fn read_at(&self, offset: u64, out: &mut [u8]) -> std::result::Result<(), FormatError> {
        self.read(offset, out).map_err(|e| FormatError::Source(e.to_string()))
    }
}
