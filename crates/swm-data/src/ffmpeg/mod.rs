//! Videos, in process: frames by number out of MP4 files, and MP4 files out of frames.
//!
//! - `mp4`: where the frames of a file are; also the checksums of our own files.
//! - `decode`: frames by number, each run from a key frame decoded once, by decoders that are kept.
//! - `library`: the videos of a dataset, whose tables are kept.
//! - `encode`: videos for training (short runs, so that any frame is near a key frame) and for people.
//! - `colour`: planes to RGB and back.
//!
//! FFmpeg's libraries decode and encode; everything around that is safe Rust, because files may be damaged. They are
//! behind the feature `ffmpeg`.

#[cfg(feature = "ffmpeg")]
mod colour;
#[cfg(feature = "ffmpeg")]
mod decode;
#[cfg(feature = "ffmpeg")]
mod encode;
#[cfg(feature = "ffmpeg")]
mod library;
#[cfg(feature = "ffmpeg")]
mod mp4;

#[cfg(feature = "ffmpeg")]
#[cfg(all(test, feature = "ffmpeg"))]
pub use decode::{Decoders, Wanted};
#[cfg(feature = "ffmpeg")]
pub use decode::{Source, Video};
#[cfg(feature = "ffmpeg")]
pub use encode::{Encoding, Film, encode};
#[cfg(feature = "ffmpeg")]
pub use library::Library;

/// Stands for a video that is being written, where there are none.
#[cfg(not(feature = "ffmpeg"))]
pub struct Film;

#[cfg(not(feature = "ffmpeg"))]
impl Film {
    pub fn add(&mut self, _: &[u8], _: i64) -> swm_core::Result<()> {
        Err(absent("videos", "ffmpeg"))
    }

    pub fn finish(self) -> swm_core::Result<Vec<u8>> {
        Err(absent("videos", "ffmpeg"))
    }
}

/// The error of a build without this feature. `what` is what it was needed for.
#[cfg(not(all(feature = "ffmpeg", feature = "lerobot")))]
pub fn absent(what: &str, feature: &str) -> swm_core::Error {
    let fix = format!("build it with `--features {feature}`");
    swm_core::Error::config(what, format!("this build lacks the feature {feature}"), fix)
}

/// Prepares FFmpeg's libraries, once: errors get their words, and nothing is written to standard error, as what went
/// wrong is said in our errors.
#[cfg(feature = "ffmpeg")]
fn prepare() {
    static ONCE: std::sync::Once = std::sync::Once::new();
    ONCE.call_once(|| {
        // It only fills a table of words; nothing in it can fail.
        let _ = ffmpeg_next::init();
        ffmpeg_next::log::set_level(ffmpeg_next::log::Level::Quiet);
    });
}
