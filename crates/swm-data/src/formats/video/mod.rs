//! The format `video`: numeric columns in column files, and one MP4 per episode and image column.
//!
//! ```text
//! NAME.video/
//!   ep_len.npz, ep_offset.npz, action.npz, …    see `column_files`
//!   pixels/ep_0.mp4, …                          H.264, one frame per row
//! ```
//!
//! This is the layout of the reference's `VideoDataset`. The reference opens datasets written here, and this format
//! opens datasets written by the reference. Frames are addressed by their presentation index. Decoding a frame requires
//! decoding from the preceding key frame, so videos written here have a key frame every few frames; videos written by
//! the reference have one every 250 frames.
//!
//! [`ImageCodec`](swm_image::ImageCodec) determines the encoding. A lossless codec becomes lossless H.264 in RGB
//! (profile High 4:4:4 Predictive). FFmpeg, decord, PyAV and torchcodec decode this profile, but few browsers play it.
//! JPEG with quality `q` becomes H.264 4:2:0 with the constant rate factor 8 + 2 (100 − `q`).
//!
//! The videos of an episode are written before its numeric columns are committed, each to a temporary file that is then
//! renamed. An MP4 box that players skip holds checksums of the video's tables and of every encoded frame, so that
//! readers return an error instead of a wrong frame if the file is damaged.

#[cfg(feature = "ffmpeg")]
mod reader;
#[cfg(feature = "ffmpeg")]
mod writer;

use crate::dataset::Location;
#[cfg(feature = "ffmpeg")]
use crate::formats::column_files::{self, ImageFiles};
use crate::formats::column_files::{contains_videos, exists};
use crate::formats::entry::{Backend, FormatEntry};
use crate::formats::set_aside;

/// The registry row of this format.
pub const ENTRY: FormatEntry = FormatEntry {
    id: "video",
    summary: "folder NAME.video of numpy's npz files and one MP4 per episode; the reference opens it",
    suffixes: &["video"],
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
    remove: |path| column_files::remove(path, ImageFiles::Videos),
    recover: Some(|path| set_aside::recover_unlocked(path, ImageFiles::Videos)),
});
#[cfg(not(feature = "ffmpeg"))]
const BACKEND: Option<Backend> = None;

fn detect(location: &Location) -> bool {
    let Some(path) = location.path() else { return false };
    if path.exists() {
        return exists(path) && contains_videos(path) || ENTRY.has_suffix(location) && path.is_dir();
    }
    ENTRY.has_suffix(location)
}
