//! [`VideoRecording`]: videos of the first episodes of an evaluation.

use std::path::{Path, PathBuf};
use swm_core::columns::{GOAL, PIXELS};
use swm_core::{EnvPool, Error, Result};

/// Options of the videos of the first episodes. A video has the frame of the agent on the left and the frame of the
/// goal on the right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Videos {
    /// The folder of the results file; paths in results are relative to it.
    pub root: PathBuf,
    /// The prefix of the file names, below `root`: `videos/random` gives `videos/random-0.mp4`.
    pub prefix: String,
    /// The number of recorded episodes.
    pub count: usize,
    /// Frames per second; there is one frame for each step.
    pub fps: u32,
}

impl Videos {
    /// The path of a video below `root`.
    fn name(&self, index: usize) -> String {
        format!("{}-{index}.mp4", self.prefix)
    }
}

/// The side length that small frames are enlarged to, in pixels.
const MIN_SIDE: usize = 256;

/// Collects the frames of the first episodes and writes them as videos after the evaluation.
pub(crate) struct VideoRecording {
    videos: Videos,
    /// The `(height, width)` of a frame, in pixels.
    size: (usize, usize),
    /// The indices of `pixels` and `goal` among the info columns.
    columns: [usize; 2],
    /// The frames of every recorded episode.
    frames: Vec<Vec<Vec<u8>>>,
}

impl VideoRecording {
    /// Prepares the recording of up to `videos.count` of the `episodes`.
    ///
    /// # Errors
    /// When the pool renders no frames, or a file of a video exists and was not written by this program.
    pub fn new(videos: &Videos, pool: &EnvPool, episodes: usize) -> Result<Self> {
        let Some(size) = pool.image() else {
            return Err(Error::config(
                "videos",
                "the world renders no frames",
                "give the world a frame size, or request no videos",
            ));
        };
        let (schema, count) = (pool.infos().schema(), videos.count.min(episodes));
        (0..count).try_for_each(|i| swm_data::check_mp4(&videos.root.join(videos.name(i))))?;
        Ok(Self {
            videos: videos.clone(),
            size,
            columns: [schema.index(PIXELS)?, schema.index(GOAL)?],
            frames: vec![vec![]; count],
        })
    }

    /// Appends the current frame of a slot to its episode.
    pub fn push(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let Some(frames) = self.frames.get_mut(episode) else { return };
        let row = pool.infos().row(slot);
        let [agent, goal] = self.columns.map(|column| row.at::<u8>(column));
        let line = self.size.1 * 3;
        let pairs = agent.chunks_exact(line).zip(goal.chunks_exact(line));
        frames.push(pairs.flat_map(|(agent, goal)| agent.iter().chain(goal).copied()).collect());
    }

    /// Writes a video of every episode in `counted` that was recorded. A video's number is the index of its episode in
    /// `counted`. Returns the paths relative to the root. A video that cannot be written (no encoder in this build, a
    /// full disk) only causes a warning, because the results do not depend on videos.
    pub fn write(self, counted: &[usize]) -> Vec<String> {
        let (height, width) = self.size;
        let scale = swm_data::integer_scale(width, height, MIN_SIDE);
        let mut written = vec![];
        for (i, &episode) in counted.iter().enumerate() {
            let Some(frames) = self.frames.get(episode) else { continue };
            let name = self.videos.name(i);
            let path = self.videos.root.join(&name);
            let folder = path.parent().unwrap_or(Path::new("."));
            let made = std::fs::create_dir_all(folder)
                .map_err(|source| Error::io(folder, "creating the folder of videos", source))
                .and_then(|()| {
                    let frames = frames.iter().map(Vec::as_slice);
                    swm_data::write_mp4_scaled(&path, 2 * width, height, self.videos.fps, scale, frames)
                });
            match made {
                Ok(()) => written.push(name),
                Err(error) => {
                    tracing::warn!("{error}");
                    break;
                }
            }
        }
        written
    }
}
