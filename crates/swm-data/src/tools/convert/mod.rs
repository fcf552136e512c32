//! Converts datasets between formats: resumes interrupted conversions, and verifies the result against the source.
//!
//! The verification compares decoded content. Values of the target must equal the values of the source, except for
//! rounding to single precision. Images must reach a minimum peak signal-to-noise ratio.

mod comparison;
mod losses;
mod shard;

pub use comparison::ColumnComparison;
pub use losses::LEAST_PSNR;
pub use shard::convert_shard;

use crate::dataset::episodes::describe_columns;
use crate::dataset::{CommitPolicy, Constants, Continued, Location, Reader, StepRange, WriteMode, WriteOptions};
use crate::formats::{FORMATS, FormatEntry, create, detect, has_no_dataset, open, recover};
use comparison::{data_columns, dataset_hash, episode_hash};
use losses::{check_psnr, check_ratio, has_images, is_lossy};
use serde::Serialize;
use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::thread::{Builder, scope};
use swm_core::columns::ACTION;
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Batch, DType, Error, Result, Schema, files};
use swm_image::ImageCodec;

/// The unit of progress.
const UNIT: &str = "episodes";

/// The treatment of an existing target.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ConvertMode {
    /// Continues the target after its last episode, if the target's content is the beginning of the source.
    #[default]
    Resume,
    /// Fails if the target exists.
    Create,
    /// Replaces the target.
    Overwrite,
    /// Appends all episodes of the source to the target.
    Append,
}

/// Settings of a conversion.
#[derive(Clone, Debug)]
pub struct ConvertOptions {
    /// The target's format; for `None` the target's suffix determines it.
    pub format: Option<String>,
    /// The treatment of an existing target.
    pub mode: ConvertMode,
    /// The image codec of the target, if the target's format supports several codecs.
    pub codec: ImageCodec,
    /// Whether the target is read back and compared with the source.
    pub verify: bool,
    /// Minimum peak signal-to-noise ratio of an image column, in decibels; `None` is [`LEAST_PSNR`]. Only images that are
    /// stored with losses and verified have one.
    pub least_psnr: Option<f64>,
    /// The conditions for committing written episodes. A killed conversion rewrites uncommitted episodes.
    pub commit: CommitPolicy,
}

impl Default for ConvertOptions {
    fn default() -> Self {
        Self {
            format: None,
            mode: ConvertMode::default(),
            codec: ImageCodec::default(),
            verify: true,
            least_psnr: None,
            commit: CommitPolicy::default(),
        }
    }
}

/// The result of a conversion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Converted {
    /// Number of episodes in the target.
    pub episodes: usize,
    /// Number of episodes that an earlier conversion had written.
    #[serde(rename = "kept")]
    pub existing: usize,
    /// Number of written rows.
    pub rows: usize,
    /// Number of episodes whose last row had an action. This action was omitted, because no observation follows it.
    pub last_actions: usize,
    /// The [`checksum`] of the compared episodes of the source; `None` without verification.
    pub checksum: Option<String>,
    /// Comparison of each verified column.
    pub columns: Vec<ColumnComparison>,
    /// The parts of the source that are not read ([`Reader::unread`]), and so are not in the target.
    pub unread: Vec<String>,
}

/// The BLAKE3 hash of decoded content: names and types of the columns, and every row. Datasets in any format and codec
/// have the same checksum if, and only if, readers return the same bytes.
///
/// # Errors
/// If the data is damaged, or the files were changed ([`Reader::check_files`]).
pub fn checksum(reader: &dyn Reader) -> Result<String> {
    reader.check_files()?;
    let source = Source::new(reader);
    let mut batch = Batch::zeros(&source.schema, 0);
    let mut hashes = vec![];
    for episode in 0..reader.episodes().len() {
        source.read(episode, &mut batch)?;
        hashes.push(episode_hash(&batch));
    }
    Ok(dataset_hash(&source.schema, &hashes))
}

