//! Writes version 3.0. Finished episodes accumulate until the [`CommitPolicy`](crate::CommitPolicy) requires a commit.
//! A commit writes one data file, one video per camera, and one file that describes the episodes, each atomically. It
//! then replaces `meta/info.json`, which declares the number of committed episodes.

use super::features::{FRAMES_PER_SECOND, new_info, stored_columns};
use super::info::{DATA_PATH, EPISODES_PATH, Info, VIDEO_PATH, WriterMetadata, damaged, fill};
use super::reader::{LerobotReader, StoredConstant};
use super::removal::{self, INFO, STATS, TASKS, WRITING};
use super::stats::{self, Stats};
use super::table::{self, write_atomically};
use super::{CONSTANTS, NO_TASK, TASK, values};
use crate::dataset::Location;
use crate::dataset::episodes;
use crate::dataset::{Constants, Reader as _, WriteMode, WriteOptions, Writer, with_stored};
use crate::formats::replacing::ReplacingWriter;
use crate::formats::set_aside::{self, LEROBOT};
use arrow_array::builder::{ListBuilder, StringBuilder};
use arrow_array::{ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_schema::{DataType, Field, Schema as ArrowSchema};
use rayon::prelude::*;
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use swm_core::columns::ACTION;
use swm_core::files::{self, Lock};
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};
use swm_video::{Encoder, Encoding};

/// Creates, continues or replaces a dataset.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    LerobotWriter::create(location.local("lerobot")?, schema, options)
}

struct LerobotWriter {
    root: PathBuf,
    _lock: Lock,
    options: WriteOptions,
    encoding: Encoding,
    schema: Schema,
    info: Info,
    /// Indices of the stored columns, with the names of their features.
    columns: Vec<(usize, String)>,
    stats: Vec<Stats>,
    tasks: Vec<String>,
    /// Index of the next files, counted over all chunks.
    file: usize,
    group: Group,
    /// Whether a write failed.
    failed: bool,
}

/// Uncommitted episodes.
#[derive(Default)]
struct Group {
    episodes: Vec<PendingEpisode>,
    /// The bytes of each numeric column.
    column_bytes: Vec<Vec<u8>>,
    /// The video encoder of each image column.
    encoders: Vec<Option<Encoder>>,
    rows: usize,
    bytes: usize,
}

struct PendingEpisode {
    rows: usize,
    task: String,
    constants: String,
}

impl LerobotWriter {
    fn create(root: &Path, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
        options.codec.check()?;
        let columns = stored_columns(schema)?;
        if schema.columns().iter().any(ColumnSpec::is_image) {
            swm_video::load()?;
        }
        set_aside::recover_unlocked(root, removal::Files)?;
        let exists = root.join(INFO).is_file();
        let is_occupied = root.read_dir().is_ok_and(|mut entries| entries.next().is_some());
        if !exists && is_occupied && !removal::is_unfinished(root) {
            let problem = format!("{} holds other files", root.display());
            return Err(Error::config("dataset", problem, "choose another path"));
        }
        if exists && options.mode == WriteMode::Create {
            let problem = format!("{} exists already", root.display());
            let fix = "choose another path, append to it, or overwrite it";
            return Err(Error::config("dataset", problem, fix));
        }
        let lock = Lock::folder(root)?;
        check_folders(root, &columns, schema)?;
        if exists && options.mode == WriteMode::Overwrite {
            removal::check_replaceable(root)?;
            let (root, schema, incoming) = (root.to_owned(), schema.clone(), schema.clone());
            let replace = move || {
                let committed = |writer: &Self| writer.info.total_episodes;
                set_aside::replace(&root, removal::Files, committed, || Self::begin(&root, &schema, options, lock))
            };
            let check = move |episode: &Batch, _: &Constants| episodes::check_episode(episode, &incoming);
            return Ok(ReplacingWriter::boxed(check, replace));
        }
        Ok(Box::new(Self::begin(root, schema, options, lock)?))
    }

