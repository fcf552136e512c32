//! The format `folder`: numbers in column files, and one picture file a step, which any program can look at.
//!
//! ```text
//! NAME.folder/
//!   ep_len.npz, ep_offset.npz, action.npz, …    see `column_files`
//!   pixels/ep_0_step_0.jpeg, …                  a picture each
//! ```
//!
//! It is the layout of the reference's `FolderDataset`, which looks for names that end in `.jpeg` or `.jpg` only, but
//! takes pictures for what their first bytes say. So every picture we write ends in `.jpeg`, and is a lossless PNG unless
//! another codec is asked for. We read `.png` as well.
//!
//! Pictures of an episode are written before its numbers are committed. They are not forced to the disk one by one:
//! a killed process loses nothing that was committed, a power cut may lose pictures of the last seconds, and reading
//! them says so.

mod reader;
mod writer;

use crate::dataset::Location;
use crate::formats::column_files::{holds_videos, is_there};
use crate::formats::entry::{Backend, FormatEntry};
use std::path::{Path, PathBuf};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "folder",
    summary: "folder NAME.folder of numpy's npz files and one picture a step; the reference opens it",
    suffixes: &["folder"],
    feature: None,
    detect,
    backend: Some(Backend { open: reader::open, create: writer::create }),
};

/// A name that ends so says that a picture is stored; the first is what we write.
const SUFFIXES: [&str; 3] = ["jpeg", "jpg", "png"];

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    if path.exists() {
        return is_there(path) && !holds_videos(path) || ENTRY.has_suffix(location) && path.is_dir();
    }
    ENTRY.has_suffix(location)
}

/// The file of a picture.
fn picture(folder: &Path, column: &str, episode: usize, step: usize, suffix: &str) -> PathBuf {
    folder.join(column).join(format!("ep_{episode}_step_{step}.{suffix}"))
}

/// The episode whose picture a file of that name holds.
fn episode_of(name: &str) -> Option<usize> {
    let (episode, _) = name.strip_prefix("ep_")?.split_once("_step_")?;
    episode.parse().ok()
}
