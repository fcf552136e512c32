//! Names of the image files: which files in the folder of an image column belong to the dataset.

use std::path::{Path, PathBuf};
use swm_core::{Error, Result};

/// File name suffixes of images. The first is used for writing.
pub(crate) const SUFFIXES: [&str; 3] = ["jpeg", "jpg", "png"];

/// The image files of a format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ImageFiles {
    /// One image per step.
    Images,
    /// One video per episode.
    Videos,
}

/// An image file of a dataset.
pub(super) struct ImageFile {
    pub episode: usize,
    /// The step of an image; 0 for a video.
    pub step: usize,
    /// The path below the folder of the dataset.
    pub name: PathBuf,
}

impl ImageFiles {
    /// The episode and the step in a file name that writers of the format give, also to a temporary file.
    fn parse(self, name: &str) -> Option<(usize, usize)> {
        let rest = name.strip_prefix("ep_")?;
        match self {
            Self::Images => {
                let (episode, step) = rest.strip_suffix(".jpeg")?.split_once("_step_")?;
                Some((index(episode)?, index(step)?))
            }
            Self::Videos => {
                let episode = rest.strip_suffix(".mp4.tmp").or_else(|| rest.strip_suffix(".mp4"))?;
                Some((index(episode)?, 0))
            }
        }
    }

    /// The image files of a column, sorted by episode. Links are not followed.
    pub(super) fn list(self, folder: &Path, column: &str) -> Result<Vec<ImageFile>> {
        let inside = folder.join(column);
        let io = |e| Error::io(&inside, "listing the folder", e);
        let mut found = vec![];
        if !inside.is_dir() || inside.is_symlink() {
            return Ok(found);
        }
        for entry in std::fs::read_dir(&inside).map_err(io)? {
            let name = entry.map_err(io)?.file_name();
            if let Some((episode, step)) = name.to_str().and_then(|name| self.parse(name)) {
                found.push(ImageFile { episode, step, name: Path::new(column).join(name) });
            }
        }
        found.sort_by_key(|file: &ImageFile| (file.episode, file.step));
        Ok(found)
    }
}

/// The files of uncommitted episodes that a killed or failed writer left: those of the consecutive episodes from `from` on.
/// The last is the first, so that a kill while they are deleted in this order leaves consecutive episodes.
pub(super) fn uncommitted(files: &[ImageFile], from: usize) -> Vec<&ImageFile> {
    let mut last = from;
    let mut found: Vec<&ImageFile> = files
        .iter()
        .filter(|file| file.episode >= from)
        .take_while(|file| {
            let consecutive = file.episode <= last;
            last = last.max(file.episode + 1);
            consecutive
        })
        .collect();
    found.reverse();
    found
}

/// Parses an index as writers print it, without a sign and leading zeros.
fn index(text: &str) -> Option<usize> {
    text.parse().ok().filter(|index: &usize| index.to_string() == text)
}

/// Path of the image file of a step.
pub(crate) fn image_path(folder: &Path, column: &str, episode: usize, step: usize, suffix: &str) -> PathBuf {
    folder.join(column).join(format!("ep_{episode}_step_{step}.{suffix}"))
}

/// Path of the video of an episode.
pub(crate) fn video_path(folder: &Path, column: &str, episode: usize) -> PathBuf {
    folder.join(column).join(format!("ep_{episode}.mp4"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_that_writers_give_are_image_files() {
        let images = |name| ImageFiles::Images.parse(name);
        assert_eq!(images("ep_1_step_20.jpeg"), Some((1, 20)));
        for name in
            ["ep_x_step_1.jpeg", "ep_1_step_y.jpeg", "ep_01_step_1.jpeg", "ep_1_step_+1.jpeg", "ep_1_step_1.png"]
        {
            assert_eq!(images(name), None, "{name}");
        }
        let videos = |name| ImageFiles::Videos.parse(name);
        assert_eq!((videos("ep_7.mp4"), videos("ep_7.mp4.tmp")), (Some((7, 0)), Some((7, 0))));
        assert_eq!((videos("ep_7.mov"), videos("ep_seven.mp4"), videos("ep_007.mp4")), (None, None, None));
    }

    #[test]
    fn uncommitted_files_are_those_of_consecutive_episodes() {
        let file = |(episode, step)| ImageFile { episode, step, name: PathBuf::new() };
        let files: Vec<ImageFile> = [(0, 0), (2, 0), (2, 1), (3, 0), (5, 0)].map(file).into();
        let of = |from| uncommitted(&files, from).iter().map(|file| (file.episode, file.step)).collect::<Vec<_>>();
        assert_eq!(of(2), [(3, 0), (2, 1), (2, 0)]);
        assert_eq!((of(0), of(1), of(4)), (vec![(0, 0)], vec![], vec![]));
    }
}
