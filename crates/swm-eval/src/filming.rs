//! [`Videos`]: films of the first episodes of an evaluation.

use std::path::{Path, PathBuf};
use swm_core::{EnvPool, Error, Result};

/// Videos of the first episodes: the agent on the left, its goal on the right.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Videos {
    /// The folder of the results file; paths in results are relative to it.
    pub root: PathBuf,
    /// The file names' beginning, below `root`: `videos/random` gives `videos/random-0.mp4`.
    pub prefix: String,
    /// How many episodes.
    pub count: usize,
    /// Frames a second, one a step.
    pub fps: u32,
}

/// The side small pictures are enlarged towards, in pixels.
const WATCHABLE: usize = 256;

/// Keeps the pictures of the first episodes and writes them as videos in the end.
pub(crate) struct Filming {
    videos: Videos,
    /// `(height, width)` of one picture.
    size: (usize, usize),
    /// Places of `pixels` and `goal` in the infos.
    places: [usize; 2],
    /// The frames of every filmed episode.
    frames: Vec<Vec<Vec<u8>>>,
}

impl Filming {
    pub fn new(videos: &Videos, pool: &EnvPool, episodes: usize) -> Result<Self> {
        let Some(size) = pool.image() else {
            return Err(Error::config(
                "videos",
                "the world draws no pictures",
                "give the world a picture size or ask for no videos",
            ));
        };
        let schema = pool.infos().schema();
        Ok(Self {
            videos: videos.clone(),
            size,
            places: [schema.index("pixels")?, schema.index("goal")?],
            frames: vec![vec![]; videos.count.min(episodes)],
        })
    }

    pub fn frame(&mut self, episode: usize, slot: usize, pool: &EnvPool) {
        let Some(frames) = self.frames.get_mut(episode) else { return };
        let row = pool.infos().row(slot);
        let [agent, goal] = self.places.map(|place| row.at::<u8>(place));
        let line = self.size.1 * 3;
        let pairs = agent.chunks_exact(line).zip(goal.chunks_exact(line));
        frames.push(pairs.flat_map(|(agent, goal)| agent.iter().chain(goal).copied()).collect());
    }

    /// Writes the videos of those of the `counted` episodes that were filmed, named by their place among these, and
    /// returns their paths, relative to the root. A video that cannot be written (this build
    /// has no videos, the disk is full) costs a warning: the figures stand without it.
    pub fn write(self, counted: &[usize]) -> Vec<String> {
        let (height, width) = self.size;
        let scale = swm_data::integer_scale(width, height, WATCHABLE);
        let mut written = vec![];
        for (i, &episode) in counted.iter().enumerate() {
            let Some(frames) = self.frames.get(episode) else { continue };
            let name = format!("{}-{i}.mp4", self.videos.prefix);
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
