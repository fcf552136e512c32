//! The format `folder`: numeric columns in column files, and one image file per step, which image viewers can display.
//!
//! ```text
//! NAME.folder/
//!   ep_len.npz, ep_offset.npz, action.npz, …    see `column_files`
//!   pixels/ep_0_step_0.jpeg, …                  one image per file
//! ```
//!
//! This is the layout of the reference's `FolderDataset`, which accepts only names ending in `.jpeg` or `.jpg`, but
//! recognises the codec by the first bytes. Therefore every image file written here ends in `.jpeg`, even with a
//! lossless codec. Names ending in `.png` are read as well.
//!
//! The images of an episode are written before its numeric columns are committed, without syncing each file. A killed
//! process loses no committed episode. A power failure may lose images of the last seconds; readers report these images
//! as missing.

mod reader;
mod writer;

use crate::dataset::Location;
use crate::formats::column_files::{self, ImageFiles, contains_videos, exists};
use crate::formats::entry::{Backend, FormatEntry};
use crate::formats::set_aside;

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "folder",
    summary: "folder NAME.folder of numpy's npz files and one image per step; the reference opens it",
    suffixes: &["folder"],
    exact_images: true,
    codecs: true,
    feature: None,
    detect,
    backend: Some(Backend {
        open: reader::open,
        create: writer::create,
        remove: |path| column_files::remove(path, ImageFiles::Images),
        recover: Some(|path| set_aside::recover_unlocked(path, ImageFiles::Images)),
    }),
};

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    if path.exists() {
        return exists(path) && !contains_videos(path) || ENTRY.has_suffix(location) && path.is_dir();
    }
    ENTRY.has_suffix(location)
}