/// Writes a dataset to another location. If the run is stopped, another call continues the conversion.
///
/// # Errors
/// If the target is the source, the source is damaged, the target cannot be written or differs from the source, or the run
/// is stopped ([`Error::Interrupted`]).
pub fn convert(
    reader: &Arc<dyn Reader>,
    target: &Location,
    options: &ConvertOptions,
    control: &mut Control<'_>,
) -> Result<Converted> {
    if let Some(ratio) = options.least_psnr {
        check_ratio(ratio, &**reader, target, options)?;
    }
    check_distinct(&**reader, target)?;
    recover(target)?;
    if let Some((entry, trial)) = trial(&**reader, target, options)? {
        // The trial of a conversion that was killed is replaced.
        let options = ConvertOptions { format: Some(entry.id.to_owned()), ..options.clone() };
        let tried = convert_into(reader, &Location::from(&trial), &options, control);
        let removed = entry.remove(&trial);
        tried.and(removed)?;
    }
    convert_into(reader, target, options, control)
}

/// Returns the format and a hidden path beside the target, where a conversion is tried before it replaces a dataset: images
/// may lose more than the options allow, which is known after all of them are written. `None` if that cannot happen.
fn trial(
    reader: &dyn Reader,
    target: &Location,
    options: &ConvertOptions,
) -> Result<Option<(&'static FormatEntry, PathBuf)>> {
    let Some(path) = target.path().filter(|path| options.mode == ConvertMode::Overwrite && path.exists()) else {
        return Ok(None);
    };
    let entry = match &options.format {
        Some(id) => Some(FORMATS.get(id)?),
        None => detect(target),
    };
    let is_tried = |entry: &&FormatEntry| is_lossy(entry, options) && has_images(reader) && options.verify;
    let Some(entry) = entry.filter(is_tried) else { return Ok(None) };
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let suffix = path.extension().map(|suffix| format!(".{}", suffix.to_string_lossy())).unwrap_or_default();
    Ok(Some((entry, path.with_file_name(format!(".{stem}.trial{suffix}")))))
}

#[allow(clippy::too_many_lines, reason = "compare, copy and verify share the report")]
fn convert_into(
    reader: &Arc<dyn Reader>,
    target: &Location,
    options: &ConvertOptions,
    control: &mut Control<'_>,
) -> Result<Converted> {
    let is_new = target.path().is_some_and(|path| !path.exists());
    let source = Source::new(&**reader);
    let format = options.format.as_deref().map(|id| FORMATS.get(id)).transpose()?;
    let all = reader.episodes().len();
    let mut report = Converted {
        episodes: all,
        existing: 0,
        rows: 0,
        last_actions: 0,
        checksum: None,
        columns: data_columns(&source.schema).map(|(_, column)| ColumnComparison::new(column)).collect(),
        unread: reader.unread(),
    };
    let existing = match options.mode {
        ConvertMode::Resume | ConvertMode::Append => open_existing(target, format)?,
        ConvertMode::Create | ConvertMode::Overwrite => None,
    };
    // Without episodes, which a kill leaves, a dataset may lack columns: those of videos.
    let existing = existing.filter(|existing| !existing.episodes().is_empty());
    let mut hashes = vec![None; all];
    // Position of the source's first episode in the target, and of the first episode that is not in the target.
    let (mut base, mut first) = (0, 0);
    if let Some(existing) = &existing {
        let episodes = existing.episodes().len();
        match options.mode {
            ConvertMode::Append => base = episodes,
            _ if episodes > all => {
                return Err(not_a_prefix(target, format!("{episodes} episodes, more than the source's {all}")));
            }
            _ => first = episodes,
        }
        report.existing = first;
        let compared = source.compare("compare", &**existing, 0..first, 0, &mut hashes, &mut report.columns, control);
        compared.map_err(|error| match error {
            Error::Mismatch { operation, given, expected } if options.mode == ConvertMode::Append => {
                Error::mismatch(format!("appending to {target}, {operation}"), given, expected)
            }
            Error::Mismatch { operation, given, expected } => {
                not_a_prefix(target, format!("{operation}: {given}, expected {expected}"))
            }
            other => other,
        })?;
        check_psnr(&report.columns, options).map_err(|error| not_a_prefix(target, error.to_string()))?;
    }
    let continues = existing.map(|existing| Continued::of(&*existing)).transpose()?;
    if first < all || all == 0 {
        let mode = match options.mode {
            ConvertMode::Resume | ConvertMode::Append => WriteMode::Append,
            ConvertMode::Create => WriteMode::Create,
            ConvertMode::Overwrite => WriteMode::Overwrite,
        };
        let (codec, manifest, commit) = (options.codec, reader.manifest(), options.commit);
        // The position of the first episode in the target was read before the lock was taken.
        let write = WriteOptions { mode, codec, manifest, commit, exclusive: true, continues };
        let hashed = options.verify.then_some(&mut hashes[..]);
        let copied = source.copy(target, format, (write, base + first), first..all, hashed, &mut report, control);
        if is_new && copied.is_err() {
            remove_if_empty(target, format);
        }
        copied?;
    }
    report.episodes = base + all;
    if options.verify {
        let written = reopen(target, format)?;
        if written.episodes().len() != base + all {
            return Err(Error::mismatch(
                format!("reading {target} again"),
                format!("{} episodes", written.episodes().len()),
                (base + all).to_string(),
            ));
        }
        source.compare("verify", &*written, first..all, base, &mut hashes, &mut report.columns, control)?;
        check_psnr(&report.columns, options)?;
        let hashes: Vec<[u8; 32]> = hashes.into_iter().flatten().collect();
        report.checksum = Some(dataset_hash(&source.schema, &hashes));
    } else {
        report.columns.retain(|column| column.values > 0);
    }
    Ok(report)
}

