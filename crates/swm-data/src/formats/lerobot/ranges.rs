//! The ranges of rows and of times that `meta/episodes` states for each episode. They must fit the lengths of the episodes and
//! each other: rows are read in the order of the files, frames from the start time on.

use super::episode_files::EpisodeFiles;
use super::info::damaged;
use arrow_array::cast::AsArray as _;
use arrow_array::types::ArrowPrimitiveType;
use arrow_array::{Array as _, RecordBatch};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use swm_core::Result;

/// The tolerance of times, in frames. LeRobot adds up the durations of videos, which are rounded.
const TOLERANCE: f64 = 0.5;

/// The columns of the first row of an episode, and of the row after its last, counted over the dataset.
pub(super) const ROWS: [&str; 2] = ["dataset_from_index", "dataset_to_index"];

/// The part of a video that has the frames of an episode.
pub(super) struct VideoPart {
    pub path: PathBuf,
    /// The start time in seconds.
    pub begin: f64,
    /// The end time in seconds, if it is stated.
    pub end: Option<f64>,
}

/// Compares the ranges of one episode after the other.
pub(super) struct Ranges {
    fps: f64,
    /// The number of rows of the episodes before.
    rows: usize,
    /// For each video, the latest end time so far and the episode that ends there.
    ends: HashMap<PathBuf, (f64, usize)>,
    /// The number of episodes so far.
    episodes: usize,
}

impl Ranges {
    pub fn new(fps: f64) -> Self {
        Self { fps, rows: 0, ends: HashMap::new(), episodes: 0 }
    }

    /// Checks the ranges of the next episode in the list `list`. `rows` are its values in [`ROWS`], as far as they are stated, and
    /// `cameras` the names of the video features.
    ///
    /// # Errors
    /// If the ranges contradict the length of the episode or an earlier episode.
    pub fn check(&mut self, list: &Path, files: &EpisodeFiles, rows: [Option<i64>; 2], cameras: &[&str]) -> Result<()> {
        let before = self.rows;
        let after = before.saturating_add(files.length);
        let [from, to] = rows;
        let differs =
            |stated: Option<i64>, expected: usize| stated.is_some_and(|row| usize::try_from(row) != Ok(expected));
        if differs(from, before) || differs(to, after) {
            let name = |row: Option<i64>| row.map_or_else(|| "?".to_owned(), |row| row.to_string());
            let problem = format!(
                "episode {} has the rows {}..{} ({}, {}), but its length {} after {before} earlier rows gives {before}..{after}",
                self.episodes,
                name(from),
                name(to),
                ROWS[0],
                ROWS[1],
                files.length,
            );
            return Err(damaged(list, problem));
        }
        cameras.iter().zip(&files.videos).try_for_each(|(camera, part)| {
            self.check_times(part, files.length).map_err(|problem| {
                let (episode, end) = (self.episodes, part.end.map_or("?".to_owned(), |end| format!("{end:.3} s")));
                let stated = format!("from_timestamp {:.3} s and to_timestamp {end}", part.begin);
                damaged(list, format!("episode {episode} has {stated} in the video of '{camera}': it {problem}"))
            })
        })?;
        self.rows = after;
        self.episodes += 1;
        Ok(())
    }

    fn check_times(&mut self, part: &VideoPart, length: usize) -> Result<(), String> {
        let tolerance = TOLERANCE / self.fps;
        let needed = part.begin + length as f64 / self.fps;
        if part.end.is_some_and(|end| end < needed - tolerance) {
            return Err(format!("is shorter than its {length} rows at {} frames per second", self.fps));
        }
        let end = part.end.map_or(needed, |end| end.max(needed));
        match self.ends.get_mut(&part.path) {
            Some((before, episode)) if part.begin < *before - tolerance => {
                Err(format!("begins before the end of episode {episode} at {before:.3} s"))
            }
            Some(latest) => {
                *latest = (end, self.episodes);
                Ok(())
            }
            None if part.begin < -tolerance => Err("begins before the video".to_owned()),
            None => {
                self.ends.insert(part.path.clone(), (end, self.episodes));
                Ok(())
            }
        }
    }
}

impl VideoPart {
    /// The time in the video of a row that is `time` seconds after the start of its episode; `None` if the frame there is another
    /// episode's.
    pub fn at(&self, time: f64, fps: f64) -> Option<f64> {
        let (at, tolerance) = (self.begin + time, TOLERANCE / fps);
        let is_inside = at >= self.begin - tolerance && self.end.is_none_or(|end| at <= end - tolerance);
        is_inside.then_some(at)
    }

    /// What is wrong with a part that is longer than the rows of its episode; `None` if it is not.
    pub fn excess(&self, camera: &str, length: usize, fps: f64) -> Option<String> {
        let (end, rows) = (self.end?, length as f64 / fps);
        let seconds = end - self.begin;
        (seconds > rows + TOLERANCE / fps).then(|| {
            let stated = format!("from_timestamp {:.3} s and to_timestamp {end:.3} s are {seconds:.3} s", self.begin);
            format!("in the video of '{camera}', {stated}, but its {length} rows at {fps} frames per second take {rows:.3} s")
        })
    }
}

/// The values of a column that states one end of a range for each episode; `None` where it is missing or of another type, because
/// reading does not depend on it.
///
/// # Errors
/// If a value is null. `what` names the values.
pub(super) fn stated<T: ArrowPrimitiveType>(
    list: &Path,
    batches: &[RecordBatch],
    column: &str,
    what: &str,
    is_valid: impl Fn(T::Native) -> bool,
) -> Result<Vec<Option<T::Native>>> {
    let mut values = vec![];
    for batch in batches {
        let Some(array) = batch.column_by_name(column).and_then(|array| array.as_primitive_opt::<T>()) else {
            values.resize(values.len() + batch.num_rows(), None);
            continue;
        };
        if array.null_count() > 0 || !array.values().iter().all(|&value| is_valid(value)) {
            return Err(damaged(list, format!("it lacks {what}")));
        }
        values.extend(array.values().iter().copied().map(Some));
    }
    Ok(values)
}
