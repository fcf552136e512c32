//! Reads numeric columns from Parquet files, and frames from videos by time. Numeric columns are cached in memory after
//! the first access.

use super::checks::{other_rows, outside};
use super::episode_files::EpisodeFiles;
use super::info::{Column, Info, Kind, damaged};
use super::{TASK, table, values};
use crate::dataset::Location;
use crate::dataset::episodes::{EpisodeRows, content_hash, index_columns};
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::opened::{self, Opened};
use crate::formats::set_aside::LEROBOT;
use arrow_array::Array as _;
use arrow_array::cast::AsArray as _;
use rayon::prelude::*;
use serde::Deserialize;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use swm_core::columns::ACTION;
use swm_core::{Batch, ColumnSpec, DType, Error, Manifest, Result, Schema};
use swm_video::{Source, Video, VideoCache};

/// Features that LeRobot's writers compute for every row of every dataset.
const COMPUTED_FEATURES: [&str; 3] = ["timestamp", "index", "task_index"];

/// Opens a dataset.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    Ok(Arc::new(LerobotReader::open(location.local("lerobot")?)?))
}

pub(super) struct LerobotReader {
    pub(super) root: PathBuf,
    pub info: Info,
    pub(super) fps: f64,
    schema: Schema,
    /// The columns of the schema after the index columns, then the computed features, which are only read by name.
    pub(super) columns: Vec<Column>,
    /// Specs of the index columns and of `columns`.
    specs: Vec<ColumnSpec>,
    pub(super) rows: EpisodeRows,
    pub files_of_episodes: Vec<EpisodeFiles>,
    /// Each data file, with the positions of the episodes in it.
    pub(super) files: Vec<(PathBuf, Range<usize>)>,
    /// The values of each numeric column.
    data: Vec<OnceLock<Vec<u8>>>,
    /// The timestamp of each row in seconds, if stored.
    timestamps: OnceLock<Option<Vec<f32>>>,
    videos: VideoCache<PathBuf>,
    pub(super) opened: Opened,
    /// Whether each data file was found to have the rows of its episodes.
    pub(super) checked: Vec<OnceLock<()>>,
    /// The states of the data files.
    pub(super) states: Vec<Option<opened::State>>,
}

impl LerobotReader {
    pub fn open(root: &Path) -> Result<Self> {
        let opened = Opened::new(root, &LEROBOT);
        let info = Info::read(root)?;
        let fps = info.fps().unwrap_or(1.0);
        let mut columns = info.columns(root)?;
        let is_computed =
            |column: &Column| info.stable_worldmodel.is_none() && COMPUTED_FEATURES.contains(&&*column.native);
        columns.sort_by_key(is_computed);
        let visible = 2 + columns.iter().filter(|column| !is_computed(column)).count();
        let files_of_episodes = EpisodeFiles::read(root, &info)?;
        let mut rows = EpisodeRows::default();
        files_of_episodes.iter().for_each(|files| rows.push(files.length));
        if info.total_episodes != files_of_episodes.len() || rows.total() != info.total_frames as u64 {
            let problem = format!(
                "meta/info.json declares {} episodes and {} rows, but the list of episodes has {} episodes and {} rows",
                info.total_episodes,
                info.total_frames,
                files_of_episodes.len(),
                rows.total()
            );
            return Err(damaged(root, problem));
        }
        let files = data_files(&files_of_episodes);
        let states: Vec<_> = files.iter().map(|(path, _)| opened::state(path)).collect();
        let recorded = info.stable_worldmodel.as_ref().map(|recorded| recorded.schema.columns()).unwrap_or_default();
        let specs: Vec<ColumnSpec> =
            index_columns(recorded).into_iter().chain(columns.iter().map(|column| column.spec.clone())).collect();
        // Checks the declared frame size before memory for frames is allocated.
        let videos = VideoCache::default();
        for column in &columns {
            if let (Kind::Video(feature), Some(episode)) =
                (column.kind, files_of_episodes.iter().find(|episode| episode.length > 0))
            {
                let path = &episode.videos[feature].path;
                let size = videos.frame_size(path, || Ok(Source::File(path.clone())))?;
                let declared = &column.spec.shape[..2];
                if [size.0, size.1] != *declared {
                    let problem = format!("camera '{}' has frames of {size:?}, not {declared:?}", column.native);
                    return Err(damaged(root, problem));
                }
            }
        }
        let reader = Self {
            root: root.to_owned(),
            fps,
            schema: Schema::new(specs[..visible].to_vec())?,
            specs,
            data: columns.iter().map(|_| OnceLock::new()).collect(),
            columns,
            rows,
            files_of_episodes,
            files,
            timestamps: OnceLock::new(),
            videos,
            info,
            opened,
            checked: states.iter().map(|_| OnceLock::new()).collect(),
            states,
        };
        // All that was read so far is of one dataset.
        reader.check()?;
        Ok(reader)
    }

