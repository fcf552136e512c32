//! Videos for people to watch: RGB frames piped into the `ffmpeg` program, H.264 in MP4 out.
//!
//! The program is used instead of a linked library because videos are a by-product: nothing else of the
//! platform should fail to build or to run where FFmpeg is absent. Equal frames give equal bytes with the same
//! `ffmpeg`, so results that contain videos can be compared as files.

use std::ffi::OsString;
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, Command, Stdio};
use swm_core::{Error, Result};

/// Constant quality of H.264: 18 looks like the source, lower is larger.
const CRF: &str = "18";

/// Writes `frames` (each `height * width * 3` bytes, RGB, row after row) as an MP4 that browsers play.
/// Odd sizes gain a black row or column, which H.264's halved colour planes need. The file appears under its
/// name only when complete.
///
/// # Errors
/// When `ffmpeg` is not installed or fails, a frame has another size, or there is no frame.
pub fn write_mp4<I>(path: &Path, width: usize, height: usize, fps: u32, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    write_mp4_scaled(path, width, height, fps, 1, frames)
}

/// As [`write_mp4`], every pixel drawn as a square of `scale` by `scale`, so that a 64-pixel world is
/// watchable and its pixels stay crisp.
///
/// # Errors
/// As [`write_mp4`], and when `scale` is 0.
pub fn write_mp4_scaled<I>(path: &Path, width: usize, height: usize, fps: u32, scale: usize, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    encode(Path::new("ffmpeg"), path, Geometry { width, height, fps, scale }, frames)
}

/// The factor that brings a picture's longer side nearest to, but not over, `target` pixels; at least 1.
pub fn integer_scale(width: usize, height: usize, target: usize) -> usize {
    (target / width.max(height).max(1)).max(1)
}

/// What the frames are and how they are shown.
#[derive(Clone, Copy)]
struct Geometry {
    width: usize,
    height: usize,
    fps: u32,
    scale: usize,
}

impl Geometry {
    fn check(self, path: &Path) -> Result<()> {
        let Self { width, height, fps, scale } = self;
        if width == 0 || height == 0 || fps == 0 || scale == 0 {
            return Err(Error::config(
                format!("video {}", path.display()),
                format!("{width} x {height} pixels at {fps} frames a second, scaled by {scale}"),
                "give each of them at least 1",
            ));
        }
        Ok(())
    }

    /// The arguments of `ffmpeg`. One thread and the bit-exact flags make the bytes depend on the frames only;
    /// the colour matrix is stated because players guess it from the size otherwise.
    fn arguments(self) -> Vec<String> {
        let Self { width, height, fps, scale } = self;
        let filter = format!(
            "scale=iw*{scale}:ih*{scale}:flags=neighbor+accurate_rnd+full_chroma_int+bitexact:\
             out_color_matrix=bt709:out_range=tv,pad=ceil(iw/2)*2:ceil(ih/2)*2,format=yuv420p"
        );
        let size = format!("{width}x{height}");
        let fps = fps.to_string();
        let input = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-video_size", &size, "-framerate", &fps, "-i", "pipe:0"];
        let video = ["-an", "-vf", &filter, "-c:v", "libx264", "-preset", "medium", "-crf", CRF];
        let colour = ["-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709"];
        let exact = ["-threads", "1", "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"];
        let container = ["-movflags", "+faststart", "-f", "mp4"];
        ["-nostdin", "-hide_banner", "-loglevel", "error", "-filter_threads", "1", "-y"]
            .iter()
            .chain(&input)
            .chain(&video)
            .chain(&colour)
            .chain(&exact)
            .chain(&container)
            .map(|&argument| argument.to_owned())
            .collect()
    }
}

/// A file under a temporary name, removed unless [`Partial::complete`] gives it its own.
struct Partial {
    path: PathBuf,
}

