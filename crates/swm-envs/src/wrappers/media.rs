//! [`Media`]: background images and videos of the chroma-key wrapper.
//!
//! A PNG file or a folder of them is read here; any other file (MP4, GIF, JPEG, …) is decoded once by the `ffmpeg`
//! program. The frames, and their resized copies, are shared by all environments.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use swm_core::{Error, Result};
use swm_image::resize::AreaResizer;
use swm_image::{RgbImage, read_png};

/// The maximal memory of the frames of one video, in bytes.
const LIMIT: usize = 1 << 30;

/// An image or the frames of a video.
pub struct Media {
    frames: Vec<RgbImage>,
    /// The frames at the sizes in use.
    sizes: Mutex<Vec<Arc<SizedMedia>>>,
}

/// The frames of a [`Media`] at one size, each resized at its first use.
pub struct SizedMedia {
    size: [usize; 2],
    frames: Vec<OnceLock<Vec<u8>>>,
}

impl Media {
    /// Makes a background of these frames, at least one.
    pub fn new(frames: Vec<RgbImage>) -> Self {
        Self { frames, sizes: Mutex::default() }
    }

    /// Reads an image, a folder of images in the order of their names, or a video.
    ///
    /// # Errors
    /// When the file is missing, damaged or too large, or `ffmpeg` is needed and missing.
    pub fn read(path: &Path) -> Result<Self> {
        let frames = if path.is_dir() {
            read_folder(path)?
        } else if path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
            vec![read_png(path)?]
        } else {
            read_video(Path::new("ffmpeg"), path, LIMIT)?
        };
        Ok(Self::new(frames))
    }

    /// Returns the frames at a size, `[width, height]`.
    pub fn sized(&self, size: [usize; 2]) -> Arc<SizedMedia> {
        // The list stays valid if a thread panics while it holds the lock.
        let mut sizes = self.sizes.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(known) = sizes.iter().find(|known| known.size == size) {
            return known.clone();
        }
        let new = Arc::new(SizedMedia { size, frames: self.frames.iter().map(|_| OnceLock::new()).collect() });
        sizes.push(new.clone());
        new
    }

    /// Returns the frame at a step, at the size of `sized`; the frames repeat after the last.
    pub fn frame<'a>(&self, sized: &'a SizedMedia, step: u64) -> &'a [u8] {
        let index = (step % self.frames.len() as u64) as usize;
        sized.frames[index].get_or_init(|| {
            let RgbImage { width, height, rgb } = &self.frames[index];
            let mut resized = vec![0; 3 * sized.size[0] * sized.size[1]];
            AreaResizer::new([*width, *height], sized.size).resize(rgb, &mut resized);
            resized
        })
    }
}

impl SizedMedia {
    /// Returns whether the frames have this size, `[width, height]`.
    pub fn has_size(&self, size: [usize; 2]) -> bool {
        self.size == size
    }
}

fn read_folder(path: &Path) -> Result<Vec<RgbImage>> {
    let fail = |source| Error::io(path, "listing images", source);
    let mut files: Vec<PathBuf> = vec![];
    for entry in std::fs::read_dir(path).map_err(fail)? {
        let file = entry.map_err(fail)?.path();
        if file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
            files.push(file);
        }
    }
    files.sort();
    if files.is_empty() {
        return Err(Error::corrupt(path, "no PNG file in this folder", "give a folder of PNG files, a PNG or a video"));
    }
    files.iter().map(|file| read_png(file)).collect()
}

fn too_large(path: &Path) -> Error {
    let problem = format!("its frames take more than {} MiB in memory", LIMIT >> 20);
    Error::corrupt(path, problem, "shorten or shrink it: ffmpeg -i IN -t 10 -vf scale=256:-2 OUT.mp4")
}

