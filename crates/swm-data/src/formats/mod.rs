//! Dataset formats on disk: one module for each format, and the list of formats in [`registry`].
//!
//! Each format implements [`Reader`](crate::Reader) and [`Writer`](crate::Writer). Its module declares `ENTRY`, its row
//! of the registry.

mod cast;
mod column_files;
pub mod entry;
mod folder;
mod hdf5;
pub mod lance;
mod lance_video;
mod lerobot;
mod opened;
pub mod registry;
mod replacing;
mod set_aside;
#[cfg_attr(not(feature = "hdf5"), allow(dead_code, reason = "npz files use only a part of this module"))]
mod stored_scalar;
mod system_error;
mod video;

pub use entry::{Backend, FormatEntry};
pub(crate) use opened::replaced;
pub use registry::{FORMATS, create, detect, interrupted, open, recover};

use std::path::Path;

/// Returns whether an existing path holds no dataset yet: an empty folder, or what a writer leaves that was killed, or has
/// not finished, while it created a dataset.
pub fn has_no_dataset(path: &Path) -> bool {
    column_files::has_no_dataset(path)
        || hdf5::is_unfinished(path)
        || lance::is_unfinished(path)
        || lance_video::is_unfinished(path)
        || lerobot::is_unfinished(path)
}
