//! Converting a dataset to any format, resumed where it was killed, and compared with its source in the end.
//!
//! What is compared is what readers get: pictures as pixels, values as values. A lossless target must give every byte
//! back; a lossy one every number, and pictures with a peak signal-to-noise ratio that is told and must not be too low.

use crate::dataset::Location;
use crate::dataset::episodes::describe_columns;
use crate::dataset::{CommitPolicy, Constants, Reader, StepRange, WriteMode, WriteOptions};
use crate::formats::{FORMATS, FormatEntry, create, open};
use rayon::prelude::*;
use serde::Serialize;
use std::ops::Range;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::thread::scope;
use swm_core::columns::{ACTION, EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};
use swm_image::ImageCodec;

/// What to do with a target that is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ConvertMode {
    /// Continue it behind its last episode, if what it has is the beginning of the source.
    #[default]
    Resume,
    /// Refuse.
    Create,
    /// Replace it.
    Overwrite,
    /// Add the source's episodes to those it has, whatever they are.
    Append,
}

/// How to convert.
#[derive(Clone, Debug)]
pub struct ConvertOptions {
    /// The target's format; the one its name says for `None`.
    pub format: Option<String>,
    /// What to do with a target that is there.
    pub mode: ConvertMode,
    /// How the target stores pictures, in formats that leave a choice.
    pub codec: ImageCodec,
    /// Whether the target is read again and compared.
    pub verify: bool,
    /// The least peak signal-to-noise ratio of a column of pictures, in decibels.
    pub least_psnr: f64,
    /// When written episodes are committed: what a killed conversion has to write again.
    pub commit: CommitPolicy,
}

impl Default for ConvertOptions {
    fn default() -> Self {
        Self {
            format: None,
            mode: ConvertMode::default(),
            codec: ImageCodec::default(),
            verify: true,
            least_psnr: 25.0,
            commit: CommitPolicy::default(),
        }
    }
}

/// What is being done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Comparing what the target had with the source.
    Comparing,
    /// Writing.
    Writing,
    /// Reading again what was written.
    Verifying,
}

/// What became of a dataset.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Converted {
    /// Episodes in the target.
    pub episodes: usize,
    /// Those of them that were there.
    pub kept: usize,
    /// Rows that were written.
    pub rows: usize,
    /// Episodes whose last row had an action, which was left out: no observation follows it.
    pub last_actions: usize,
    /// The BLAKE3 hash of what readers get of the source, see [`checksum`]; of what was compared only.
    pub checksum: Option<String>,
    /// How the columns compare, those that were compared.
    pub columns: Vec<ColumnComparison>,
}

/// A column of the target beside the source's.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ColumnComparison {
    /// Its name.
    pub column: String,
    /// Whether every byte is equal.
    pub exact: bool,
    /// The largest difference of two values.
    pub max_error: f64,
    /// The peak signal-to-noise ratio of pictures in decibels, where they differ.
    pub psnr: Option<f64>,
    #[serde(skip)]
    squares: f64,
    #[serde(skip)]
    values: u64,
}

/// The hash of what a reader gets: of the columns' names and types, and of every row in decoded form. Two datasets of
/// any format and codec have the same one if, and only if, they give the same bytes.
///
/// # Errors
/// When the data are damaged.
pub fn checksum(reader: &dyn Reader) -> Result<String> {
    let source = Source::new(reader);
    let mut batch = Batch::zeros(&source.schema, 0);
    let mut hashes = vec![];
    for episode in 0..reader.episodes().len() {
        source.read(episode, &mut batch)?;
        hashes.push(episode_hash(&batch));
    }
    Ok(dataset_hash(&source.schema, &hashes))
}

