//! The format `hdf5`: one file that the reference implementation's `HDF5Dataset` and every HDF5 library read.
//!
//! Each column is an HDF5 dataset `[rows, shape…]` with the name and type of the column, and holds all episodes one
//! after another. The datasets `ep_len` and `ep_offset` hold the length and first row of every episode.
//!
//! **Reading.** The crate `hdf5-pure` reads the structure of a file; this module reads the chunks. The chunks of a
//! batch are planned together, read once each, and decoded on all threads, usually straight into the batch. All chunk
//! layouts and the usual filters of h5py and hdf5plugin are supported (`filters/`). Links are not followed (`links`). From `s3://` and `http://`
//! locations, all byte ranges of a batch are read concurrently.
//!
//! **Writing.** Images are chunks of one row with LZF compression, which h5py reads without plugins; rendered frames
//! shrink to about 2% of their size, and are read faster than uncompressed frames. A chunk that would shrink by less
//! than a third (noise, photographs) is stored uncompressed. Other columns have chunks of 8 KiB. Every chunk has a
//! Fletcher checksum, so that other programs also detect damage (except a 16-bit word 0xffff in place of 0x0000, which
//! does not change this checksum).
//!
//! Files use the oldest structures of HDF5 (see `layout`), because these can be changed safely in place. A commit
//! writes chunks first, then the B-trees that refer to them, then the lengths of the columns, and the length of
//! `ep_len` last. The file is valid at any time; uncommitted data of a killed writer lies beyond these lengths, and the
//! next writer overwrites it.
//!
//! To replace a dataset, the writer creates an empty one in a temporary file beside it, and renames that: at any time the
//! old or the new dataset exists.
//!
//! A writer locks the file. h5py locks the file even for reading, unless `HDF5_USE_FILE_LOCKING=FALSE`. To append to
//! a file with another layout, the writer first replaces the file with a copy in this layout.

#[cfg(feature = "hdf5")]
mod chunks;
#[cfg(feature = "hdf5")]
mod column;
#[cfg(feature = "hdf5")]
mod filters;
#[cfg(feature = "hdf5")]
mod layout;
#[cfg(feature = "hdf5")]
mod links;
#[cfg(feature = "hdf5")]
mod reader;
#[cfg(feature = "hdf5")]
mod record;
#[cfg(feature = "hdf5")]
mod source;
#[cfg(feature = "hdf5")]
mod structure;
#[cfg(feature = "hdf5")]
mod table;
#[cfg(feature = "hdf5")]
mod tree;
#[cfg(feature = "hdf5")]
mod unchanged;
#[cfg(feature = "hdf5")]
mod writer;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};
use std::path::{Path, PathBuf};
#[cfg(feature = "hdf5")]
use swm_core::Error;
use swm_core::{Result, files};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "hdf5",
    summary: "one file NAME.h5 or NAME.hdf5; opens in h5py and in the reference",
    suffixes: &["h5", "hdf5"],
    exact_images: true,
    codecs: false,
    feature: Some("hdf5"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "hdf5")]
const BACKEND: Option<Backend> =
    Some(Backend { open: reader::open, create: writer::create, remove: files::delete_file, recover: None });
#[cfg(not(feature = "hdf5"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let folder = location.path().filter(|path| path.is_dir());
    ENTRY.has_suffix(location)
        || folder.is_some_and(|path| files_in(path).is_ok_and(|files| !files.is_empty()))
        || location.path().is_some_and(has_signature)
}

/// Whether a file begins as HDF5 files do.
fn has_signature(path: &Path) -> bool {
    const SIGNATURE: &[u8] = b"\x89HDF\r\n\x1a\n";
    let mut start = [0; SIGNATURE.len()];
    let opened = path.is_file().then(|| std::fs::File::open(path).ok()).flatten();
    opened.is_some_and(|mut file| std::io::Read::read_exact(&mut file, &mut start).is_ok()) && start == SIGNATURE
}

/// Returns whether a file is empty, or its creation was killed or has not finished.
#[cfg(feature = "hdf5")]
pub(super) fn is_unfinished(path: &Path) -> bool {
    ENTRY.has_suffix(&path.into()) && path.is_file() && writer::is_complete_file(path).is_ok_and(|complete| !complete)
}

#[cfg(not(feature = "hdf5"))]
pub(super) const fn is_unfinished(_: &Path) -> bool {
    false
}

/// The files in a folder with a suffix of this format, sorted by name.
fn files_in(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut files = files::entries(folder)?;
    files.retain(|path| ENTRY.has_suffix(&path.into()));
    Ok(files)
}

/// The file of a dataset: the location itself, or the only file in a folder, as in the reference implementation.
#[cfg(feature = "hdf5")]
fn file(location: &Location) -> Result<Location> {
    let Some(folder) = location.path().filter(|path| path.is_dir()) else { return Ok(location.clone()) };
    match &files_in(folder)?[..] {
        [file] => Ok(Location::from(file)),
        [] => Err(Error::corrupt(folder, "it is a folder without .h5 files", "give the path of an .h5 file")),
        many => {
            let problem = format!("it holds {} .h5 files", many.len());
            Err(Error::corrupt(folder, problem, "give the path of one of them"))
        }
    }
}
