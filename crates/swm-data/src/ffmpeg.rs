//! Videos, by `swm-video` where the feature `ffmpeg` is on; otherwise errors that name the missing feature.

#[cfg(feature = "ffmpeg")]
pub use swm_video::*;

/// Stands for the video encoder in builds without the feature `ffmpeg`.
#[cfg(not(feature = "ffmpeg"))]
pub struct Encoder;

#[cfg(not(feature = "ffmpeg"))]
impl Encoder {
    pub fn add_frame(&mut self, _: &[u8], _: i64) -> swm_core::Result<()> {
        Err(absent("videos", "ffmpeg"))
    }

    pub fn finish(self) -> swm_core::Result<Vec<u8>> {
        Err(absent("videos", "ffmpeg"))
    }
}

/// The error of a build without `feature`, which `what` needs.
#[cfg(not(all(feature = "ffmpeg", feature = "lerobot")))]
pub fn absent(what: &str, feature: &str) -> swm_core::Error {
    let fix = format!("build it with `--features {feature}`");
    swm_core::Error::config(what, format!("this build lacks the feature {feature}"), fix)
}