/// Writes a dataset to another place. `progress` is told the stage, the episodes done and their number, and stops the
/// work by saying `false`; calling again goes on.
///
/// # Errors
/// When the source is damaged, the target cannot be written or differs from the source, or the work is stopped
/// ([`Error::Interrupted`]).
pub fn convert(
    reader: &Arc<dyn Reader>,
    target: &Location,
    options: &ConvertOptions,
    progress: &mut dyn FnMut(Stage, usize, usize) -> bool,
) -> Result<Converted> {
    let source = Source::new(&**reader);
    let format = options.format.as_deref().map(|id| FORMATS.get(id)).transpose()?;
    let all = reader.episodes().len();
    let mut report = Converted {
        episodes: all,
        kept: 0,
        rows: 0,
        last_actions: 0,
        checksum: None,
        columns: data_columns(&source.schema).map(|(_, column)| ColumnComparison::new(column)).collect(),
    };
    let there = match options.mode {
        ConvertMode::Resume | ConvertMode::Append => existing(target, format)?,
        ConvertMode::Create | ConvertMode::Overwrite => None,
    };
    let mut hashes = vec![None; all];
    // Where the source's first episode is in the target, and the first that is not there yet.
    let (mut base, mut first) = (0, 0);
    if let Some(there) = &there {
        let episodes = there.episodes().len();
        match options.mode {
            ConvertMode::Append => base = episodes,
            _ if episodes > all => {
                return Err(not_a_prefix(target, format!("{episodes} episodes, more than the source's {all}")));
            }
            _ => first = episodes,
        }
        report.kept = first;
        let mut step = |done| progress(Stage::Comparing, done, first);
        source.compare(&**there, 0..first, 0, &mut hashes, &mut report.columns, &mut step).map_err(
            |error| match error {
                Error::Mismatch { operation, given, expected } => {
                    not_a_prefix(target, format!("{operation}: {given}, expected {expected}"))
                }
                other => other,
            },
        )?;
        source.check_psnr(&report.columns, options).map_err(|error| not_a_prefix(target, error.to_string()))?;
    }
    drop(there);
    if first < all || all == 0 {
        let mode = match options.mode {
            ConvertMode::Resume | ConvertMode::Append => WriteMode::Append,
            ConvertMode::Create => WriteMode::Create,
            ConvertMode::Overwrite => WriteMode::Overwrite,
        };
        let write = WriteOptions { mode, codec: options.codec, manifest: reader.manifest(), commit: options.commit };
        source.copy(target, format, write, first..all, &mut hashes, &mut report, options.verify, progress)?;
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
        let mut step = |done| progress(Stage::Verifying, done, all - first);
        source.compare(&*written, first..all, base, &mut hashes, &mut report.columns, &mut step)?;
        source.check_psnr(&report.columns, options)?;
        let hashes: Vec<[u8; 32]> = hashes.into_iter().flatten().collect();
        report.checksum = Some(dataset_hash(&source.schema, &hashes));
    } else {
        report.columns.retain(|column| column.values > 0);
    }
    Ok(report)
}

/// The target, if it is there and has the columns of the source.
fn existing(target: &Location, format: Option<&FormatEntry>) -> Result<Option<Arc<dyn Reader>>> {
    let Some(path) = target.path() else { return Ok(reopen(target, format).ok()) };
    let empty = path.is_dir() && path.read_dir().is_ok_and(|mut entries| entries.next().is_none());
    if empty || !path.exists() {
        return Ok(None);
    }
    reopen(target, format).map(Some)
}

fn reopen(target: &Location, format: Option<&FormatEntry>) -> Result<Arc<dyn Reader>> {
    format.map_or_else(|| open(target), |format| format.open(target))
}

/// The error of a target that holds something else.
fn not_a_prefix(target: &Location, problem: String) -> Error {
    let fix = "convert to another place, replace it (overwrite), or add to it (append)";
    Error::config(format!("continuing {target}"), format!("it is not the beginning of the source: {problem}"), fix)
}

/// A dataset to be copied, numbering and all; but its episodes get the values that their places give them.
struct Source<'a> {
    reader: &'a dyn Reader,
    schema: Schema,
}

/// The columns that are compared, with their places: those that hold data.
fn data_columns(schema: &Schema) -> impl Iterator<Item = (usize, &ColumnSpec)> {
    schema.columns().iter().enumerate().filter(|(_, column)| column.name != EPISODE_IDX && column.name != STEP_IDX)
}

/// An episode on its way to the writer.
struct SourceEpisode {
    rows: Batch,
    constants: Constants,
    sum: Option<[u8; 32]>,
    /// Whether its last action was left out.
    cut: bool,
}

impl<'a> Source<'a> {
    fn new(reader: &'a dyn Reader) -> Self {
        Self { reader, schema: reader.schema().clone() }
    }

    /// Reads an episode as it is stored by us: the last action is missing. Says whether it was not.
    fn read(&self, episode: usize, rows: &mut Batch) -> Result<bool> {
        let length = self.reader.episodes()[episode].length;
        read(self.reader, &self.schema, episode, length, rows)?;
        Ok(cut_last_action(rows))
    }