    /// Begins to write into a folder, which is locked.
    fn begin(root: &Path, schema: &Schema, options: WriteOptions, lock: Lock) -> Result<Self> {
        let columns = stored_columns(schema)?;
        let continues = options.mode == WriteMode::Append && root.join(INFO).is_file();
        let mut writer = Self {
            root: root.to_owned(),
            _lock: lock,
            encoding: Encoding::training(options.codec),
            schema: schema.clone(),
            info: new_info(schema, &columns, &options),
            stats: columns.iter().map(|(index, _)| Stats::new(&schema.columns()[*index])).collect(),
            columns,
            tasks: vec![],
            file: 0,
            group: Group::default(),
            failed: false,
            options,
        };
        if continues {
            writer.continue_from()?;
        } else if let Some(recorded) = &mut writer.info.stable_worldmodel {
            // The metadata of a dataset that this one replaces is set aside.
            let old = Info::read(&root.join(LEROBOT.set_aside));
            recorded.replaced = old.map_or(0, |old| old.replaced().saturating_add(1));
        }
        writer.clear_group();
        writer.describe()?;
        files::open_to_write(&root.join(WRITING), true)?;
        Ok(writer)
    }

    /// Loads the state of the existing dataset, and removes uncommitted files of an interrupted writer.
    fn continue_from(&mut self) -> Result<()> {
        let old = LerobotReader::open(&self.root)?;
        let Some(recorded) = old.info.stable_worldmodel.clone() else {
            let problem = "another program wrote it, and its metadata is not sufficient for appending";
            return Err(Error::corrupt(&self.root, problem, "convert it to a new dataset first"));
        };
        self.options.continues.iter().try_for_each(|continued| continued.check(&old, &self.root.display()))?;
        episodes::check_appendable(&self.root.display(), &self.schema, old.schema())?;
        self.file = old.files_of_episodes.last().map_or(0, |files| files.file + 1);
        let manifest = self.options.manifest.clone().or(recorded.manifest);
        self.info = Info { stable_worldmodel: Some(WriterMetadata { manifest, ..recorded }), ..old.info };
        let path = self.root.join(STATS);
        let read = |path: &Path| std::fs::read(path).map_err(|e| Error::io(path, "reading the statistics", e));
        if self.info.total_episodes > 0 {
            let stored: Value =
                serde_json::from_slice(&read(&path)?).map_err(|e| damaged(&path, format!("is unreadable: {e}")))?;
            for ((_, native), stats) in self.columns.iter().zip(&mut self.stats) {
                let known = stats.continue_from(&stored[native.as_str()]);
                known.ok_or_else(|| damaged(&path, format!("it has no statistics of '{native}'")))?;
            }
            let path = self.root.join(TASKS);
            for batch in table::read(&path, &[INDEX])? {
                use arrow_array::cast::AsArray as _;
                let texts = batch.column_by_name(INDEX).and_then(|array| array.as_string_opt::<i32>());
                let texts = texts.ok_or_else(|| damaged(&path, "it holds no strings".to_owned()))?;
                self.tasks.extend(texts.iter().flatten().map(str::to_owned));
            }
        }
        if self.root.join(WRITING).exists() { self.remove_uncommitted() } else { Ok(()) }
    }

    /// Deletes the files of the next commit, which a killed or failed commit left.
    fn remove_uncommitted(&self) -> Result<()> {
        files::delete_named(&self.root, &removal::files_of_index(&self.info, self.file))
    }

    fn clear_group(&mut self) {
        self.group = Group {
            column_bytes: vec![vec![]; self.columns.len()],
            encoders: self.columns.iter().map(|_| None).collect(),
            ..Group::default()
        };
    }

    fn add(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        let rows = episode.rows();
        let (schema, group, encoding) = (&self.schema, &mut self.group, self.encoding);
        let frames = i64::try_from(group.rows).map_err(|e| Error::external("writing an episode", e))?;
        let work = self.columns.par_iter().zip(&mut group.column_bytes).zip(&mut group.encoders).zip(&mut self.stats);
        work.try_for_each(|((((index, _), stored), encoder), stats)| -> Result<()> {
            let column = &schema.columns()[*index];
            let bytes = episode.bytes(*index);
            if !column.is_image() {
                let start = stored.len();
                stored.extend(bytes);
                // Types without a value for a missing action have one in the last row.
                if column.name == ACTION && !matches!(column.dtype, DType::Bool | DType::U8) {
                    repeat_last(&mut stored[start..], column.row_bytes());
                }
                let values = as_f64(column, &stored[start..]);
                stats.add(values.iter().copied(), rows);
                return Ok(());
            }
            let encoder = match encoder {
                Some(encoder) => encoder,
                none => none.insert(Encoder::new(column.shape[1], column.shape[0], FRAMES_PER_SECOND, encoding)?),
            };
            for (frame_index, frame) in (frames..).zip(bytes.chunks_exact(column.row_bytes())) {
                encoder.add_frame(frame, frame_index)?;
            }
            stats.add(bytes.iter().map(|&v| f64::from(v)), rows);
            Ok(())
        })?;
        let text = |bytes: &Vec<u8>| String::from_utf8(bytes.clone()).ok();
        let task = constants.get(TASK).and_then(text).unwrap_or_else(|| NO_TASK.to_owned());
        let as_json: BTreeMap<&String, StoredConstant> = constants
            .iter()
            .map(|(name, bytes)| {
                (name, text(bytes).map_or_else(|| StoredConstant::Bytes(bytes.clone()), StoredConstant::Text))
            })
            .collect();
        let constants = serde_json::to_string(&as_json).map_err(|e| Error::external("describing an episode", e))?;
        if !self.tasks.contains(&task) {
            self.tasks.push(task.clone());
        }
        group.episodes.push(PendingEpisode { rows, task, constants });
        group.rows += rows;
        group.bytes += episode.byte_len();
        Ok(())
    }

