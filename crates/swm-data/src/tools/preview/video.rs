//! Videos for viewing: H.264 in MP4, which browsers play.

use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};

/// Writes `frames` (each `[height, width, 3]` RGB bytes) as an MP4 that browsers play. Odd sizes get an additional
/// black row or column, because H.264 halves the chroma planes. The file is written atomically. Equal frames give equal
/// bytes with the same FFmpeg version.
///
/// # Errors
/// If [`check_mp4`] fails, this build lacks the feature `ffmpeg`, FFmpeg has no H.264 encoder, a frame does not have the
/// given size, there is no frame, or writing fails.
pub fn write_mp4<I>(path: &Path, width: usize, height: usize, fps: u32, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    write_mp4_scaled(path, width, height, fps, 1, frames)
}

/// Writes a video as [`write_mp4`] does, with every pixel enlarged to a square with side `scale`, so that small frames
/// are visible and stay sharp.
///
/// # Errors
/// See [`write_mp4`]. `scale` must not be 0.
pub fn write_mp4_scaled<I>(path: &Path, width: usize, height: usize, fps: u32, scale: usize, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    let mut video = VideoFile::begin(path, width, height, fps, scale)?;
    for frame in frames {
        video.add(frame.as_ref())?;
    }
    video.finish()
}

/// Checks that a video may be written: nothing exists at its path, or a video that this program wrote.
///
/// # Errors
/// If another file exists there.
pub fn check_mp4(path: &Path) -> Result<()> {
    files::check_own(path, is_own)
}

#[cfg(feature = "ffmpeg")]
use swm_video::is_own;

#[cfg(not(feature = "ffmpeg"))]
fn is_own(_: &Path) -> bool {
    false
}

/// The integer factor that enlarges an image's longer side to at most `target` pixels; at least 1.
pub fn integer_scale(width: usize, height: usize, target: usize) -> usize {
    (target / width.max(height).max(1)).max(1)
}

/// A video file that is being written.
pub(crate) struct VideoFile {
    path: PathBuf,
    width: usize,
    height: usize,
    scale: usize,
    frames: i64,
    /// The enlarged frame, with even sides.
    large: Vec<u8>,
    inner: encoder::Encoder,
}

impl VideoFile {
    /// Starts a video with frames of `width * scale` by `height * scale` pixels.
    pub fn begin(path: &Path, width: usize, height: usize, fps: u32, scale: usize) -> Result<Self> {
        if width == 0 || height == 0 || fps == 0 || scale == 0 {
            return Err(Error::config(
                format!("video {}", path.display()),
                format!("{width} x {height} pixels at {fps} frames a second, scaled by {scale}"),
                "make each value at least 1",
            ));
        }
        check_mp4(path)?;
        let (wide, high) = even(width, height, scale);
        Ok(Self {
            path: path.to_owned(),
            width,
            height,
            scale,
            frames: 0,
            large: vec![0; wide * high * 3],
            inner: begin(wide, high, fps)?,
        })
    }

    /// Adds a frame, `[height, width, 3]` RGB bytes.
    pub fn add(&mut self, rgb: &[u8]) -> Result<()> {
        let (width, height, scale) = (self.width, self.height, self.scale);
        if rgb.len() != width * height * 3 {
            return Err(Error::mismatch(
                format!("frame {} of {}", self.frames, self.path.display()),
                format!("{} bytes", rgb.len()),
                format!("{}, for {width} x {height} RGB pixels", width * height * 3),
            ));
        }
        let line = even(width, height, scale).0 * 3;
        for (y, row) in self.large.chunks_exact_mut(line).enumerate().take(height * scale) {
            let from = rgb[y / scale * width * 3..][..width * 3].as_chunks::<3>().0;
            for (to, pixel) in row.chunks_mut(scale * 3).zip(from) {
                to.as_chunks_mut::<3>().0.fill(*pixel);
            }
        }
        self.inner.add_frame(&self.large, self.frames)?;
        self.frames += 1;
        Ok(())
    }

    /// Completes the file.
    pub fn finish(self) -> Result<()> {
        if self.frames == 0 {
            let what = format!("video {}", self.path.display());
            return Err(Error::config(what, "there is no frame to write", "record at least one step"));
        }
        let bytes = self.inner.finish()?;
        files::write(&self.path, &bytes)
    }
}

/// The size of the video in pixels: the enlarged size, rounded up to even sides.
fn even(width: usize, height: usize, scale: usize) -> (usize, usize) {
    ((width * scale).next_multiple_of(2), (height * scale).next_multiple_of(2))
}

