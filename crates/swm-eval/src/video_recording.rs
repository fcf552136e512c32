//! [`VideoRecording`]: videos of the first episodes of an evaluation, and their posters.

use crate::frame_strip::side_by_side;
use std::path::{Path, PathBuf};
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{EnvPool, Error, Result, files};

/// Options of the videos of the first episodes. A video has the frame of the agent on the left and the frame of the
/// goal on the right. Its poster, the first frame as a PNG file, is beside it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Videos {
    /// The folder of the results file; paths in results are relative to it.
    pub root: PathBuf,
    /// The prefix of the file names, below `root`: `videos/random` gives `videos/random-0.mp4`.
    pub prefix: String,
    /// The number of recorded episodes.
    pub count: usize,
    /// Frames per second. There is one frame for each step; very long episodes have one for every second, fourth, ... step.
    pub fps: u32,
    /// Write a frame strip of this many frames, `*.png`, instead of a video.
    pub frame_strip: Option<usize>,
    /// Write the files below [`STAGED`] in `root`, from where [`publish`] moves them: those of older results stay until then.
    pub staged: bool,
}

/// The folder of files that are written and do not have their place yet.
pub const STAGED: &str = ".new";

/// Moves staged videos and their posters to their places; `names` are relative to the root, as results state them.
///
/// # Errors
/// When a file cannot be moved.
pub fn publish<'a>(root: &Path, names: impl IntoIterator<Item = &'a String>) -> Result<()> {
    let staged = root.join(STAGED);
    let mut folder = None;
    for name in names {
        let poster = Path::new(name).with_extension("png");
        for name in [Path::new(name), &poster] {
            let (from, to) = (staged.join(name), root.join(name));
            if !from.exists() {
                continue;
            }
            let parent = to.parent().unwrap_or(root);
            let moved = std::fs::create_dir_all(parent).and_then(|()| std::fs::rename(&from, &to));
            moved.map_err(|source| Error::io(&to, "replacing a video", source))?;
            folder = from.parent().map(Path::to_owned);
        }
    }
    if let Some(folder) = folder {
        files::remove_empty_folder(&folder)?;
        files::remove_empty_folder(&staged)?;
    }
    Ok(())
}

impl Videos {
    /// The path of a video below `root`.
    fn name(&self, index: usize) -> String {
        format!("{}-{index}.mp4", self.prefix)
    }

    /// Where the file of a video is written.
    fn written(&self, index: usize) -> PathBuf {
        let root = if self.staged { self.root.join(STAGED) } else { self.root.clone() };
        root.join(self.name(index))
    }
}

/// The side length that small frames are enlarged to, in pixels.
const MIN_SIDE: usize = 256;

/// The largest size of the frames of all recorded episodes in memory, in bytes.
const FRAMES_BYTES: usize = 256 << 20;

/// The frames of an episode.
#[derive(Clone, Debug, Default)]
struct Frames {
    frames: Vec<Vec<u8>>,
    /// The number of steps so far, with the reset.
    steps: usize,
    /// Every how many steps there is a frame: a power of two; 0 before the first step.
    every: usize,
}

impl Frames {
    /// Appends a frame. Instead of more than `most` frames, every second one is removed, and from then on every second
    /// step has none.
    fn push(&mut self, frame: impl FnOnce() -> Vec<u8>, most: usize) {
        self.every = self.every.max(1);
        if self.steps.is_multiple_of(self.every) && self.frames.len() >= most.max(2) {
            let mut kept = false;
            self.frames.retain(|_| {
                kept = !kept;
                kept
            });
            self.every *= 2;
        }
        if self.steps.is_multiple_of(self.every) {
            self.frames.push(frame());
        }
        self.steps += 1;
    }
}

/// Collects the frames of the first episodes and writes them as videos after the evaluation.
pub(crate) struct VideoRecording {
    videos: Videos,
    /// The `(height, width)` of a frame, in pixels.
    size: (usize, usize),
    /// The indices of `pixels` and `goal` among the info columns.
    columns: [usize; 2],
    /// The frames of every recorded episode.
    frames: Vec<Frames>,
}