/// Checks that a dataset is not written over a dataset that it is read from, nor into a folder that holds it.
fn check_distinct(reader: &dyn Reader, target: &Location) -> Result<()> {
    let canonical = |path: PathBuf| path.canonicalize().unwrap_or(path);
    let written = canonical(target.label());
    if reader.sources().into_iter().any(|source| canonical(source).starts_with(&written)) {
        return Err(Error::config(format!("target {target}"), "is the dataset that is read", "give another target"));
    }
    Ok(())
}

/// Opens the target if it exists.
fn open_existing(target: &Location, format: Option<&FormatEntry>) -> Result<Option<Arc<dyn Reader>>> {
    let Some(path) = target.path() else { return Ok(reopen(target, format).ok()) };
    if !path.exists() || has_no_dataset(path) {
        return Ok(None);
    }
    reopen(target, format).map(Some)
}

fn reopen(target: &Location, format: Option<&FormatEntry>) -> Result<Arc<dyn Reader>> {
    format.map_or_else(|| open(target), |format| format.open(target))
}

/// Deletes a dataset on this machine without episodes, or the empty folders of one, which a failed conversion leaves.
fn remove_if_empty(target: &Location, format: Option<&FormatEntry>) {
    let Some(path) = target.path() else { return };
    let removed = match format.or_else(|| detect(target)).map(|format| (format, format.open(target))) {
        Some((format, Ok(written))) if written.episodes().is_empty() => format.remove(path),
        Some((_, Ok(_))) => return,
        _ if path.is_dir() && !path.is_symlink() => files::remove_empty_folders(path),
        _ => return,
    };
    if let Err(error) = removed {
        tracing::warn!("an empty dataset could not be deleted: {error}");
    }
}

/// The error for a target whose content is not the beginning of the source.
fn not_a_prefix(target: &Location, problem: String) -> Error {
    let fix = "convert to another location, replace the target (overwrite), or append to it";
    Error::config(format!("continuing {target}"), format!("it is not the beginning of the source: {problem}"), fix)
}

/// The dataset to convert. Its episodes are renumbered by position.
struct Source<'a> {
    reader: &'a dyn Reader,
    schema: Schema,
}

/// An episode that the reading thread sends to the writer.
struct SourceEpisode {
    rows: Batch,
    constants: Constants,
    hash: Option<[u8; 32]>,
    /// Whether the action of the last row was omitted.
    cut: bool,
}

impl<'a> Source<'a> {
    fn new(reader: &'a dyn Reader) -> Self {
        Self { reader, schema: reader.schema().clone() }
    }