    /// Commits the finished episodes, all or none.
    fn commit(&mut self) -> Result<()> {
        let stored = self.info.total_episodes;
        if !self.group.episodes.is_empty() {
            let names = removal::files_of_index(&self.info, self.file);
            let free = names.iter().try_for_each(|name| files::check_free(&self.root.join(name)));
            free.map_err(|error| with_stored(error, stored))?;
        }
        self.try_commit().map_err(|error| {
            // Frees the space of files that no episode refers to.
            if let Err(other) = self.remove_uncommitted() {
                tracing::debug!("after {error}: {other}");
            }
            with_stored(error, stored)
        })
    }

    fn try_commit(&mut self) -> Result<()> {
        if self.group.episodes.is_empty() {
            return Ok(());
        }
        let group = std::mem::take(&mut self.group);
        let indices = removal::indices(&self.info, self.file);
        for ((_, native), encoder) in self.columns.iter().zip(group.encoders) {
            if let Some(encoder) = encoder {
                write_atomically(&self.root.join(fill(VIDEO_PATH, native, &indices)), &encoder.finish()?)?;
            }
        }
        let (schema, batch) = self.data(&group.episodes, &group.column_bytes)?;
        table::write(&self.root.join(fill(DATA_PATH, "", &indices)), &schema, &batch)?;
        let (schema, batch) = self.episodes(&group.episodes, indices.map(|(_, index)| index))?;
        table::write(&self.root.join(fill(EPISODES_PATH, "", &indices)), &schema, &batch)?;
        self.info.total_episodes += group.episodes.len();
        self.info.total_frames += group.rows;
        self.file += 1;
        self.clear_group();
        self.describe()
    }

    /// The table of a group's rows, with the features that LeRobot requires of every dataset.
    fn data(&self, episodes: &[PendingEpisode], bytes: &[Vec<u8>]) -> Result<(Arc<ArrowSchema>, RecordBatch)> {
        let (mut fields, mut arrays): (Vec<Field>, Vec<ArrayRef>) = (vec![], vec![]);
        for ((index, native), bytes) in self.columns.iter().zip(bytes) {
            let column = &self.schema.columns()[*index];
            if !column.is_image() {
                let (field, array) = values::array(native, column, bytes)?;
                fields.push(field);
                arrays.push(array);
            }
        }
        let steps = || episodes.iter().flat_map(|episode| 0..episode.rows);
        let episodes_of_rows =
            || episodes.iter().enumerate().flat_map(|(e, episode)| std::iter::repeat_n(e, episode.rows));
        let task = |e: usize| self.tasks.iter().position(|task| *task == episodes[e].task).unwrap_or(0) as i64;
        let times: arrow_array::Float32Array =
            steps().map(|step| (step as f64 / f64::from(FRAMES_PER_SECOND)) as f32).collect::<Vec<_>>().into();
        fields.push(Field::new("timestamp", DataType::Float32, false));
        arrays.push(Arc::new(times));
        let mut add_integers = |name: &str, values: Vec<i64>| {
            fields.push(Field::new(name, DataType::Int64, false));
            arrays.push(Arc::new(Int64Array::from(values)));
        };
        add_integers("frame_index", steps().map(|step| step as i64).collect());
        add_integers("episode_index", episodes_of_rows().map(|e| (self.info.total_episodes + e) as i64).collect());
        add_integers("index", (0..steps().count()).map(|row| (self.info.total_frames + row) as i64).collect());
        add_integers("task_index", episodes_of_rows().map(task).collect());
        record(fields, arrays)
    }

