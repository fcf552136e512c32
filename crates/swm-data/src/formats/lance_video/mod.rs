//! The format `lance-video`: a Lance table of the numbers, and one MP4 blob an episode and column of pictures.
//!
//! ```text
//! NAME.lance-video/
//!   steps.lance      the numbers, a row a step; with every episode its videos and the full list of columns
//! ```
//!
//! The videos are constants of their episode (`Writer::write_episode_with`), so an episode is committed with its
//! pictures at once, and whatever Lance's tables can do (object stores, several writers) holds for these. Constants of
//! one data file are read together; data files are therefore kept small. How pictures are stored follows from
//! [`ImageCodec`](swm_image::ImageCodec) as in the format `video`.

#[cfg(feature = "ffmpeg")]
mod reader;
#[cfg(feature = "ffmpeg")]
mod writer;

use crate::dataset::Location;
use crate::formats::entry::{Backend, FormatEntry};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "lance-video",
    summary: "folder NAME.lance-video of a Lance table with one MP4 an episode",
    suffixes: &["lance-video"],
    feature: Some("ffmpeg"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "ffmpeg")]
const BACKEND: Option<Backend> = Some(Backend { open: reader::open, create: writer::create });
#[cfg(not(feature = "ffmpeg"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    ENTRY.has_suffix(location)
}

/// What the names of constants begin with that are ours; a video's ends with its column's name.
#[cfg(feature = "ffmpeg")]
const VIDEO: &str = "lance-video/video/";
/// The constant that lists all columns, pictures included.
#[cfg(feature = "ffmpeg")]
const SCHEMA: &str = "lance-video/schema.json";

/// The table within the folder.
#[cfg(feature = "ffmpeg")]
fn table(location: &Location) -> swm_core::Result<Location> {
    Ok(match location {
        Location::Path(path) => Location::Path(path.join("steps.lance")),
        Location::Uri(uri) => Location::parse(&format!("{}/steps.lance", uri.as_str().trim_end_matches('/')))?,
    })
}