/// Decodes all frames of a file. `ffmpeg` writes them as PPM images, which contain their size.
fn read_video(program: &Path, path: &Path, limit: usize) -> Result<Vec<RgbImage>> {
    if let Err(source) = std::fs::metadata(path) {
        return Err(Error::io(path, "opening an image or video", source));
    }
    // `file:` keeps a name with a colon from being read as a protocol.
    let mut input = OsString::from("file:");
    input.push(path);
    let output = Command::new(program)
        .args(["-nostdin", "-hide_banner", "-loglevel", "error", "-i"])
        .arg(input)
        // These options write every frame once, regardless of its duration.
        .args(["-an", "-vf", "settb=1/25,setpts=N", "-r", "25", "-fs", &limit.to_string()])
        .args(["-f", "image2pipe", "-c:v", "ppm", "-pix_fmt", "rgb24", "pipe:1"])
        .stdin(Stdio::null())
        .output()
        .map_err(|source| match source.kind() {
            std::io::ErrorKind::NotFound => Error::external(
                format!("reading {}", path.display()),
                format!(
                    "the program '{}' was not found; install FFmpeg (`apt-get install ffmpeg`, `brew install ffmpeg`) \
                     or give a PNG file or a folder of them",
                    program.display()
                ),
            ),
            _ => Error::io(program, "starting ffmpeg", source),
        })?;
    if output.stdout.len() >= limit {
        return Err(too_large(path));
    }
    let frames = read_ppm(&output.stdout);
    if !output.status.success() || frames.is_empty() {
        let log = String::from_utf8_lossy(&output.stderr);
        let problem = log.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("it has no frame").to_owned();
        return Err(Error::corrupt(path, problem, "give an image or a video that ffmpeg can decode"));
    }
    Ok(frames)
}

/// Reads the images of a stream of binary PPM files, up to the first incomplete one.
fn read_ppm(mut stream: &[u8]) -> Vec<RgbImage> {
    let mut frames = vec![];
    while let Some((width, height, rest)) = ppm_header(stream) {
        let Some((rgb, rest)) = rest.split_at_checked(3 * width * height) else { break };
        frames.push(RgbImage { width, height, rgb: rgb.to_vec() });
        stream = rest;
    }
    frames
}

/// Reads the header `P6 WIDTH HEIGHT 255`. Returns width, height and the rest of the stream.
fn ppm_header(stream: &[u8]) -> Option<(usize, usize, &[u8])> {
    let mut rest = stream;
    let mut word = || {
        let end = rest.iter().position(u8::is_ascii_whitespace)?;
        let (word, after) = rest.split_at(end);
        rest = &after[1..];
        std::str::from_utf8(word).ok()
    };
    if word()? != "P6" {
        return None;
    }
    let (width, height) = (word()?.parse().ok()?, word()?.parse().ok()?);
    (word()? == "255" && width > 0 && height > 0).then_some((width, height, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_all_complete_ppm_images_of_a_stream() {
        let frames = read_ppm(b"P6\n1 2\n255\nabcdefP6\n2 1\n255\nABCDEFP6\n9 9\n255\ncut off");
        let found: Vec<_> = frames.iter().map(|f| (f.width, f.height, &f.rgb[..])).collect();
        assert_eq!(found, [(1, 2, &b"abcdef"[..]), (2, 1, b"ABCDEF")]);
        assert!(read_ppm(b"P5\n1 1\n255\nabc").is_empty());
    }

    #[test]
    fn missing_ffmpeg_and_oversized_videos_are_errors() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("a.mp4");
        let message =
            |program: &str| read_video(Path::new(program), &path, LIMIT).expect_err("reading must fail").to_string();
        assert!(message("ffmpeg").contains("a.mp4"));
        std::fs::write(&path, b"no video").expect("writing the file");
        assert!(message("no-such-ffmpeg").contains("install FFmpeg"), "{}", message("no-such-ffmpeg"));
        assert!(too_large(&path).to_string().contains("1024 MiB"));
    }

    #[test]
    fn background_frames_are_resized_once_per_size_and_repeat() {
        let frame = |v| RgbImage { width: 2, height: 1, rgb: vec![v; 6] };
        let media = Media::new(vec![frame(1), frame(2)]);
        let sized = media.sized([3, 3]);
        assert!(Arc::ptr_eq(&sized, &media.sized([3, 3])));
        assert_eq!([0, 1, 2, 5].map(|step| media.frame(&sized, step)[26]), [1, 2, 1, 2]);
    }
}