    /// The table that describes a group's episodes.
    fn episodes(&self, episodes: &[PendingEpisode], indices: [usize; 2]) -> Result<(Arc<ArrowSchema>, RecordBatch)> {
        let (mut fields, mut arrays): (Vec<Field>, Vec<ArrayRef>) = (vec![], vec![]);
        let mut tasks = ListBuilder::new(StringBuilder::new());
        episodes.iter().for_each(|episode| tasks.append_value([Some(&episode.task)]));
        let tasks = tasks.finish();
        fields.push(Field::new("tasks", arrow_array::Array::data_type(&tasks).clone(), true));
        arrays.push(Arc::new(tasks));
        let ends: Vec<usize> = episodes
            .iter()
            .scan(0, |end, e| {
                *end += e.rows;
                Some(*end)
            })
            .collect();
        let starts: Vec<usize> = ends.iter().zip(episodes).map(|(end, episode)| end - episode.rows).collect();
        let mut add_integers = |name: String, values: Vec<usize>| {
            fields.push(Field::new(name, DataType::Int64, false));
            arrays.push(Arc::new(values.into_iter().map(|value| value as i64).collect::<Int64Array>()));
        };
        let repeated = |value: usize| vec![value; episodes.len()];
        let [chunk, file] = indices;
        add_integers("episode_index".to_owned(), (0..episodes.len()).map(|e| self.info.total_episodes + e).collect());
        add_integers("length".to_owned(), episodes.iter().map(|episode| episode.rows).collect());
        for folder in ["data", "meta/episodes"] {
            add_integers(format!("{folder}/chunk_index"), repeated(chunk));
            add_integers(format!("{folder}/file_index"), repeated(file));
        }
        let before = self.info.total_frames;
        add_integers("dataset_from_index".to_owned(), starts.iter().map(|row| before + row).collect());
        add_integers("dataset_to_index".to_owned(), ends.iter().map(|row| before + row).collect());
        let cameras: Vec<&str> = self.info.video_keys();
        for camera in &cameras {
            add_integers(format!("videos/{camera}/chunk_index"), repeated(chunk));
            add_integers(format!("videos/{camera}/file_index"), repeated(file));
        }
        for camera in &cameras {
            for (name, rows) in [("from_timestamp", &starts), ("to_timestamp", &ends)] {
                let times: Vec<f64> = rows.iter().map(|&row| row as f64 / f64::from(FRAMES_PER_SECOND)).collect();
                fields.push(Field::new(format!("videos/{camera}/{name}"), DataType::Float64, false));
                arrays.push(Arc::new(Float64Array::from(times)));
            }
        }
        let constants: Vec<&str> = episodes.iter().map(|episode| episode.constants.as_str()).collect();
        fields.push(Field::new(CONSTANTS, DataType::Utf8, false));
        arrays.push(Arc::new(StringArray::from(constants)));
        record(fields, arrays)
    }

    /// Writes the files that describe the dataset. Writing the last file, `meta/info.json`, commits the episodes.
    fn describe(&mut self) -> Result<()> {
        if self.info.total_episodes > 0 {
            let fields =
                vec![Field::new("task_index", DataType::Int64, false), Field::new(INDEX, DataType::Utf8, false)];
            let task_indices: Int64Array = (0..self.tasks.len() as i64).collect();
            let (schema, batch) =
                record(fields, vec![Arc::new(task_indices), Arc::new(StringArray::from(self.tasks.clone()))])?;
            let pandas = HashMap::from([("pandas".to_owned(), pandas())]);
            let schema = Arc::new(ArrowSchema::clone(&schema).with_metadata(pandas));
            let batch = batch.with_schema(Arc::clone(&schema)).map_err(|e| Error::external("writing a table", e))?;
            table::write(&self.root.join(TASKS), &schema, &batch)?;
            let names = self.columns.iter().map(|(_, native)| native.as_str());
            write_atomically(&self.root.join(STATS), &stats::file(names.zip(&self.stats))?)?;
        }
        self.info.total_tasks = self.tasks.len();
        self.info.splits = BTreeMap::from([("train".to_owned(), format!("0:{}", self.info.total_episodes))]);
        let info = serde_json::to_vec_pretty(&self.info).map_err(|e| Error::external("describing the dataset", e))?;
        write_atomically(&self.root.join(INFO), &info)
    }