    /// The index of a column in `specs`, by its name or its LeRobot name.
    fn index(&self, name: &str) -> Result<usize> {
        match name {
            "episode_index" => Ok(0),
            "frame_index" => Ok(1),
            _ => match self.columns.iter().position(|column| column.native == name) {
                Some(index) if self.schema.find(name).is_none() => Ok(index + 2),
                _ => self.schema.index(name),
            },
        }
    }

    /// All rows of a numeric column.
    fn data(&self, index: usize) -> Result<&[u8]> {
        if let Some(data) = self.data[index].get() {
            return Ok(data);
        }
        let column = &self.columns[index];
        let mut data = self.read_values(&column.native, &column.spec)?;
        let repeats = self.info.stable_worldmodel.as_ref().is_some_and(|recorded| recorded.last_action_repeats);
        if repeats && column.spec.name == ACTION {
            let size = column.spec.row_bytes();
            let episodes = self.rows.first_rows().iter().zip(self.rows.episodes());
            // LeRobot has no missing values, so the writer repeats the last action of an episode.
            for (&first, episode) in episodes.filter(|(_, episode)| episode.length > 0) {
                // The offset fits in `usize`, because all rows are in memory.
                let last = (first as usize + episode.length) * size;
                set_missing(column.spec.dtype, &mut data[last - size..last]);
            }
        }
        Ok(self.data[index].get_or_init(|| data))
    }

    /// All rows of a numeric feature, from all files.
    pub(super) fn read_values(&self, native: &str, spec: &ColumnSpec) -> Result<Vec<u8>> {
        Schema::new([spec.clone()])?.check_memory(usize::try_from(self.rows.total()).unwrap_or(usize::MAX))?;
        let parts: Result<Vec<Vec<u8>>> = self
            .files
            .par_iter()
            .with_max_len(1)
            .map(|(path, episodes)| {
                let mut bytes = vec![];
                let mut expected = self.rows_of(episodes);
                table::read_batches(path, &["episode_index", native], None, spec.row_bytes(), &mut |batch| {
                    let found = table::integers(path, std::slice::from_ref(&batch), "episode_index")?;
                    if !found.into_iter().all(|index| expected.next() == Some(index)) {
                        return Err(other_rows(path));
                    }
                    let array = batch.column_by_name(native);
                    let array = array.ok_or_else(|| damaged(path, format!("it has no column '{native}'")))?;
                    let added = values::append(array, spec, &mut bytes);
                    added.map_err(|problem| damaged(path, format!("column '{native}': {problem}")))
                })?;
                if expected.next().is_some() { Err(other_rows(path)) } else { Ok(bytes) }
            })
            .collect();
        self.check()?;
        let mut parts = parts?;
        Ok(if parts.len() == 1 { parts.swap_remove(0) } else { parts.concat() })
    }

    /// The timestamp of each row, in seconds from the start of the row's episode.
    pub(super) fn timestamps(&self) -> Result<Option<&[f32]>> {
        if let Some(known) = self.timestamps.get() {
            return Ok(known.as_deref());
        }
        let stored = self.info.features.0.iter().any(|(name, _)| name == "timestamp");
        let times = if stored {
            let bytes = self.read_values("timestamp", &ColumnSpec::new("timestamp", DType::Float32, []))?;
            Some(bytes.as_chunks::<4>().0.iter().map(|&b| f32::from_ne_bytes(b)).collect())
        } else {
            None
        };
        Ok(self.timestamps.get_or_init(|| times).as_deref())
    }