    /// Copies episodes, reading ahead of the writer.
    #[allow(clippy::too_many_arguments)]
    fn copy(
        &self,
        target: &Location,
        format: Option<&FormatEntry>,
        options: WriteOptions,
        episodes: Range<usize>,
        hashes: &mut [Option<[u8; 32]>],
        report: &mut Converted,
        hashed: bool,
        progress: &mut dyn FnMut(Stage, usize, usize) -> bool,
    ) -> Result<()> {
        let mut writer = match format {
            Some(format) => format.create(target, &self.schema, options)?,
            None => create(target, &self.schema, options)?,
        };
        let (first, all) = (episodes.start, self.reader.episodes().len());
        let outcome = scope(|scope| {
            let (to_writer, episodes_read) = sync_channel(1);
            let (back, empty) = channel();
            scope.spawn(move || self.send(episodes, &to_writer, &empty, hashed));
            for (done, read) in episodes_read.into_iter().enumerate() {
                let SourceEpisode { rows, constants, sum, cut } = read?;
                writer.write_episode_with(&rows, &constants)?;
                hashes[first + done] = sum;
                report.rows += rows.rows();
                report.last_actions += usize::from(cut);
                // The reader may have come to its end.
                let _ = back.send(rows);
                if !progress(Stage::Writing, first + done + 1, all) {
                    return Err(Error::Interrupted);
                }
            }
            Ok(())
        });
        // What was written whole is kept, whatever happened.
        let finished = writer.finish();
        outcome.and(finished)
    }

    /// Reads episodes and hands them on, until nobody takes them.
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
                let sum = hashed.then(|| episode_hash(&rows));
                Ok(SourceEpisode { rows, constants, sum, cut })
            });
            let failed = read.is_err();
            if to_writer.send(read).is_err() || failed {
                return;
            }
        }
    }

    /// Compares episodes with those of a copy, `base` positions further on there, and notes their hashes.
    fn compare(
        &self,
        copy: &dyn Reader,
        episodes: Range<usize>,
        base: usize,
        hashes: &mut [Option<[u8; 32]>],
        columns: &mut [ColumnComparison],
        step: &mut dyn FnMut(usize) -> bool,
    ) -> Result<()> {
        for (_, column) in data_columns(&self.schema) {
            let theirs = copy.schema().column(&column.name)?;
            if theirs.dtype != column.dtype || theirs.len() != column.len() {
                let [given, expected] = [theirs, column].map(|column| describe_columns(std::slice::from_ref(column)));
                return Err(Error::mismatch(format!("column '{}'", column.name), given, expected));
            }
        }
        let (mut ours, mut theirs) = (Batch::zeros(&self.schema, 0), Batch::zeros(&self.schema, 0));
        for (done, episode) in episodes.enumerate() {
            let (length, found) = (self.reader.episodes()[episode].length, copy.episodes()[base + episode].length);
            if found != length {
                return Err(Error::mismatch(format!("episode {episode}"), format!("{found} rows"), length.to_string()));
            }
            read(copy, &self.schema, base + episode, length, &mut theirs)?;
            let known = hashes[episode];
            if known.is_some_and(|known| known == episode_hash(&theirs)) {
                for (column, (_, spec)) in columns.iter_mut().zip(data_columns(&self.schema)) {
                    column.values += (length * spec.len()) as u64;
                }
            } else {
                self.read(episode, &mut ours)?;
                hashes[episode] = Some(episode_hash(&ours));
                for (column, (i, spec)) in columns.iter_mut().zip(data_columns(&self.schema)) {
                    column.add(spec, ours.bytes(i), theirs.bytes(i)).map_err(|(given, expected)| {
                        Error::mismatch(format!("column '{}' of episode {episode}", spec.name), given, expected)
                    })?;
                }
            }
            if self.reader.constants(episode)? != copy.constants(base + episode)? {
                return Err(Error::mismatch(
                    format!("constants of episode {episode}"),
                    "others",
                    "those of the source",
                ));
            }
            if !step(done + 1) {
                return Err(Error::Interrupted);
            }
        }
        Ok(())
    }

    /// Checks that pictures are near enough.
    fn check_psnr(&self, columns: &[ColumnComparison], options: &ConvertOptions) -> Result<()> {
        let bad = columns.iter().find(|column| column.psnr.is_some_and(|psnr| psnr < options.least_psnr));
        bad.map_or(Ok(()), |column| {
            Err(Error::mismatch(
                format!("pictures of column '{}'", column.column),
                format!("a signal-to-noise ratio of {:.1} dB", column.psnr.unwrap_or_default()),
                format!("at least {} dB; choose a codec that keeps more", options.least_psnr),
            ))
        })
    }
}

fn read(reader: &dyn Reader, schema: &Schema, episode: usize, length: usize, rows: &mut Batch) -> Result<()> {
    rows.resize(length);
    let range = [StepRange::new(episode, 0, length)];
    for (i, column) in data_columns(schema) {
        reader.read_column(&column.name, &range, rows.bytes_mut(i))?;
    }
    Ok(())
}