    fn complete(&mut self) -> Result<()> {
        if std::mem::replace(&mut self.failed, true) {
            return Err(Error::external(
                "writing an episode",
                "an earlier commit failed; later episodes are not stored",
            ));
        }
        self.commit()?;
        files::delete_file(&self.root.join(WRITING))?;
        self.failed = false;
        Ok(())
    }
}

impl Writer for LerobotWriter {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.schema)?;
        if std::mem::replace(&mut self.failed, true) {
            return Err(Error::external(
                "writing an episode",
                "an earlier commit failed; later episodes are not stored",
            ));
        }
        self.add(episode, constants)?;
        let (group, policy) = (&self.group, &self.options.commit);
        let due =
            group.episodes.len() >= policy.episodes || group.bytes >= policy.bytes || group.rows >= ROWS_PER_COMMIT;
        if due {
            self.commit()?;
        }
        self.failed = false;
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.info.total_episodes + self.group.episodes.len()
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        self.complete()
    }
}

impl Drop for LerobotWriter {
    fn drop(&mut self) {
        if !self.failed
            && let Err(error) = self.complete()
        {
            tracing::error!(dataset = %self.root.display(), "the last episodes could not be stored: {error}");
        }
    }
}

/// Checks that no folder of the dataset's files is a symbolic link, because the files would be written elsewhere.
fn check_folders(root: &Path, columns: &[(usize, String)], schema: &Schema) -> Result<()> {
    ["meta", "meta/episodes", "data", "videos"].iter().try_for_each(|name| files::check_no_link(&root.join(name)))?;
    let mut cameras = columns.iter().filter(|(index, _)| schema.columns()[*index].is_image());
    cameras.try_for_each(|(_, native)| files::check_no_link(&root.join("videos").join(native)))
}

/// The column of `meta/tasks.parquet` that pandas uses as the index.
/// Rows after which a commit is due. Unlike a time, it gives equal collections equal files.
const ROWS_PER_COMMIT: usize = 10_000;
const INDEX: &str = "__index_level_0__";

/// Metadata that makes pandas use [`INDEX`] as the index.
fn pandas() -> String {
    let column = |name: Value, field: &str, kind: &str, numpy: &str| json!({"name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy, "metadata": null});
    json!({
        "index_columns": [INDEX],
        "column_indexes": [{
            "name": null, "field_name": null, "pandas_type": "unicode", "numpy_type": "object",
            "metadata": {"encoding": "UTF-8"},
        }],
        "columns": [
            column(json!("task_index"), "task_index", "int64", "int64"),
            column(Value::Null, INDEX, "unicode", "object"),
        ],
        "creator": {"library": "stable-worldmodel", "version": env!("CARGO_PKG_VERSION")},
        "pandas_version": "2.2.0",
    })
    .to_string()
}

fn record(fields: Vec<Field>, arrays: Vec<ArrayRef>) -> Result<(Arc<ArrowSchema>, RecordBatch)> {
    let schema = Arc::new(ArrowSchema::new(fields));
    let batch = RecordBatch::try_new(Arc::clone(&schema), arrays).map_err(|e| Error::external("writing a table", e))?;
    Ok((schema, batch))
}

/// Copies the previous action into the last row, which has no action. Writes 0 if there is no previous row.
fn repeat_last(bytes: &mut [u8], row_size: usize) {
    let last = bytes.len() - row_size;
    match last.checked_sub(row_size) {
        Some(before) => bytes.copy_within(before..last, last),
        None => bytes.fill(0),
    }
}

/// Converts the bytes of a column to `f64` values.
fn as_f64(column: &ColumnSpec, bytes: &[u8]) -> Vec<f64> {
    match column.dtype {
        DType::Bool | DType::U8 => bytes.iter().map(|&v| f64::from(v)).collect(),
        DType::Int32 => bytes.as_chunks().0.iter().map(|&b| f64::from(i32::from_ne_bytes(b))).collect(),
        DType::Int64 => bytes.as_chunks().0.iter().map(|&b| i64::from_ne_bytes(b) as f64).collect(),
        DType::Float32 => bytes.as_chunks().0.iter().map(|&b| f64::from(f32::from_ne_bytes(b))).collect(),
        DType::Float64 => bytes.as_chunks().0.iter().map(|&b| f64::from_ne_bytes(b)).collect(),
    }
}
