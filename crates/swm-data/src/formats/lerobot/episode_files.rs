//! The list of episodes in `meta/`: the files, length, tasks and constants of each episode.

use super::info::{Info, MAX_TEXT_BYTES, damaged};
use super::{CONSTANTS, table};
use arrow_array::Array as _;
use arrow_array::PrimitiveArray;
use arrow_array::cast::AsArray as _;
use arrow_array::types::Float64Type;
use serde::Deserialize;
use std::path::{Path, PathBuf};
use swm_core::{Result, files};

/// The largest number of files of episodes, such as four million episodes with one camera.
const LARGEST_LIST: usize = 8 << 20;

/// Checks the number of files of episodes before their paths are listed.
fn check_list(root: &Path, episodes: usize, cameras: usize) -> Result<()> {
    match episodes.saturating_mul(1 + cameras) {
        0..=LARGEST_LIST => Ok(()),
        _ => Err(damaged(
            root,
            format!("{episodes} episodes with {cameras} cameras have more than {LARGEST_LIST} files"),
        )),
    }
}

/// The files, length, tasks and constants of an episode.
pub(super) struct EpisodeFiles {
    pub tasks: Vec<String>,
    pub data: PathBuf,
    /// For every video feature, the path of a video and the start time of the episode in this video, in seconds.
    pub videos: Vec<(PathBuf, f64)>,
    pub length: usize,
    /// The constants as JSON.
    pub constants: Option<String>,
    /// Index of the episode's files, counted over all chunks.
    pub file: usize,
}

impl EpisodeFiles {
    /// Reads the list of episodes of a dataset, in order.
    ///
    /// # Errors
    /// If the list is missing or damaged.
    pub fn read(root: &Path, info: &Info) -> Result<Vec<Self>> {
        if info.is_v3() { episode_files_v3(root, info) } else { episode_files_v2(root, info) }
    }
}

/// Reads the list of episodes of version 2.1, which has one line and one data file per episode.
fn episode_files_v2(root: &Path, info: &Info) -> Result<Vec<EpisodeFiles>> {
    #[derive(Deserialize)]
    struct Line {
        episode_index: usize,
        #[serde(default)]
        tasks: Vec<String>,
        length: usize,
    }
    let path = root.join("meta").join("episodes.jsonl");
    if !path.exists() {
        return Err(damaged(root, "meta/episodes.jsonl is missing".to_owned()));
    }
    let text = String::from_utf8(files::read(&path, MAX_TEXT_BYTES)?)
        .map_err(|e| damaged(&path, format!("it is no UTF-8 text: {e}")))?;
    let keys = info.video_keys();
    check_list(root, text.lines().count(), keys.len())?;
    let mut files_of_episodes = vec![];
    for line in text.lines().filter(|line| !line.trim().is_empty()) {
        let line: Line =
            serde_json::from_str(line).map_err(|e| damaged(&path, format!("a line is unreadable: {e}")))?;
        if line.episode_index != files_of_episodes.len() {
            let problem = format!("found episode {} instead of {}", line.episode_index, files_of_episodes.len());
            return Err(damaged(&path, problem));
        }
        let fields =
            [("episode_chunk", files_of_episodes.len() / info.chunks_size), ("episode_index", files_of_episodes.len())];
        let videos: Result<Vec<(PathBuf, f64)>> =
            keys.iter().map(|key| Ok((video_file(root, info, key, &fields)?, 0.0))).collect();
        files_of_episodes.push(EpisodeFiles {
            tasks: line.tasks,
            data: info.file(root, &info.data_path, "", &fields)?,
            videos: videos?,
            length: line.length,
            constants: None,
            file: files_of_episodes.len(),
        });
    }
    Ok(files_of_episodes)
}

fn video_file(root: &Path, info: &Info, key: &str, indices: &[(&str, usize)]) -> Result<PathBuf> {
    let template = info.video_path.as_deref();
    let template = template.ok_or_else(|| damaged(root, "meta/info.json has no video_path".to_owned()))?;
    info.file(root, template, key, indices)
}