    /// Reads an episode and removes the action of the last row. Returns whether the last row had an action.
    fn read(&self, episode: usize, rows: &mut Batch) -> Result<bool> {
        let length = self.reader.episodes()[episode].length;
        read(self.reader, &self.schema, episode, length, rows)?;
        Ok(cut_last_action(rows))
    }

    /// Copies episodes while a thread reads ahead of the writer. `existing` is the number of episodes that the target is
    /// expected to have. Stores the episode hashes in `hashes`, if given.
    #[allow(clippy::too_many_arguments, reason = "a part of `convert` that uses the state of `convert`")]
    fn copy(
        &self,
        target: &Location,
        format: Option<&FormatEntry>,
        (options, existing): (WriteOptions, usize),
        episodes: Range<usize>,
        mut hashes: Option<&mut [Option<[u8; 32]>]>,
        report: &mut Converted,
        control: &mut Control<'_>,
    ) -> Result<()> {
        let mut writer = match format {
            Some(format) => format.create(target, &self.schema, options)?,
            None => create(target, &self.schema, options)?,
        };
        if writer.episodes() != existing {
            let problem = format!("another program wrote to it: it had {existing} episodes, now {}", writer.episodes());
            writer.pause()?;
            return Err(Error::config(target.to_string(), problem, "run the command again"));
        }
        let (first, all) = (episodes.start, self.reader.episodes().len());
        start(control, "convert", all);
        let hashed = hashes.is_some();
        // A new thread is in no pool. One of the caller is passed on by its size: in a forked process, the global pool has no threads.
        let threads = rayon::current_thread_index().map(|_| rayon::current_num_threads());
        let pool = threads.map(|threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build()).transpose();
        let pool = pool.map_err(|error| Error::external("starting the threads that decode", error))?;
        let outcome = scope(|scope| {
            let (to_writer, from_reader) = sync_channel(1);
            let (back, empty) = channel();
            Builder::new()
                .name("swm-read".to_owned())
                .spawn_scoped(scope, move || {
                    let send = move || self.send(episodes, &to_writer, &empty, hashed);
                    if let Some(pool) = pool { pool.install(send) } else { send() }
                })
                .map_err(|error| Error::external("starting the thread that reads episodes", error))?;
            for (done, episode) in from_reader.into_iter().enumerate() {
                let SourceEpisode { rows, constants, hash, cut } = episode?;
                writer.write_episode_with(&rows, &constants)?;
                if let Some(hashes) = &mut hashes {
                    hashes[first + done] = hash;
                }
                report.rows += rows.rows();
                report.last_actions += usize::from(cut);
                // Fails if the reading thread has finished.
                let _ = back.send(rows);
                advance(control, "convert", first + done + 1, all)?;
            }
            Ok(())
        });
        // Complete episodes are kept, even after an error.
        let finished = writer.finish();
        outcome.and(finished)?;
        control.emit(Event::Finished { stage: "convert", metrics: &[] });
        Ok(())
    }

    /// Reads episodes into the batches from `empty`, or into new batches, and sends them to the writer.
    fn send(
        &self,
        episodes: Range<usize>,
        to_writer: &SyncSender<Result<SourceEpisode>>,
        empty: &Receiver<Batch>,
        hashed: bool,
    ) {
        for episode in episodes {
            let mut rows = empty.try_recv().unwrap_or_else(|_| Batch::zeros(&self.schema, 0));
            let read = self.read(episode, &mut rows).and_then(|cut| {
                let constants = self.reader.constants(episode)?;
                let hash = hashed.then(|| episode_hash(&rows));
                Ok(SourceEpisode { rows, constants, hash, cut })
            });
            let failed = read.is_err();
            if to_writer.send(read).is_err() || failed {
                return;
            }
        }
    }

