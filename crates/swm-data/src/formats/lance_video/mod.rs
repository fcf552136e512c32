//! The format `lance-video`: a Lance table of the numeric columns, with one MP4 per episode and image column.
//!
//! ```text
//! NAME.lance-video/
//!   steps.lance      numeric columns, one row per step; the videos and the schema as constants of each episode
//! ```
//!
//! Videos are constants of their episode ([`Constants`](crate::Constants)), so one commit covers an episode with its
//! frames, and all features of Lance tables (object stores, concurrent writers) apply. All constants of a data file are
//! read together, so data files are small. [`ImageCodec`](swm_image::ImageCodec) determines the encoding as in the
//! format `video`.

#[cfg(feature = "ffmpeg")]
mod reader;
#[cfg(feature = "ffmpeg")]
mod writer;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};
use crate::formats::lance;
use std::fs::DirEntry;
use std::path::Path;

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lance-video",
    summary: "folder NAME.lance-video of a Lance table with one MP4 per episode",
    suffixes: &["lance-video"],
    exact_images: false,
    codecs: true,
    feature: Some("ffmpeg"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "ffmpeg")]
const BACKEND: Option<Backend> = Some(Backend {
    open: reader::open,
    create: writer::create,
    remove: |path| lance::ENTRY.remove(&path.join(TABLE)),
    recover: None,
});
#[cfg(not(feature = "ffmpeg"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    ENTRY.has_suffix(location)
}

/// Whether a folder holds only what a writer leaves that was killed before the first commit of its table.
pub(super) fn is_unfinished(folder: &Path) -> bool {
    let is_table = |entry: std::io::Result<DirEntry>| entry.is_ok_and(|entry| entry.file_name() == TABLE);
    ENTRY.has_suffix(&Location::from(folder))
        && folder.read_dir().is_ok_and(|mut entries| entries.all(is_table))
        && lance::is_unfinished(&folder.join(TABLE))
}

/// Prefix of the constants that hold videos; the column's name follows.
#[cfg(feature = "ffmpeg")]
const VIDEO: &str = "lance-video/video/";
/// The constant that holds the schema, including image columns.
#[cfg(feature = "ffmpeg")]
const SCHEMA: &str = "lance-video/schema.json";

/// Name of the Lance table within the dataset's folder.
const TABLE: &str = "steps.lance";

/// The location of the Lance table within the dataset's folder.
#[cfg(feature = "ffmpeg")]
fn table(location: &Location) -> swm_core::Result<Location> {
    Ok(match location {
        Location::Path(path) => Location::Path(path.join(TABLE)),
        Location::Uri(uri) => Location::parse(&format!("{}/{TABLE}", uri.as_str().trim_end_matches('/')))?,
    })
}