/// Makes the last action missing; says whether it was not. Foreign datasets have one, which led to nothing recorded.
fn cut_last_action(rows: &mut Batch) -> bool {
    let Some(index) = rows.schema().find(ACTION) else { return false };
    let Some(last) = rows.rows().checked_sub(1) else { return false };
    let mut row = rows.row_mut(last);
    fn cut<T: PartialEq + Copy>(action: &mut [T], missing: T, is_missing: impl Fn(&T) -> bool) -> bool {
        let there = !action.iter().all(is_missing);
        action.fill(missing);
        there
    }
    match row.schema().columns()[index].dtype {
        DType::Float32 => cut(row.at::<f32>(index), f32::NAN, |v| v.is_nan()),
        DType::Float64 => cut(row.at::<f64>(index), f64::NAN, |v| v.is_nan()),
        DType::Int32 => cut(row.at::<i32>(index), -1, |&v| v == -1),
        DType::Int64 => cut(row.at::<i64>(index), -1, |&v| v == -1),
        DType::Bool | DType::U8 => false,
    }
}

/// The hash of an episode: of the hashes of its rows, which are made in parallel.
fn episode_hash(rows: &Batch) -> [u8; 32] {
    /// Bytes hashed at once; small rows are taken together.
    const PIECE: usize = 128 << 10;
    let mut hasher = blake3::Hasher::new();
    for (i, column) in data_columns(rows.schema()) {
        let piece = (PIECE / column.row_bytes().max(1)).max(1) * column.row_bytes().max(1);
        let pieces: Vec<blake3::Hash> = rows.bytes(i).par_chunks(piece).map(blake3::hash).collect();
        pieces.iter().for_each(|piece| {
            hasher.update(piece.as_bytes());
        });
    }
    hasher.update(&(rows.rows() as u64).to_le_bytes());
    *hasher.finalize().as_bytes()
}

/// The hash of all episodes.
fn dataset_hash(schema: &Schema, hashes: &[[u8; 32]]) -> String {
    let mut hasher = blake3::Hasher::new();
    let columns: Vec<ColumnSpec> = data_columns(schema).map(|(_, column)| column.clone()).collect();
    hasher.update(describe_columns(&columns).as_bytes());
    hashes.iter().for_each(|sum| {
        hasher.update(sum);
    });
    hasher.finalize().to_hex().to_string()
}

impl ColumnComparison {
    fn new(spec: &ColumnSpec) -> Self {
        Self { column: spec.name.clone(), exact: true, max_error: 0.0, psnr: None, squares: 0.0, values: 0 }
    }

    /// Adds the values of an episode; says what is wrong if values are not what they were.
    fn add(&mut self, spec: &ColumnSpec, ours: &[u8], theirs: &[u8]) -> Result<(), (String, String)> {
        self.values += (ours.len() / spec.dtype.size()) as u64;
        if ours == theirs {
            return Ok(());
        }
        if spec.is_image() {
            let (sum, most) = ours
                .par_chunks(1 << 16)
                .zip(theirs.par_chunks(1 << 16))
                .map(|(a, b)| {
                    let apart = a.iter().zip(b).map(|(&a, &b)| u64::from(a.abs_diff(b)));
                    (apart.clone().map(|d| d * d).sum::<u64>(), apart.max().unwrap_or(0))
                })
                .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1.max(b.1)));
            self.exact = false;
            self.squares += sum as f64;
            self.max_error = self.max_error.max(most as f64);
            self.psnr = Some(10.0 * (255.0_f64.powi(2) * self.values as f64 / self.squares).log10());
            return Ok(());
        }
        let size = spec.dtype.size();
        for (a, b) in ours.chunks_exact(size).zip(theirs.chunks_exact(size)).filter(|(a, b)| a != b) {
            let (a, b) = (scalar(spec.dtype, a), scalar(spec.dtype, b));
            // Formats that know single precision only round what is double; that is their nature, and told.
            let rounded = spec.dtype == DType::Float64 && f64::from(a as f32) == b;
            if !(a.is_nan() && b.is_nan()) {
                if !rounded {
                    return Err((b.to_string(), a.to_string()));
                }
                self.exact = false;
                self.max_error = self.max_error.max((a - b).abs());
            }
        }
        Ok(())
    }
}

fn scalar(dtype: DType, bytes: &[u8]) -> f64 {
    match dtype {
        DType::Bool | DType::U8 => f64::from(bytes[0]),
        DType::Int32 => f64::from(bytemuck::pod_read_unaligned::<i32>(bytes)),
        DType::Int64 => bytemuck::pod_read_unaligned::<i64>(bytes) as f64,
        DType::Float32 => f64::from(bytemuck::pod_read_unaligned::<f32>(bytes)),
        DType::Float64 => bytemuck::pod_read_unaligned(bytes),
    }
}