/// Creates the encoder of a video for viewing.
#[cfg(feature = "ffmpeg")]
fn begin(width: usize, height: usize, fps: u32) -> Result<encoder::Encoder> {
    encoder::Encoder::new(width, height, fps, swm_video::Encoding::viewing())
}

#[cfg(not(feature = "ffmpeg"))]
fn begin(_: usize, _: usize, _: u32) -> Result<encoder::Encoder> {
    Err(encoder::missing())
}

#[cfg(feature = "ffmpeg")]
mod encoder {
    pub use swm_video::Encoder;
}

/// Replaces the encoder in builds without the feature `ffmpeg`.
#[cfg(not(feature = "ffmpeg"))]
mod encoder {
    use swm_core::{Error, Result};

    pub struct Encoder;

    impl Encoder {
        pub fn add_frame(&mut self, _: &[u8], _: i64) -> Result<()> {
            Err(missing())
        }

        pub fn finish(self) -> Result<Vec<u8>> {
            Err(missing())
        }
    }

    pub fn missing() -> Error {
        Error::config("videos", "this build lacks the feature ffmpeg", "build it with `--features ffmpeg`")
    }
}

#[cfg(all(test, feature = "ffmpeg"))]
mod tests {
    use super::*;
    use std::ffi::OsString;
    use swm_video::{DecoderPool, FrameRequest, Source, Video};

    fn frames(width: usize, height: usize, n: usize) -> Vec<Vec<u8>> {
        (0..n).map(|t| (0..width * height * 3).map(|i| ((i / 9 + t * 11) % 256) as u8).collect()).collect()
    }

    fn names(folder: &Path) -> Vec<OsString> {
        std::fs::read_dir(folder).expect("listing the folder").map(|entry| entry.expect("entry").file_name()).collect()
    }

    #[test]
    fn videos_have_all_frames_and_are_reproducible() {
        let folder = tempfile::tempdir().expect("folder");
        let [a, b] = ["a.mp4", "b: 2.mp4"].map(|name| folder.path().join(name));
        let twice = |width, height| {
            let frames = frames(width, height, 12);
            [&a, &b].map(|path| {
                write_mp4(path, width, height, 10, &frames).expect("writing a video");
                std::fs::read(path).expect("reading a video")
            })
        };
        for (width, height) in [(48, 48), (64, 64), (31, 18)] {
            let [first, second] = twice(width, height);
            assert!(first == second, "{width} x {height}");
        }
        let frames = frames(31, 18, 12);
        let open = |path: &Path| Video::open(Source::File(path.to_owned())).expect("opening a video");
        assert_eq!((open(&a).size(), open(&a).frames()), ((18, 32), 12));
        write_mp4_scaled(&b, 31, 18, 10, 4, frames.iter().map(Vec::as_slice)).expect("writing a video");
        let video = open(&b);
        assert_eq!((video.size(), video.frames()), ((72, 124), 12));
        let mut out = vec![0; 72 * 124 * 3];
        DecoderPool::default()
            .read(vec![FrameRequest { video: &video, frame: 5, out: &mut out }])
            .expect("decoding a frame");
        let off: f64 = (0..72 * 124)
            .map(|i| f64::from(out[i * 3].abs_diff(frames[5][(i / 124 / 4 * 31 + i % 124 / 4) * 3])))
            .sum();
        assert!(off / (72.0 * 124.0) < 4.0, "{}", off / (72.0 * 124.0));
        assert_eq!(names(folder.path()).len(), 2, "only the two videos remain");
    }

    #[test]
    fn failed_writes_leave_no_files() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.mp4");
        let message = |scale, frames: &[Vec<u8>]| {
            write_mp4_scaled(&path, 4, 4, 10, scale, frames).expect_err("a failed write").to_string()
        };
        let good = frames(4, 4, 3);
        assert!(message(0, &good).contains("scaled by 0"));
        let found = message(1, &[good[0].clone(), vec![0; 5]]);
        assert!(found.contains("frame 1") && found.contains("5 bytes") && found.contains("48"), "{found}");
        assert!(message(1, &[]).contains("no frame"));
        let missing = folder.path().join("missing").join("a.mp4");
        let error = write_mp4(&missing, 4, 4, 10, good).expect_err("a failed write").to_string();
        assert!(error.contains("No such file or directory"), "{error}");
        assert!(names(folder.path()).is_empty());
    }

    #[test]
    fn integer_scale_enlarges_small_frames() {
        assert_eq!(
            [(64, 64, 256), (224, 224, 256), (512, 64, 256), (60, 30, 256)].map(|(w, h, t)| integer_scale(w, h, t)),
            [4, 1, 1, 4]
        );
    }
}
