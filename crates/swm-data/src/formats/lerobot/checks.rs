//! Checks of a reader: that the files are those of the dataset that was opened, and their rows those of the episodes.

use super::episode_files::EpisodeFiles;
use super::info::{Info, damaged};
use super::reader::LerobotReader;
use super::table;
use crate::dataset::Irregularity;
use crate::formats::opened;
use std::ops::Range;
use std::path::Path;
use swm_core::{ColumnSpec, DType, Error, Result};

/// The feature that counts the rows of an episode.
const FRAME_INDEX: &str = "frame_index";

impl LerobotReader {
    /// Checks, after something was read, that the dataset is still the one that was opened.
    pub fn check(&self) -> Result<()> {
        self.opened.check(|| self.is_same())
    }

    /// Whether the dataset in the folder is this one, or has grown from it. A program that replaces files by itself counts no
    /// replacement: the data files must be as they were, for writers append others.
    fn is_same(&self) -> Result<bool> {
        let now = Info::read(&self.root)?;
        let episodes = EpisodeFiles::read(&self.root, &now)?;
        let lengths = |all: &[EpisodeFiles]| all.iter().map(|files| files.length).collect::<Vec<_>>();
        if now.replaced() != self.info.replaced() || !lengths(&episodes).starts_with(&lengths(&self.files_of_episodes))
        {
            return Ok(false);
        }
        Ok(self.files.iter().zip(&self.states).all(|((path, _), known)| opened::state(path) == *known))
    }

    /// Checks that a data file has the rows of its episodes, once.
    pub fn check_rows(&self, file: usize) -> Result<()> {
        let (path, episodes) = &self.files[file];
        if self.checked[file].get().is_some() {
            return Ok(());
        }
        let mut expected = self.rows_of(episodes);
        table::read_batches(path, &["episode_index"], None, size_of::<i64>(), &mut |batch| {
            let found = table::integers(path, std::slice::from_ref(&batch), "episode_index")?;
            let fits = found.into_iter().all(|index| expected.next() == Some(index));
            if fits { Ok(()) } else { Err(other_rows(path)) }
        })?;
        if expected.next().is_some() {
            return Err(other_rows(path));
        }
        self.checked[file].set(()).ok();
        Ok(())
    }

    /// The episode of every row of some episodes.
    pub fn rows_of(&self, episodes: &Range<usize>) -> impl Iterator<Item = i64> {
        let all = self.rows.episodes();
        episodes.clone().flat_map(|e| std::iter::repeat_n(all[e].index, self.files_of_episodes[e].length))
    }

    /// Finds the episodes whose parts of videos are longer than their rows.
    pub fn excess_of_videos(&self) -> Vec<Irregularity> {
        let cameras = self.info.video_keys();
        let episodes = self.files_of_episodes.iter().enumerate();
        let found = episodes.flat_map(|(episode, files)| {
            cameras.iter().zip(&files.videos).filter_map(move |(camera, part)| {
                let what = part.excess(camera, files.length, self.fps)?;
                Some(Irregularity { episode: Some(episode), what })
            })
        });
        found.collect()
    }

    /// Finds the episodes with rows whose timestamps are outside of the episode's part of a video.
    pub fn misplaced_times(&self) -> Result<Vec<Irregularity>> {
        if self.info.video_keys().is_empty() {
            return Ok(vec![]);
        }
        let times = self.timestamps()?;
        let episodes = self.files_of_episodes.iter().enumerate();
        let found = episodes.filter_map(|(episode, files)| {
            let (step, time) = (0..files.length)
                .map(|step| (step, self.time(times, episode, step)))
                .find(|&(_, time)| files.videos.iter().any(|part| part.at(time, self.fps).is_none()))?;
            Some(Irregularity { episode: Some(episode), what: outside(episode, step, time) })
        });
        Ok(found.collect())
    }

    /// Finds the episodes whose rows do not count up from 0 in their file. Readers take rows in the order of the file.
    pub fn misplaced_rows(&self) -> Result<Vec<Irregularity>> {
        if !self.info.features.0.iter().any(|(name, _)| name == FRAME_INDEX) {
            return Ok(vec![]);
        }
        let bytes = self.read_values(FRAME_INDEX, &ColumnSpec::new(FRAME_INDEX, DType::Int64, []))?;
        let stored: Vec<i64> = bytes.as_chunks().0.iter().map(|&bytes| i64::from_ne_bytes(bytes)).collect();
        let episodes = self.rows.first_rows().iter().zip(self.rows.episodes()).enumerate();
        let found = episodes.filter_map(|(episode, (&first, known))| {
            let rows = stored.get(first as usize..first as usize + known.length)?;
            let (row, value) = rows.iter().enumerate().find(|&(row, &value)| value != row as i64)?;
            let what = format!("the stored steps do not count up from 0: row {row} holds {value}");
            Some(Irregularity { episode: Some(episode), what })
        });
        Ok(found.collect())
    }
}

/// What is wrong with a row whose frame is another episode's.
pub(super) fn outside(episode: usize, step: usize, time: f64) -> String {
    format!(
        "step {step} of episode {episode} has the timestamp {time:.3} s, which is outside of the episode's part of a video"
    )
}

/// The error of a file that has other rows.
pub(super) fn other_rows(path: &Path) -> Error {
    damaged(path, "its rows do not belong to the episodes that it should contain".to_owned())
}