    fn read_video(&self, column: &ColumnSpec, feature: usize, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let times = self.timestamps()?;
        let slots = self.rows.row_slots(column, ranges, out)?;
        let mut frames = Vec::with_capacity(slots.len());
        for ((episode, step), slot) in slots {
            let path = &self.files_of_episodes[episode].videos[feature].path;
            frames.push((path.clone(), self.time_in_video(times, feature, episode, step)?, slot));
        }
        let source = |path: &PathBuf| Ok(Source::File(path.clone()));
        let read = self.videos.read(frames, source, |video, &time| self.frame(video, time));
        self.check()?;
        let part = |range: &StepRange| &self.files_of_episodes[range.episode].videos[feature];
        let videos = ranges.iter().map(|range| Cow::Borrowed(&*part(range).path));
        read.map_err(|error| opened::or_missing(error, videos))
    }

    /// Time from the start of the episode to a row, in seconds.
    pub(super) fn time(&self, times: Option<&[f32]>, episode: usize, step: usize) -> f64 {
        let row = self.rows.first_rows()[episode] as usize + step;
        times.and_then(|times| times.get(row)).map_or(step as f64 / self.fps, |&time| f64::from(time))
    }

    /// Time from the start of a row's video to its frame, in seconds.
    fn time_in_video(&self, times: Option<&[f32]>, feature: usize, episode: usize, step: usize) -> Result<f64> {
        let time = self.time(times, episode, step);
        let at = self.files_of_episodes[episode].videos[feature].at(time, self.fps);
        at.ok_or_else(|| damaged(&self.root, outside(episode, step, time)))
    }

    /// Index of the frame at a time in seconds.
    fn frame(&self, video: &Video, time: f64) -> Result<usize> {
        match video.frame_at(time) {
            Some((frame, distance)) if distance <= 0.25 / self.fps => Ok(frame),
            _ => Err(video.damaged(&format!("has no frame at {time:.3} s"))),
        }
    }

    /// Calls `each` with every encoded image of some rows of a file, and with the image's index among these rows.
    fn each_encoded_image(
        &self,
        column: &Column,
        file: usize,
        rows: Vec<Range<usize>>,
        mut each: impl FnMut(usize, &[u8]) -> Result<()>,
    ) -> Result<()> {
        self.check_rows(file)?;
        let (path, native) = (&self.files[file].0, &*column.native);
        let mut at = 0;
        table::read_batches(path, &[native], Some(rows), column.spec.row_bytes(), &mut |batch| {
            let stored = batch.column_by_name(native).and_then(|array| array.as_struct_opt());
            let bytes = stored.and_then(|stored| stored.column_by_name("bytes")?.as_binary_opt::<i32>());
            let bytes = bytes.ok_or_else(|| damaged(path, format!("column '{native}' holds no images")))?;
            for row in 0..bytes.len() {
                if bytes.is_null(row) {
                    let problem =
                        format!("an image of column '{native}' is in a separate file, which is not supported");
                    return Err(Error::corrupt(path, problem, "embed the images with LeRobot's own tools"));
                }
                each(at, bytes.value(row))?;
                at += 1;
            }
            Ok(())
        })
    }

    fn read_images(&self, column: &Column, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let (height, width) = (column.spec.shape[0], column.spec.shape[1]);
        let mut slots = self.rows.row_slots(&column.spec, ranges, out)?;
        let file_of = |episode: usize| self.files.partition_point(|(_, episodes)| episodes.end <= episode);
        let jobs: Vec<_> = slots.chunk_by_mut(|a, b| file_of(a.0.0) == file_of(b.0.0)).collect();
        let read = jobs.into_par_iter().with_max_len(1).try_for_each(|group| {
            let Some(file) = group.first().map(|((episode, _), _)| file_of(*episode)) else { return Ok(()) };
            let first = self.rows.first_rows()[self.files[file].1.start];
            let row = |(episode, step): (usize, usize)| (self.rows.first_rows()[episode] - first) as usize + step;
            let mut groups: Vec<_> = group.chunk_by_mut(|a, b| a.0 == b.0).collect();
            let rows = groups.iter().map(|same_row| row(same_row[0].0)..row(same_row[0].0) + 1).collect();
            self.each_encoded_image(column, file, rows, |at, bytes| {
                let Some(((_, first), others)) = groups.get_mut(at).and_then(|same_row| same_row.split_first_mut())
                else {
                    return Ok(());
                };
                swm_image::decode(bytes, height, width, first)
                    .map_err(|e| damaged(&self.files[file].0, format!("column '{}': {e}", column.native)))?;
                others.iter_mut().for_each(|(_, other)| other.copy_from_slice(first));
                Ok(())
            })
        });
        self.check().and(read)
    }
}

