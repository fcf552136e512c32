//! MP4 videos with FFmpeg's libraries, in process: decodes frames by index and encodes frames.
//!
//! - [`Video`], [`DecoderPool`]: read frames by index with pooled decoders.
//! - [`load`]: loads FFmpeg; callers do it before they create files, others have it done for the first video.
//! - [`VideoCache`]: caches the opened videos of a dataset.
//! - [`encode`], [`Encoder`]: write videos for training (a key frame every few frames) or for viewing.
//!
//! Safe code of this crate reads the tables of MP4 files, because files may be damaged; FFmpeg only decodes and encodes
//! single frames. Frames are `[height, width, 3]` RGB bytes, row-major. Only `swm-data` depends on this crate.

mod cache;
mod colour;
mod decode;
mod encode;
mod header;
mod link;
mod mp4;
mod parameters;
#[cfg(test)]
mod rare_tests;
mod reducer;
mod video;

pub use cache::VideoCache;
pub use decode::{DecoderPool, FrameRequest};
pub use encode::{Encoder, Encoding, Quality, encode};
pub use link::load;
pub use video::{Source, Video};

use std::path::Path;

/// Returns whether this program wrote a video file: whether it has checksums of its frames.
pub fn is_own(path: &Path) -> bool {
    Video::open(Source::File(path.to_owned())).is_ok_and(|video| video.index.sums.is_some())
}