    /// Compares episodes of the source with episodes of `copy`, whose positions are higher by `base`. Stores the hashes
    /// of the episodes of the source.
    #[allow(clippy::too_many_arguments, reason = "a part of `convert` that uses the state of `convert`")]
    fn compare(
        &self,
        stage: &'static str,
        copy: &dyn Reader,
        episodes: Range<usize>,
        base: usize,
        hashes: &mut [Option<[u8; 32]>],
        columns: &mut [ColumnComparison],
        control: &mut Control<'_>,
    ) -> Result<()> {
        let total = episodes.len();
        start(control, stage, total);
        for (_, column) in data_columns(&self.schema) {
            let copied = copy.schema().column(&column.name)?;
            if copied.dtype != column.dtype || copied.len() != column.len() {
                let [given, expected] = [copied, column].map(|column| describe_columns(std::slice::from_ref(column)));
                return Err(Error::mismatch(format!("column '{}'", column.name), given, expected));
            }
        }
        let (mut source_rows, mut copy_rows) = (Batch::zeros(&self.schema, 0), Batch::zeros(&self.schema, 0));
        for (done, episode) in episodes.enumerate() {
            let (length, found) = (self.reader.episodes()[episode].length, copy.episodes()[base + episode].length);
            if found != length {
                return Err(Error::mismatch(format!("episode {episode}"), format!("{found} rows"), length.to_string()));
            }
            read(copy, &self.schema, base + episode, length, &mut copy_rows)?;
            let known = hashes[episode];
            if known.is_some_and(|known| known == episode_hash(&copy_rows)) {
                for (column, (_, spec)) in columns.iter_mut().zip(data_columns(&self.schema)) {
                    column.values += (length * spec.len()) as u64;
                }
            } else {
                self.read(episode, &mut source_rows)?;
                hashes[episode] = Some(episode_hash(&source_rows));
                for (column, (i, spec)) in columns.iter_mut().zip(data_columns(&self.schema)) {
                    column.add(spec, source_rows.bytes(i), copy_rows.bytes(i)).map_err(|(given, expected)| {
                        Error::mismatch(format!("column '{}' of episode {episode}", spec.name), given, expected)
                    })?;
                }
            }
            if self.reader.constants(episode)? != copy.constants(base + episode)? {
                return Err(Error::mismatch(
                    format!("constants of episode {episode}"),
                    "different values",
                    "the values of the source",
                ));
            }
            advance(control, stage, done + 1, total)?;
        }
        control.emit(Event::Finished { stage, metrics: &[] });
        Ok(())
    }
}

/// Reports that a stage starts.
fn start(control: &mut Control<'_>, name: &'static str, total: usize) {
    control.emit(Event::Started(Stage { name, subject: &[], total, unit: UNIT }));
}

/// Reports progress. Fails if the run is interrupted.
fn advance(control: &mut Control<'_>, stage: &'static str, done: usize, total: usize) -> Result<()> {
    control.progress(Progress { stage, done, total, unit: UNIT, metrics: &[] });
    control.check()
}

/// Reads all columns of an episode except index columns.
fn read(reader: &dyn Reader, schema: &Schema, episode: usize, length: usize, rows: &mut Batch) -> Result<()> {
    rows.try_resize(length)?;
    let range = [StepRange::new(episode, 0, length)];
    for (i, column) in data_columns(schema) {
        reader.read_column(&column.name, &range, rows.bytes_mut(i))?;
    }
    Ok(())
}

/// Removes the action of the last row, which no observation follows. Returns whether the last row had an action, as in
/// some third-party datasets.
fn cut_last_action(rows: &mut Batch) -> bool {
    let Some(index) = rows.schema().find(ACTION) else { return false };
    let Some(last) = rows.rows().checked_sub(1) else { return false };
    let mut row = rows.row_mut(last);
    fn replace<T: PartialEq + Copy>(action: &mut [T], missing: T, is_missing: impl Fn(&T) -> bool) -> bool {
        let exists = !action.iter().all(is_missing);
        action.fill(missing);
        exists
    }
    match row.schema().columns()[index].dtype {
        DType::Float32 => replace(row.at::<f32>(index), f32::NAN, |v| v.is_nan()),
        DType::Float64 => replace(row.at::<f64>(index), f64::NAN, |v| v.is_nan()),
        DType::Int32 => replace(row.at::<i32>(index), -1, |&v| v == -1),
        DType::Int64 => replace(row.at::<i64>(index), -1, |&v| v == -1),
        DType::Bool | DType::U8 => false,
    }
}