/// Each data file, with the positions of the episodes in it.
fn data_files(files_of_episodes: &[EpisodeFiles]) -> Vec<(PathBuf, Range<usize>)> {
    let mut files: Vec<(PathBuf, Range<usize>)> = vec![];
    for (position, episode) in files_of_episodes.iter().enumerate() {
        match files.last_mut() {
            Some((path, episodes)) if *path == episode.data => episodes.end = position + 1,
            _ => files.push((episode.data.clone(), position..position + 1)),
        }
    }
    files
}

/// Overwrites an action with the values of a missing action: NaN, or -1 for integers.
fn set_missing(dtype: DType, bytes: &mut [u8]) {
    match dtype {
        DType::Float32 => bytes.as_chunks_mut::<4>().0.fill(f32::NAN.to_ne_bytes()),
        DType::Float64 => bytes.as_chunks_mut::<8>().0.fill(f64::NAN.to_ne_bytes()),
        DType::Int32 => bytes.as_chunks_mut::<4>().0.fill((-1_i32).to_ne_bytes()),
        DType::Int64 => bytes.as_chunks_mut::<8>().0.fill((-1_i64).to_ne_bytes()),
        DType::Bool | DType::U8 => {}
    }
}

impl Reader for LerobotReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.rows.episodes()
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let index = self.index(name)?;
        let spec = &self.specs[index];
        let Some(index) = index.checked_sub(2) else { return self.rows.fill_index_column(spec, ranges, out) };
        let column = &self.columns[index];
        match column.kind {
            Kind::Video(feature) => self.read_video(spec, feature, ranges, out),
            Kind::Images => self.read_images(column, ranges, out),
            Kind::Values => {
                EpisodeRows::check_output(spec, ranges, out)?;
                let (data, size) = (self.data(index)?, spec.row_bytes());
                let mut rest = out;
                for range in ranges {
                    let rows = self.rows.range(range)?;
                    let (to, after) = rest.split_at_mut(range.length * size);
                    to.copy_from_slice(&data[rows.start as usize * size..rows.end as usize * size]);
                    rest = after;
                }
                Ok(())
            }
        }
    }

    fn read(&self, columns: &[&str], ranges: &[StepRange]) -> Result<Batch> {
        // Unlike the default implementation, accepts LeRobot names.
        let spec = |name: &&str| -> Result<ColumnSpec> {
            let index = self.index(name)?;
            let known = &self.specs[index];
            // Reads the files before memory for the batch is allocated, because files may be shorter than declared.
            if let Some(index) = index.checked_sub(2).filter(|&index| self.columns[index].kind == Kind::Values) {
                self.data(index)?;
            }
            Ok(ColumnSpec::new(*name, known.dtype, known.shape.clone()))
        };
        let specs: Result<Vec<ColumnSpec>> = columns.iter().map(spec).collect();
        let rows = ranges.iter().fold(0_usize, |rows, range| rows.saturating_add(range.length));
        let mut batch = Batch::try_zeros(&Schema::new(specs?)?, rows)?;
        for (i, name) in columns.iter().enumerate() {
            self.read_column(name, ranges, batch.bytes_mut(i))?;
        }
        Ok(batch)
    }

    /// How often the dataset was replaced, and the sizes of its data files, which writers do not change.
    fn identity(&self, episodes: usize) -> Result<String> {
        let files = self.files.iter().zip(&self.states).take_while(|((_, range), _)| range.start < episodes);
        let sizes: Vec<String> = files.map(|(_, state)| format!("{:?}", state.map(|(_, _, size)| size))).collect();
        Ok(format!("{:?} {}", self.info.replaced(), sizes.join(" ")))
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        let Some(files) = self.files_of_episodes.get(episode) else {
            let given = format!("episode position {episode}");
            return Err(Error::mismatch(
                "reading constants",
                given,
                format!("positions below {}", self.files_of_episodes.len()),
            ));
        };
        let mut constants = Constants::new();
        if let Some(stored) = &files.constants {
            let stored: BTreeMap<String, StoredConstant> = serde_json::from_str(stored)
                .map_err(|e| damaged(&self.root, format!("the constants of episode {episode} are unreadable: {e}")))?;
            constants.extend(stored.into_iter().map(|(name, value)| (name, value.into_bytes())));
        } else if !files.tasks.is_empty() {
            constants.insert(TASK.to_owned(), files.tasks.join("\n").into_bytes());
        }
        Ok(constants)
    }

    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let mut found = self.excess_of_videos();
        found.extend(self.misplaced_times()?);
        found.extend(self.misplaced_rows()?);
        Ok(found)
    }

    fn sources(&self) -> Vec<PathBuf> {
        vec![self.root.clone()]
    }

    fn manifest(&self) -> Option<Manifest> {
        self.info.stable_worldmodel.as_ref()?.manifest.clone()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut parts: BTreeMap<String, u64> = BTreeMap::new();
        let mut folders = vec![self.root.clone()];
        while let Some(folder) = folders.pop() {
            let io = |e| Error::io(&folder, "listing the folder", e);
            for entry in std::fs::read_dir(&folder).map_err(io)? {
                let entry = entry.map_err(io)?;
                let metadata = entry.metadata().map_err(io)?;
                if metadata.is_dir() {
                    folders.push(entry.path());
                    continue;
                }
                let path = entry.path();
                let camera = self.columns.iter().find(|column| {
                    column.spec.is_image() && path.components().any(|part| part.as_os_str() == column.native.as_str())
                });
                let part = match camera {
                    Some(column) => column.spec.name.clone(),
                    None if path.starts_with(self.root.join("data")) => "(numeric columns)".to_owned(),
                    None => "(metadata)".to_owned(),
                };
                *parts.entry(part).or_default() += metadata.len();
            }
        }
        let mut parts: Vec<(String, u64)> = parts.into_iter().collect();
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }

    fn content_hash(&self) -> Result<String> {
        let times = self.timestamps()?;
        content_hash(&self.rows, &self.schema.columns()[2..], |spec, add| {
            let index = self.schema.index(&spec.name)? - 2;
            let column = &self.columns[index];
            for (position, episode) in self.rows.episodes().iter().enumerate() {
                match column.kind {
                    Kind::Values => {
                        let (data, size) = (self.data(index)?, spec.row_bytes());
                        let rows = self.rows.range(&StepRange::new(position, 0, episode.length))?;
                        data[rows.start as usize * size..rows.end as usize * size]
                            .chunks_exact(size)
                            .for_each(&mut *add);
                    }
                    Kind::Images => {
                        let file = self.files.partition_point(|(_, episodes)| episodes.end <= position);
                        let first = self.rows.first_rows()[position] - self.rows.first_rows()[self.files[file].1.start];
                        let rows = first as usize..first as usize + episode.length;
                        self.each_encoded_image(column, file, vec![rows], |_, bytes| {
                            add(bytes);
                            Ok(())
                        })?;
                    }
                    Kind::Video(feature) => {
                        let path = &self.files_of_episodes[position].videos[feature].path;
                        let video = self.videos.get(path, || Ok(Source::File(path.clone())))?;
                        let frames: Result<Vec<usize>> = (0..episode.length)
                            .map(|step| self.frame(&video, self.time_in_video(times, feature, position, step)?))
                            .collect();
                        video.coded(frames?, &mut *add)?;
                    }
                }
            }
            Ok(())
        })
    }
}

/// A constant in JSON: a string, or bytes that are not UTF-8.
#[derive(Deserialize, serde::Serialize)]
#[serde(untagged)]
pub(super) enum StoredConstant {
    Text(String),
    Bytes(Vec<u8>),
}

impl StoredConstant {
    fn into_bytes(self) -> Vec<u8> {
        match self {
            Self::Text(text) => text.into_bytes(),
            Self::Bytes(bytes) => bytes,
        }
    }
}
