//! The list of episodes in `meta/`: the files, length, tasks and constants of each episode.

use super::info::{Info, MAX_TEXT_BYTES, damaged};
use super::ranges::{self, Ranges, VideoPart};
use super::{CONSTANTS, table};
use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float64Type, Int64Type};
use arrow_array::{Array as _, PrimitiveArray, RecordBatch};
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
    /// For every video feature, the part of a video that has the episode's frames.
    pub videos: Vec<VideoPart>,
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
    if !files::exists(&path)? {
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
        let part = |key: &&str| Ok(VideoPart { path: video_file(root, info, key, &fields)?, begin: 0.0, end: None });
        let videos: Result<Vec<VideoPart>> = keys.iter().map(part).collect();
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
    let mut tables = vec![];
    // The folder does not exist if there are no episodes yet.
    for chunk in files::entries(&folder)? {
        let entries = files::entries(&chunk)?.into_iter();
        tables.extend(entries.filter(|path| path.extension().is_some_and(|suffix| suffix == "parquet")));
    }
    tables.sort();
    let keys = info.video_keys();
    let mut columns: Vec<String> =
        ["episode_index", "tasks", "length", "data/chunk_index", "data/file_index", CONSTANTS]
            .into_iter()
            .chain(ranges::ROWS)
            .map(str::to_owned)
            .collect();
    for key in &keys {
        let fields = ["chunk_index", "file_index", "from_timestamp", "to_timestamp"];
        columns.extend(fields.map(|field| video_column(key, field)));
    }
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    let mut files_of_episodes = vec![];
    let mut stated = Ranges::new(info.fps().unwrap_or(1.0));
    for path in &tables {
        // Ignores files that are not part of the dataset.
        if files_of_episodes.len() == info.total_episodes {
            break;
        }
        let batches = table::read(path, &columns)?;
        let (index, length) = (counts(path, &batches, "episode_index")?, counts(path, &batches, "length")?);
        check_list(root, files_of_episodes.len() + index.len(), keys.len())?;
        let chunk = counts(path, &batches, "data/chunk_index")?;
        let file = counts(path, &batches, "data/file_index")?;
        let [from, to] = ranges::ROWS
            .map(|name| ranges::stated::<Int64Type>(path, &batches, name, &format!("values of '{name}'"), |_| true));
        let (from, to) = (from?, to?);
        let videos: Result<Vec<VideoColumns>> =
            keys.iter().map(|key| VideoColumns::read(path, &batches, key)).collect();
        let videos = videos?;
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
            let part = |(key, columns): (&&str, &VideoColumns)| {
                let indices = indices(columns.chunk[row], columns.file[row]);
                let path = video_file(root, info, key, &indices)?;
                let begin = columns.begin[row];
                // The next episode of the video begins where the rows end.
                let end = columns.end[row].or_else(|| Some(begin + length[row] as f64 / info.fps()?));
                Ok(VideoPart { path, begin, end })
            };
            let videos: Result<Vec<VideoPart>> = keys.iter().zip(&videos).map(part).collect();
            let files = EpisodeFiles {
                tasks: std::mem::take(&mut tasks[row]),
                data: info.file(root, &info.data_path, "", &indices(chunk[row], file[row]))?,
                videos: videos?,
                length: length[row],
                constants: constants[row].take(),
                file: chunk[row].saturating_mul(info.chunks_size).saturating_add(file[row]),
            };
            stated.check(path, &files, [from[row], to[row]], &keys)?;
            files_of_episodes.push(files);
        }
    }
    Ok(files_of_episodes)
}

/// The name of a column that describes the videos of a feature.
fn video_column(key: &str, field: &str) -> String {
    format!("videos/{key}/{field}")
}

/// The values of a column of counts or indices.
fn counts(path: &Path, batches: &[RecordBatch], column: &str) -> Result<Vec<usize>> {
    let valid = |value: i64| usize::try_from(value).ok().filter(|&n| n < 1 << 40);
    let values = table::integers(path, batches, column)?.into_iter().map(valid);
    values.collect::<Option<_>>().ok_or_else(|| damaged(path, format!("a value of '{column}' is invalid")))
}

/// The columns that describe the videos of a feature: the indices of the file, and the start and end time of each episode.
struct VideoColumns {
    chunk: Vec<usize>,
    file: Vec<usize>,
    begin: Vec<f64>,
    end: Vec<Option<f64>>,
}

impl VideoColumns {
    fn read(path: &Path, batches: &[RecordBatch], key: &str) -> Result<Self> {
        let mut begin = vec![];
        for batch in batches {
            let column = batch.column_by_name(&video_column(key, "from_timestamp"));
            let column = column.and_then(|array| array.as_primitive_opt::<Float64Type>());
            let all_known = |column: &&PrimitiveArray<Float64Type>| {
                column.null_count() == 0 && column.values().iter().all(|time| time.is_finite())
            };
            let column = column.filter(all_known);
            let column = column.ok_or_else(|| damaged(path, format!("it lacks start times of '{key}'")))?;
            begin.extend_from_slice(column.values());
        }
        let (name, what) = (video_column(key, "to_timestamp"), format!("end times of '{key}'"));
        Ok(Self {
            chunk: counts(path, batches, &video_column(key, "chunk_index"))?,
            file: counts(path, batches, &video_column(key, "file_index"))?,
            begin,
            end: ranges::stated::<Float64Type>(path, batches, &name, &what, f64::is_finite)?,
        })
    }
}

/// The values of a column of lists of strings, or `None` if there is no such column.
fn texts(batch: &RecordBatch, column: &str) -> Option<Vec<Vec<String>>> {
    let lists = batch.column_by_name(column)?.as_list_opt::<i32>()?;
    let text = |list: arrow_array::ArrayRef| -> Option<Vec<String>> {
        let text = list.as_string_opt::<i32>()?;
        Some(text.iter().flatten().map(str::to_owned).collect())
    };
    (0..lists.len()).map(|row| text(lists.value(row))).collect()
}
