//! The format `video`: numbers in column files, and one MP4 an episode and column of pictures.
//!
//! ```text
//! NAME.video/
//!   ep_len.npz, ep_offset.npz, action.npz, …    see `column_files`
//!   pixels/ep_0.mp4, …                          H.264, a frame a row
//! ```
//!
//! It is the layout of the reference's `VideoDataset`, which opens ours as we open its. Any frame is found by its number
//! in the order of presentation; frames from its key frame on are decoded to see it, so our files have a key frame every
//! few frames, where the reference's have one every 250.
//!
//! How pictures are stored follows from [`ImageCodec`](swm_image::ImageCodec): a lossless one becomes lossless H.264 of red,
//! green and blue (profile High 4:4:4 Predictive, which FFmpeg and with it decord, PyAV and torchcodec decode, but few
//! browsers); JPEG of quality `q` becomes H.264 of 4:2:0 with the constant rate factor 8 + 2 (100 − `q`).
//!
//! An episode's videos are written before its numbers are committed, each beside its place and then renamed. They carry
//! checksums of their tables and of every coded picture in a box that players skip, so that a flipped bit is an error
//! and not another picture.

#[cfg(feature = "ffmpeg")]
mod reader;
#[cfg(feature = "ffmpeg")]
mod writer;

use crate::dataset::Location;
use crate::formats::column_files::{holds_videos, is_there};
use crate::formats::entry::{Backend, FormatEntry};
#[cfg(feature = "ffmpeg")]
use std::path::{Path, PathBuf};

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "video",
    summary: "folder NAME.video of numpy's npz files and one MP4 an episode; the reference opens it",
    suffixes: &["video"],
    feature: Some("ffmpeg"),
    detect,
    backend: BACKEND,
};

#[cfg(feature = "ffmpeg")]
const BACKEND: Option<Backend> = Some(Backend { open: reader::open, create: writer::create });
#[cfg(not(feature = "ffmpeg"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    if path.exists() {
        return is_there(path) && holds_videos(path) || ENTRY.has_suffix(location) && path.is_dir();
    }
    ENTRY.has_suffix(location)
}

/// The video of an episode.
#[cfg(feature = "ffmpeg")]
fn file(folder: &Path, column: &str, episode: usize) -> PathBuf {
    folder.join(column).join(format!("ep_{episode}.mp4"))
}