impl VideoRecording {
    /// Prepares the recording of up to `videos.count` of the `episodes`.
    ///
    /// # Errors
    /// When the pool renders no frames, the folder of the videos is a file or a symbolic link, or a file of a video or a poster
    /// exists and was not written by this program.
    pub fn new(videos: &Videos, pool: &EnvPool, episodes: usize) -> Result<Self> {
        let Some(size) = pool.image() else {
            return Err(Error::config(
                "videos",
                "the world renders no frames",
                "give the world a frame size, or request no videos",
            ));
        };
        let (schema, count) = (pool.infos().schema(), videos.count.min(episodes));
        // All videos are in the folder of the first one.
        let folder = |path: PathBuf| path.parent().map(Path::to_owned);
        let mut folders = vec![];
        if count > 0 {
            folders.extend(folder(videos.root.join(videos.name(0))));
            if videos.staged {
                folders.extend([Some(videos.root.join(STAGED)), folder(videos.written(0))].into_iter().flatten());
            }
        }
        let is_occupied = |folder: &&PathBuf| {
            **folder != videos.root && (folder.is_symlink() || (folder.exists() && !folder.is_dir()))
        };
        if let Some(folder) = folders.iter().find(is_occupied) {
            let problem = "it is a file or a symbolic link, where the folder of the videos should be";
            return Err(Error::config(folder.display().to_string(), problem, "move it away, or choose another output"));
        }
        for i in 0..count {
            for path in [videos.root.join(videos.name(i)), videos.written(i)] {
                swm_data::check_mp4(&path)?;
                swm_data::check_png(&path.with_extension("png"))?;
            }
        }
        Ok(Self {
            videos: videos.clone(),
            size,
            columns: [schema.index(PIXELS)?, schema.index(GOAL)?],
            frames: vec![Frames::default(); count],
        })
    }

    /// Appends the current frame of a slot to its episode.
    pub fn push(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let (count, (height, width)) = (self.frames.len(), self.size);
        let Some(frames) = self.frames.get_mut(episode) else { return };
        let row = pool.infos().row(slot);
        let [agent, goal] = self.columns.map(|column| row.at::<u8>(column));
        let line = width * 3;
        let frame = || {
            let pairs = agent.chunks_exact(line).zip(goal.chunks_exact(line));
            pairs.flat_map(|(agent, goal)| agent.iter().chain(goal).copied()).collect()
        };
        frames.push(frame, FRAMES_BYTES / (2 * line * height * count).max(1));
    }

    /// Writes a video and a poster of every episode in `counted` that was recorded. A video's number is the index of its episode in
    /// `counted`. Returns the paths relative to the root. A video that cannot be written (no encoder in this build, a
    /// full disk) only causes a warning, because the results do not depend on videos.
    pub fn write(self, counted: &[usize]) -> Vec<String> {
        let (height, width) = self.size;
        let scale = swm_data::integer_scale(width, height, MIN_SIDE);
        let mut written = vec![];
        for (i, &episode) in counted.iter().enumerate() {
            let Some(Frames { frames, .. }) = self.frames.get(episode) else { continue };
            let name = self.videos.name(i);
            let path = self.videos.written(i);
            let poster = path.with_extension("png");
            let folder = path.parent().unwrap_or(Path::new("."));
            let made = std::fs::create_dir_all(folder)
                .map_err(|source| Error::io(folder, "creating the folder of videos", source))
                .and_then(|()| {
                    if let Some(count) = self.videos.frame_strip {
                        let image = side_by_side(frames, self.size, count);
                        return swm_data::write_png(&poster, (count + 1) * width, height, &image);
                    }
                    let slices = frames.iter().map(Vec::as_slice);
                    swm_data::write_mp4_scaled(&path, 2 * width, height, self.videos.fps, scale, slices)?;
                    frames.first().map_or(Ok(()), |first| swm_data::write_png(&poster, 2 * width, height, first))
                });
            match made {
                Ok(()) if self.videos.frame_strip.is_some() => written.push(name.replace(".mp4", ".png")),
                Ok(()) => written.push(name),
                Err(error) => {
                    tracing::warn!("{error}");
                    if self.videos.staged {
                        // Those that hold other videos stay, as do those that cannot be deleted.
                        let _ = files::remove_empty_folder(folder)
                            .and_then(|()| files::remove_empty_folder(&self.videos.root.join(STAGED)));
                    }
                    break;
                }
            }
        }
        written
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_episodes_keep_evenly_spaced_frames() {
        let mut frames = Frames::default();
        for step in 0..1000_u16 {
            frames.push(|| step.to_le_bytes().to_vec(), 8);
        }
        let steps: Vec<u16> = frames.frames.iter().map(|frame| u16::from_le_bytes([frame[0], frame[1]])).collect();
        assert_eq!(steps, [0, 128, 256, 384, 512, 640, 768, 896]);
        assert_eq!((frames.steps, frames.every), (1000, 128));
    }
}