impl Partial {
    /// A hidden name beside `target`, so that the renaming stays within one file system.
    fn beside(target: &Path) -> Result<Self> {
        let Some(name) = target.file_name() else {
            return Err(Error::config("video path", format!("'{}' names no file", target.display()), "end it in .mp4"));
        };
        let mut hidden = OsString::from(".");
        hidden.push(name);
        // Two processes that write the same video must not share it.
        hidden.push(format!(".{}.partial", std::process::id()));
        Ok(Self { path: target.with_file_name(hidden) })
    }

    /// How `ffmpeg` is told the name: `file:` keeps one with a colon from being read as a protocol.
    fn as_output(&self) -> OsString {
        let mut output = OsString::from("file:");
        output.push(&self.path);
        output
    }

    fn complete(self, target: &Path) -> Result<()> {
        std::fs::rename(&self.path, target).map_err(|source| Error::io(target, "giving the video its name", source))
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        // After a successful renaming there is nothing left to remove, and nobody to tell otherwise.
        let _ = std::fs::remove_file(&self.path);
    }
}

fn encode<I>(program: &Path, path: &Path, geometry: Geometry, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    geometry.check(path)?;
    let partial = Partial::beside(path)?;
    let mut child = Command::new(program)
        .args(geometry.arguments())
        .arg(partial.as_output())
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|source| spawn_error(program, path, source))?;
    // Read what it says while it runs, so that it never waits for somebody to listen.
    let listener = child.stderr.take().map(|mut pipe| {
        std::thread::spawn(move || {
            let mut log = Vec::new();
            // A log cut short is still the best explanation there is.
            let _ = pipe.read_to_end(&mut log);
            log
        })
    });
    let fed = feed(child.stdin.take(), path, geometry, frames);
    let status = child.wait().map_err(|source| Error::io(path, "waiting for ffmpeg", source))?;
    let log = listener.and_then(|listener| listener.join().ok()).unwrap_or_default();
    // The pipe breaks when ffmpeg gives up: its own words say why.
    if matches!(fed, Err(Error::Io { .. })) || (fed.is_ok() && !status.success()) {
        let context = format!("writing {} with ffmpeg ({status})", path.display());
        return Err(Error::external(context, last_lines(&log)));
    }
    fed?;
    partial.complete(path)
}

/// Writes all frames to the program and closes its input.
fn feed<I>(input: Option<ChildStdin>, path: &Path, geometry: Geometry, frames: I) -> Result<()>
where
    I: IntoIterator,
    I::Item: AsRef<[u8]>,
{
    let expected = geometry.width * geometry.height * 3;
    let mut count = 0usize;
    if let Some(mut input) = input {
        for frame in frames {
            let frame = frame.as_ref();
            if frame.len() != expected {
                return Err(Error::mismatch(
                    format!("frame {count} of {}", path.display()),
                    format!("{} bytes", frame.len()),
                    format!("{expected}, for {} x {} RGB pixels", geometry.width, geometry.height),
                ));
            }
            input.write_all(frame).map_err(|source| Error::io(path, "piping frames into ffmpeg", source))?;
            count += 1;
        }
    }
    if count == 0 {
        return Err(Error::config(
            format!("video {}", path.display()),
            "there is no frame to write",
            "record at least one step",
        ));
    }
    Ok(())
}

fn spawn_error(program: &Path, path: &Path, source: std::io::Error) -> Error {
    if source.kind() == std::io::ErrorKind::NotFound {
        return Error::external(
            format!("writing {}", path.display()),
            format!(
                "the program '{}' was not found; install FFmpeg (`apt-get install ffmpeg`, `brew install ffmpeg`) \
                 or do without videos",
                program.display()
            ),
        );
    }
    Error::io(program, "starting ffmpeg", source)
}

