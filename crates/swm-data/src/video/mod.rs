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
//! How pictures are stored follows from [`ImageCodec`](crate::ImageCodec): a lossless one becomes lossless H.264 of red,
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

use crate::column_files::{holds_videos, is_there};
use crate::format::Format;
use crate::location::Location;
#[cfg(feature = "ffmpeg")]
use std::path::{Path, PathBuf};

/// The registry row.
pub const FORMAT: Format = Format {
    id: "video",
    summary: "folder NAME.video of numpy's npz files and one MP4 an episode; the reference opens it",
    detect,
    open,
    create,
};

#[cfg(feature = "ffmpeg")]
use {reader::open, writer::create};

#[cfg(not(feature = "ffmpeg"))]
fn open(_: &Location) -> swm_core::Result<std::sync::Arc<dyn crate::Reader>> {
    Err(crate::ffmpeg::absent("format video", "ffmpeg"))
}

#[cfg(not(feature = "ffmpeg"))]
fn create(_: &Location, _: &swm_core::Schema, _: crate::WriteOptions) -> swm_core::Result<Box<dyn crate::Writer>> {
    Err(crate::ffmpeg::absent("format video", "ffmpeg"))
}

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    if path.exists() {
        return is_there(path) && holds_videos(path) || location.has_suffix("video") && path.is_dir();
    }
    location.has_suffix("video")
}

/// The video of an episode.
#[cfg(feature = "ffmpeg")]
fn file(folder: &Path, column: &str, episode: usize) -> PathBuf {
    folder.join(column).join(format!("ep_{episode}.mp4"))
}