/// Reads the list of episodes of version 3.0, which has one row per episode.
#[allow(clippy::too_many_lines, reason = "one block per column of the table")]
fn episode_files_v3(root: &Path, info: &Info) -> Result<Vec<EpisodeFiles>> {
    let folder = root.join("meta").join("episodes");
    let mut files = vec![];
    // The folder does not exist if there are no episodes yet.
    for chunk in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
        let entries = std::fs::read_dir(chunk.path()).into_iter().flatten().flatten().map(|entry| entry.path());
        files.extend(entries.filter(|path| path.extension().is_some_and(|suffix| suffix == "parquet")));
    }
    files.sort();
    let keys = info.video_keys();
    let video_column = |key: &str, field: &str| format!("videos/{key}/{field}");
    let mut columns: Vec<String> =
        ["episode_index", "tasks", "length", "data/chunk_index", "data/file_index", CONSTANTS]
            .map(str::to_owned)
            .to_vec();
    for key in &keys {
        columns.extend(["chunk_index", "file_index", "from_timestamp"].map(|field| video_column(key, field)));
    }
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    let mut files_of_episodes = vec![];
    for path in &files {
        // Ignores files that are not part of the dataset.
        if files_of_episodes.len() == info.total_episodes {
            break;
        }
        let batches = table::read(path, &columns)?;
        let column_values = |column: &str| -> Result<Vec<usize>> {
            let valid = |value: i64| usize::try_from(value).ok().filter(|&n| n < 1 << 40);
            let values = table::integers(path, &batches, column)?.into_iter().map(valid);
            values.collect::<Option<_>>().ok_or_else(|| damaged(path, format!("a value of '{column}' is invalid")))
        };
        let (index, length) = (column_values("episode_index")?, column_values("length")?);
        check_list(root, files_of_episodes.len() + index.len(), keys.len())?;
        let (chunk, file) = (column_values("data/chunk_index")?, column_values("data/file_index")?);
        let mut videos = vec![];
        for key in &keys {
            let mut start_times = vec![];
            for batch in &batches {
                let column = batch.column_by_name(&video_column(key, "from_timestamp"));
                let column = column.and_then(|array| array.as_primitive_opt::<Float64Type>());
                let all_known = |column: &&PrimitiveArray<Float64Type>| {
                    column.null_count() == 0 && column.values().iter().all(|time| time.is_finite())
                };
                let column = column.filter(all_known);
                let column = column.ok_or_else(|| damaged(path, format!("it lacks start times of '{key}'")))?;
                start_times.extend_from_slice(column.values());
            }
            videos.push((
                column_values(&video_column(key, "chunk_index"))?,
                column_values(&video_column(key, "file_index"))?,
                start_times,
            ));
        }
        let (mut tasks, mut constants) = (vec![], vec![]);
        for batch in &batches {
            tasks.extend(texts(batch, "tasks").unwrap_or_else(|| vec![vec![]; batch.num_rows()]));
            let stored = batch.column_by_name(CONSTANTS).and_then(|array| array.as_string_opt::<i32>());
            constants.extend((0..batch.num_rows()).map(|row| stored.map(|stored| stored.value(row).to_owned())));
        }
        for row in 0..index.len() {
            // Ignores uncommitted episodes of an interrupted writer.
            if files_of_episodes.len() == info.total_episodes {
                break;
            }
            if index[row] != files_of_episodes.len() {
                let problem = format!("found episode {} instead of {}", index[row], files_of_episodes.len());
                return Err(damaged(path, problem));
            }
            let indices = |chunk: usize, file: usize| [("chunk_index", chunk), ("file_index", file)];
            let files: Result<Vec<(PathBuf, f64)>> = keys
                .iter()
                .zip(&videos)
                .map(|(key, (chunk, file, begin))| {
                    Ok((video_file(root, info, key, &indices(chunk[row], file[row]))?, begin[row]))
                })
                .collect();
            files_of_episodes.push(EpisodeFiles {
                tasks: std::mem::take(&mut tasks[row]),
                data: info.file(root, &info.data_path, "", &indices(chunk[row], file[row]))?,
                videos: files?,
                length: length[row],
                constants: constants[row].take(),
                file: chunk[row].saturating_mul(info.chunks_size).saturating_add(file[row]),
            });
        }
    }
    Ok(files_of_episodes)
}

/// The values of a column of lists of strings, or `None` if there is no such column.
fn texts(batch: &arrow_array::RecordBatch, column: &str) -> Option<Vec<Vec<String>>> {
    let lists = batch.column_by_name(column)?.as_list_opt::<i32>()?;
    let text = |list: arrow_array::ArrayRef| -> Option<Vec<String>> {
        let text = list.as_string_opt::<i32>()?;
        Some(text.iter().flatten().map(str::to_owned).collect())
    };
    (0..lists.len()).map(|row| text(lists.value(row))).collect()
}
