//! The format `hdf5`: one file, as the reference's `HDF5Dataset` and every HDF5 library read it.
//!
//! A dataset `[rows, shape…]` for each column, all episodes one after another, and `ep_len` and `ep_offset` with the
//! rows of every episode and its first row. Types, names and shapes are those of the columns.
//!
//! **Reading.** `hdf5-pure` reads the structure of a file. Chunks we read ourselves: those that a batch wants are planned
//! together, read once each, and decoded on all threads, mostly straight to their place in the batch. Any layout of
//! chunks is understood, and the filters that h5py and hdf5plugin are used with (`filters/`). `s3://` and `http://`
//! locations are read by ranges, all those of a batch at once.
//!
//! **Writing.** Pictures are chunks of one row, compressed with LZF, which h5py reads without plugins: drawn pictures take
//! a fiftieth of their space and are read faster than uncompressed ones. A chunk that would not become a third smaller
//! (noise, photographs) is stored as it is. Numbers gather in chunks of 8 KiB. Every chunk carries Fletcher's checksum, so
//! that damage is found, by other programs as well (all but words of 0xffff where 0x0000 stood, to which that sum is
//! blind). The structure is of the oldest kind (see `layout`), because it can be
//! changed safely in place: chunks are written first, then what refers to them, then the lengths of the columns, and the
//! length of `ep_len` at last, which commits the episodes. A file is sound at every moment; what a killed writer left
//! behind is not counted, and overwritten by the next.
//!
//! A writer holds the lock of the file. h5py asks for a lock to read as well, unless `HDF5_USE_FILE_LOCKING=FALSE`.
//!
//! To continue a file that another program laid out, it is first copied to our layout, and then takes its place.

#[cfg(feature = "hdf5")]
mod column;
#[cfg(feature = "hdf5")]
mod filters;
#[cfg(feature = "hdf5")]
mod layout;
#[cfg(feature = "hdf5")]
mod reader;
#[cfg(feature = "hdf5")]
mod record;
#[cfg(feature = "hdf5")]
mod source;
#[cfg(feature = "hdf5")]
mod table;
#[cfg(feature = "hdf5")]
mod tree;
#[cfg(feature = "hdf5")]
mod writer;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};
use std::path::{Path, PathBuf};
#[cfg(feature = "hdf5")]
use swm_core::{Error, Result};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "hdf5",
    summary: "one file NAME.h5 or NAME.hdf5; opens in h5py and in the reference",
    suffixes: &["h5", "hdf5"],
    feature: Some("hdf5"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "hdf5")]
const BACKEND: Option<Backend> = Some(Backend { open: reader::open, create: writer::create });
#[cfg(not(feature = "hdf5"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let folder = location.path().filter(|path| path.is_dir());
    ENTRY.has_suffix(location) || folder.is_some_and(|path| !files(path).is_empty())
}

/// The files of a folder that are of this format, by name.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = folder.read_dir().into_iter().flatten().flatten().map(|entry| entry.path());
    let mut files: Vec<PathBuf> = entries.filter(|path| ENTRY.has_suffix(&path.into())).collect();
    files.sort();
    files
}

#[cfg(feature = "hdf5")]
/// The file of a dataset: itself, or the only one in a folder, which the reference allows as well.
fn file(location: &Location) -> Result<Location> {
    let Some(folder) = location.path().filter(|path| path.is_dir()) else { return Ok(location.clone()) };
    match &files(folder)[..] {
        [file] => Ok(Location::from(file)),
        [] => Err(Error::corrupt(folder, "it is a folder without .h5 files", "name the file")),
        many => {
            let problem = format!("it holds {} .h5 files", many.len());
            Err(Error::corrupt(folder, problem, "name the one you mean"))
        }
    }
}