/// The end of what a program said, on one line.
fn last_lines(log: &[u8]) -> String {
    const LINES: usize = 4;
    let text = String::from_utf8_lossy(log);
    let lines: Vec<&str> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    match lines.len() {
        0 => "it gave no reason".to_owned(),
        n => lines[n.saturating_sub(LINES)..].join("; "),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(width: usize, height: usize, n: usize) -> Vec<Vec<u8>> {
        (0..n).map(|t| (0..width * height * 3).map(|i| ((i * 7 + t * 31) % 256) as u8).collect()).collect()
    }

    /// `[width, height, frames]` of a video as ffprobe decodes it; none where it is not installed.
    fn probe(path: &Path) -> Option<[usize; 3]> {
        let output = Command::new("ffprobe")
            .args(["-v", "error", "-count_frames", "-select_streams", "v:0", "-of", "csv=p=0"])
            .args(["-show_entries", "stream=width,height,nb_read_frames"])
            .arg(path)
            .output()
            .ok()?;
        let numbers: Vec<usize> =
            String::from_utf8_lossy(&output.stdout).trim().split(',').filter_map(|n| n.parse().ok()).collect();
        numbers.try_into().ok()
    }

    fn has_ffmpeg() -> bool {
        Command::new("ffmpeg").arg("-version").stdout(Stdio::null()).status().is_ok_and(|status| status.success())
    }

    fn names(folder: &Path) -> Vec<OsString> {
        std::fs::read_dir(folder).expect("folder").map(|entry| entry.expect("entry").file_name()).collect()
    }

    #[test]
    fn every_frame_is_there_and_equal_frames_give_equal_bytes() {
        if !has_ffmpeg() {
            return;
        }
        let folder = tempfile::tempdir().expect("folder");
        let [a, b] = ["a.mp4", "b: 2.mp4"].map(|name| folder.path().join(name));
        let frames = frames(31, 18, 12);
        write_mp4(&a, 31, 18, 10, &frames).expect("video");
        write_mp4(&b, 31, 18, 10, &frames).expect("video");
        assert_eq!(std::fs::read(&a).expect("a"), std::fs::read(&b).expect("b"));
        write_mp4_scaled(&b, 31, 18, 10, 4, frames.iter().map(Vec::as_slice)).expect("video");
        if let Some(found) = probe(&a) {
            assert_eq!(found, [32, 18, 12]);
            assert_eq!(probe(&b), Some([124, 72, 12]));
        }
        assert_eq!(names(folder.path()).len(), 2, "nothing but the two videos is left");
    }

    #[test]
    fn failures_say_why_and_leave_nothing() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.mp4");
        let geometry = Geometry { width: 4, height: 4, fps: 10, scale: 1 };
        let message = |program: &str, geometry, frames: &[Vec<u8>]| {
            encode(Path::new(program), &path, geometry, frames).expect_err("fails").to_string()
        };
        let good = frames(4, 4, 3);
        assert!(message("no-such-ffmpeg", geometry, &good).contains("install FFmpeg"));
        assert!(message("ffmpeg", Geometry { scale: 0, ..geometry }, &good).contains("scaled by 0"));
        if has_ffmpeg() {
            let wrong = [good[0].clone(), vec![0; 5]];
            let found = message("ffmpeg", geometry, &wrong);
            assert!(found.contains("frame 1") && found.contains("5 bytes") && found.contains("48"), "{found}");
            assert!(message("ffmpeg", geometry, &[]).contains("no frame"));
            // A program that stops without reading: its own words come through, not a broken pipe.
            let nowhere = folder.path().join("missing").join("a.mp4");
            let lost = write_mp4(&nowhere, 4, 4, 10, frames(4, 4, 3)).expect_err("fails").to_string();
            assert!(lost.contains("No such file or directory"), "{lost}");
        }
        assert!(names(folder.path()).is_empty());
    }

    #[test]
    fn small_worlds_are_enlarged_by_whole_factors() {
        assert_eq!(
            [(64, 64, 256), (224, 224, 256), (512, 64, 256), (60, 30, 256)].map(|(w, h, t)| integer_scale(w, h, t)),
            [4, 1, 1, 4]
        );
    }

    #[test]
    fn the_end_of_a_log_is_kept() {
        assert_eq!(last_lines(b""), "it gave no reason");
        assert_eq!(last_lines(b"1\n2\n\n3\n 4 \n5\n"), "2; 3; 4; 5");
    }
}
