//! Writes numeric columns: to the journal at every commit, to column files when the journal is merged.

use super::journal::{self, Journal, PendingEpisode};
use super::npz::NpzWriter;
use super::{
    ColumnFiles, ImageFiles, LENGTHS, METADATA, Metadata, OFFSETS, TEMPORARY, check_name, column_path, constant_member,
    exists, has_no_dataset, images, reader::stored_metadata, removal,
};
use crate::dataset::episodes::{self, EpisodeRows};
use crate::dataset::{CommitPolicy, Constants, StepRange, WriteMode, WriteOptions, Writer, is_full, with_stored};
use crate::formats::replacing::ReplacingWriter;
use crate::formats::set_aside::{self, COLUMN_FILES};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::files::{self, Lock};
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};

/// Bounds, in bytes, of the journal size at which the journal is merged: half the size of the column files, clamped to
/// these bounds. The upper bound also limits the memory of a writer.
const MERGE_BYTES: std::ops::RangeInclusive<usize> = 16 << 20..=256 << 20;

/// Commits the numeric columns of episodes. Formats write an episode's images first, then call
/// [`ColumnFilesWriter::write`].
pub(crate) struct ColumnFilesWriter {
    folder: PathBuf,
    _lock: Lock,
    journal: Option<Journal>,
    schema: Schema,
    /// The numeric columns.
    columns: Vec<ColumnSpec>,
    recorded: Metadata,
    policy: CommitPolicy,
    last_commit: Instant,
    /// The rows of all episodes, including uncommitted episodes.
    rows: EpisodeRows,
    images: ImageFiles,
    /// Records of uncommitted episodes.
    group: Vec<Vec<u8>>,
    /// Number of committed episodes.
    committed: usize,
    /// Whether the folder has the `ep_len.npz` of this dataset.
    merged: bool,
    /// Number of rows in the column files.
    rows_in_files: usize,
    /// Size of the rows in the column files, in bytes.
    bytes_in_files: usize,
    /// For each column, the bytes of the rows that are not in the column file.
    unmerged: Vec<Vec<u8>>,
    /// Constants that are not in `ep_len.npz`.
    new_constants: Vec<Vec<u8>>,
    /// Number of members that hold constants, including those of `new_constants`.
    constants: usize,
    /// Index of the member of each constant, by the hash of the constant.
    known_constants: HashMap<blake3::Hash, usize>,
    /// Whether a commit failed.
    failed: bool,
}

impl ColumnFilesWriter {
    /// Creates, continues or replaces the column files of a folder, and returns the writer that `make` builds on them.
    /// `known` returns the schema of the dataset to continue, and `committed` the [number of committed
    /// episodes](Self::committed) of the writer.
    ///
    /// # Errors
    /// If the dataset exists and `options.mode` forbids it, its columns differ, another process writes to it, or
    /// writing fails.
    pub fn create<W: Writer + 'static>(
        folder: &Path,
        schema: &Schema,
        options: WriteOptions,
        known: impl FnOnce() -> Result<Schema>,
        images: ImageFiles,
        make: impl FnOnce(Self) -> W + Send + 'static,
        committed: fn(&W) -> usize,
    ) -> Result<Box<dyn Writer>> {
        check_columns(schema)?;
        set_aside::recover_unlocked(folder, images)?;
        let exists = exists(folder);
        if !exists && folder.is_dir() && !has_no_dataset(folder) {
            let problem = format!("{} holds other files", folder.display());
            return Err(Error::config("dataset", problem, "choose another path"));
        }
        if exists && options.mode == WriteMode::Create {
            let problem = format!("{} exists already", folder.display());
            let fix = "choose another path, append to it, or overwrite it";
            return Err(Error::config("dataset", problem, fix));
        }
        let lock = Lock::folder(folder)?;
        let mut image_columns = schema.columns().iter().filter(|column| column.is_image());
        image_columns.try_for_each(|column| files::check_no_link(&folder.join(&column.name)))?;
        if exists && options.mode == WriteMode::Overwrite {
            removal::check_new_files(folder, schema)?;
            removal::check_replaceable(folder, images)?;
            let (folder, schema, incoming) = (folder.to_owned(), schema.clone(), schema.clone());
            let replace = move || {
                let begin = || Self::begin(&folder, &schema, &options, None, images, lock).map(make);
                set_aside::replace(&folder, images, committed, begin)
            };
            let check = move |episode: &Batch, _: &Constants| episodes::check_episode(episode, &incoming);
            return Ok(ReplacingWriter::boxed(check, replace));
        }
        let known = (exists && options.mode == WriteMode::Append).then(known).transpose()?;
        Ok(Box::new(make(Self::begin(folder, schema, &options, known.as_ref(), images, lock)?)))
    }

    /// Begins to write into a folder, which is locked.
    fn begin(
        folder: &Path,
        schema: &Schema,
        options: &WriteOptions,
        known: Option<&Schema>,
        images: ImageFiles,
        lock: Lock,
    ) -> Result<Self> {
        let image_columns = || schema.columns().iter().filter(|column| column.is_image());
        let columns = schema.columns().iter().filter(|c| !c.is_image()).cloned().collect::<Vec<_>>();
        let mut writer = Self {
            folder: folder.to_owned(),
            _lock: lock,
            journal: None,
            schema: schema.clone(),
            unmerged: vec![vec![]; columns.len()],
            columns,
            recorded: Metadata {
                schema: Some(schema.clone()),
                manifest: options.manifest.clone(),
                constants: vec![],
                // The metadata of a dataset that this one replaces is set aside.
                replaced: stored_metadata(&folder.join(COLUMN_FILES.set_aside))
                    .map_or(0, |(_, old)| old.replaced.saturating_add(1)),
            },
            policy: options.commit,
            last_commit: Instant::now(),
            rows: EpisodeRows::default(),
            images,
            group: vec![],
            committed: 0,
            merged: known.is_some(),
            rows_in_files: 0,
            bytes_in_files: 0,
            new_constants: vec![],
            constants: 0,
            known_constants: HashMap::new(),
            failed: false,
        };
        if writer.merged {
            writer.continue_from(known)?;
        }
        // A journal shows that the last writer was killed or failed, and may have left images.
        let killed = journal::path(folder).exists();
        writer.merge_journal()?;
        if killed {
            writer.discard_images(writer.episodes())?;
        }
        writer.journal = Some(Journal::create(folder)?);
        writer.committed = writer.episodes();
        for column in image_columns() {
            let folder = folder.join(&column.name);
            std::fs::create_dir_all(&folder).map_err(|e| Error::io(&folder, "creating the folder", e))?;
        }
        Ok(writer)
    }

    /// Loads the state of the existing dataset, including the journal of an interrupted writer.
    fn continue_from(&mut self, known: Option<&Schema>) -> Result<()> {
        let old = ColumnFiles::open(&self.folder)?;
        if let [name, ..] = old.skipped() {
            let problem = format!("its column '{name}' is not numeric and cannot be appended to");
            return Err(Error::corrupt(&self.folder, problem, "convert it to a new dataset, without this column"));
        }
        let known = match known {
            Some(known) => known.clone(),
            None => old.schema(vec![])?,
        };
        episodes::check_appendable(&self.folder.display(), &self.schema, &known)?;
        if !old.rows().is_contiguous() {
            let problem = "its episodes are not contiguous";
            return Err(Error::corrupt(&self.folder, problem, "convert it to a new dataset first"));
        }
        let in_files = old.episodes_in_files();
        self.rows_in_files = old.rows().episodes()[..in_files].iter().map(|episode| episode.length).sum();
        self.columns = old.columns().cloned().collect();
        self.unmerged = vec![];
        for column in &self.columns {
            let in_file = self.rows_in_files * column.row_bytes();
            self.bytes_in_files += in_file;
            self.unmerged.push(old.data(&column.name)?[in_file..].to_vec());
        }
        // Existing columns, including index columns, keep their type.
        let stored = |column: &&ColumnSpec| column.is_image() || self.columns.contains(column);
        let columns: Vec<ColumnSpec> = known.columns().iter().filter(stored).cloned().collect();
        self.recorded.schema = Some(old.recorded().cloned().map_or_else(|| Schema::new(columns), Ok)?);
        self.recorded.manifest = self.recorded.manifest.take().or_else(|| old.manifest());
        self.recorded.constants = old.constants_in_file().to_vec();
        self.recorded.replaced = old.replaced();
        // Third-party datasets have no constants.
        self.recorded.constants.resize(in_files, BTreeMap::new());
        let stored = old.stored_constants()?;
        self.constants = stored.len();
        self.known_constants.extend(stored.iter().map(|bytes| blake3::hash(bytes)).zip(0..));
        for episode in in_files..old.rows().episodes().len() {
            self.add_constants(&old.constants(episode)?);
        }
        self.rows = old.rows().clone();
        Ok(())
    }

    /// Number of episodes, including uncommitted episodes.
    pub fn episodes(&self) -> usize {
        self.rows.episodes().len()
    }

    /// Number of committed episodes.
    pub fn committed(&self) -> usize {
        self.committed
    }

    /// The folder of the dataset.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Adds the numeric columns of an episode that passed [`episodes::check_episode`], and commits if the commit policy
    /// requires it.
    ///
    /// # Errors
    /// If this or an earlier commit failed.
    pub fn write(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        if self.failed {
            return Err(Error::external(
                "writing an episode",
                "an earlier commit failed; later episodes are not stored",
            ));
        }
        let position = self.episodes();
        self.rows.push(episode.rows());
        let mut pending = PendingEpisode { rows: episode.rows(), columns: vec![], constants: constants.clone() };
        for column in &self.columns {
            if column.name == EPISODE_IDX || column.name == STEP_IDX {
                let mut bytes = vec![0; episode.rows() * column.row_bytes()];
                self.rows.fill_index_column(column, &[StepRange::new(position, 0, episode.rows())], &mut bytes)?;
                pending.columns.push(bytes);
            } else {
                pending.columns.push(episode.bytes(episode.schema().index(&column.name)?).to_vec());
            }
        }
        self.group.push(journal::record(position, &pending)?);
        self.unmerged.iter_mut().zip(&pending.columns).for_each(|(unmerged_rows, bytes)| unmerged_rows.extend(bytes));
        self.add_constants(constants);
        let due = self.group.len() >= self.policy.episodes
            || self.group.iter().map(Vec::len).sum::<usize>() >= self.policy.bytes
            || self.last_commit.elapsed() >= self.policy.interval;
        if due { self.commit() } else { Ok(()) }
    }

    fn add_constants(&mut self, constants: &Constants) {
        let mut named = BTreeMap::new();
        for (name, bytes) in constants {
            let index = *self.known_constants.entry(blake3::hash(bytes)).or_insert(self.constants);
            if index == self.constants {
                self.constants += 1;
                self.new_constants.push(bytes.clone());
            }
            named.insert(name.clone(), index);
        }
        self.recorded.constants.push(named);
    }

    /// Commits the uncommitted episodes.
    fn commit(&mut self) -> Result<()> {
        self.last_commit = Instant::now();
        // Remains `true` if one of the operations below fails.
        self.failed = true;
        self.append_group()?;
        let unmerged_bytes: usize = self.unmerged.iter().chain(&self.new_constants).map(Vec::len).sum();
        if unmerged_bytes >= (self.bytes_in_files / 2).clamp(*MERGE_BYTES.start(), *MERGE_BYTES.end()) {
            self.merge_journal()?;
            if let Some(journal) = self.journal.as_mut() {
                journal.clear()?;
            }
        }
        self.failed = false;
        Ok(())
    }

    /// Appends the uncommitted episodes to the journal. If the disk is full, deletes the last ones until the others fit.
    ///
    /// # Errors
    /// If an episode was not stored.
    fn append_group(&mut self) -> Result<()> {
        let Some(journal) = self.journal.as_mut() else { return Ok(()) };
        let mut failure = None;
        while !self.group.is_empty() {
            match journal.append(&self.group) {
                Ok(()) => {
                    self.committed += self.group.len();
                    self.group.clear();
                }
                Err(error) => {
                    // Also frees the space of their images.
                    let keep = if is_full(&error) { self.group.len() * 7 / 8 } else { 0 };
                    failure.get_or_insert(error);
                    self.group.truncate(keep);
                    discard_images(&self.folder, &self.schema, self.images, self.committed + keep)?;
                }
            }
        }
        failure.map_or(Ok(()), |error| Err(with_stored(error, self.committed)))
    }

    /// Commits the finished episodes after the images of the next one could not be written, and deletes those images.
    /// Returns the error to report.
    pub fn fail(&mut self, error: Error) -> Error {
        self.failed = true;
        let discarded = self.discard_images(self.episodes());
        let appended = self.append_group();
        if let Err(other) = discarded.and(appended) {
            tracing::debug!("after {error}: {other}");
        }
        with_stored(error, self.committed)
    }

    fn discard_images(&self, from: usize) -> Result<()> {
        discard_images(&self.folder, &self.schema, self.images, from)
    }

    /// Merges the journal into new column files. Each file is replaced atomically, the lengths last.
    fn merge_journal(&mut self) -> Result<()> {
        self.try_merge_journal().map_err(|error| with_stored(error, self.committed))
    }

    fn try_merge_journal(&mut self) -> Result<()> {
        let old = self.merged.then(|| ColumnFiles::open(&self.folder)).transpose()?;
        let old_constants = old.as_ref().map_or_else(|| Ok(vec![]), ColumnFiles::stored_constants)?;
        let rows = usize::try_from(self.rows.total()).map_err(|e| Error::external("writing columns", e))?;
        for (column, unmerged_rows) in self.columns.iter().zip(&self.unmerged) {
            if unmerged_rows.is_empty() {
                continue;
            }
            let before = old.as_ref().map_or_else(|| Ok(vec![]), |old| old.in_file(&column.name))?;
            self.replace_column(&column.name, |npz| {
                npz.array(column.dtype, rows, &column.shape, &[&before, unmerged_rows])
            })?;
        }
        let list = |values: &[i64]| -> Vec<u8> { values.iter().flat_map(|value| value.to_ne_bytes()).collect() };
        let first: Vec<i64> = self.rows.first_rows().iter().map(|&row| row as i64).collect();
        let lengths: Vec<i64> = self.rows.episodes().iter().map(|episode| episode.length as i64).collect();
        let count = lengths.len();
        self.replace_column(OFFSETS, |npz| npz.array(DType::Int64, count, &[], &[&list(&first)]))?;
        let recorded = serde_json::to_vec(&self.recorded).map_err(|e| Error::external("describing the dataset", e))?;
        self.replace_column(LENGTHS, |npz| {
            npz.array(DType::Int64, count, &[], &[&list(&lengths)])?;
            npz.member(METADATA, &recorded)?;
            let constants = old_constants.iter().chain(&self.new_constants);
            for (index, bytes) in constants.enumerate() {
                npz.member(&constant_member(index), bytes)?;
            }
            Ok(())
        })?;
        self.merged = true;
        self.bytes_in_files += self.unmerged.iter().map(Vec::len).sum::<usize>();
        self.rows_in_files = rows;
        self.unmerged.iter_mut().for_each(Vec::clear);
        self.new_constants.clear();
        Ok(())
    }

    /// Replaces a column file atomically.
    fn replace_column(&self, name: &str, fill: impl FnOnce(&mut NpzWriter) -> Result<()>) -> Result<()> {
        let temporary = self.folder.join(TEMPORARY);
        let path = column_path(&self.folder, name);
        let replaced = NpzWriter::create(&temporary).and_then(|mut npz| {
            fill(&mut npz)?;
            npz.finish()?;
            std::fs::rename(&temporary, &path).map_err(|e| Error::io(&path, "replacing a column file", e))
        });
        if replaced.is_err() {
            // A failure only wastes space; the next file has the same temporary name.
            let _ = files::delete_file(&temporary);
        }
        replaced
    }

    /// Commits all episodes and completes the column files.
    ///
    /// # Errors
    /// If this or an earlier commit failed.
    pub fn finish(&mut self) -> Result<()> {
        if self.failed {
            return Err(Error::external(
                "completing the dataset",
                "an earlier commit failed; later episodes are not stored",
            ));
        }
        self.commit()?;
        let Some(journal) = self.journal.take() else { return Ok(()) };
        self.failed = true;
        self.merge_journal()?;
        journal.remove()?;
        self.failed = false;
        Ok(())
    }
}

impl Drop for ColumnFilesWriter {
    fn drop(&mut self) {
        if !self.failed
            && let Err(error) = self.finish()
        {
            tracing::error!(dataset = %self.folder.display(), "the last episodes could not be stored: {error}");
        }
    }
}

/// Checks that the columns of a new dataset can be stored.
fn check_columns(schema: &Schema) -> Result<()> {
    for column in schema.columns() {
        check_name(&column.name)?;
        let problem = match &*column.name {
            _ if column.is_empty() => "has no elements",
            EPISODE_IDX | STEP_IDX if column.len() != 1 => "must be a scalar",
            _ => continue,
        };
        return Err(Error::config("schema", format!("column '{}' {problem}", column.name), "leave it out"));
    }
    Ok(())
}

/// Deletes the images of the uncommitted episodes, which begin at episode `from`.
fn discard_images(folder: &Path, schema: &Schema, images: ImageFiles, from: usize) -> Result<()> {
    for column in schema.columns().iter().filter(|column| column.is_image()) {
        let files = images.list(folder, &column.name)?;
        let names: Vec<PathBuf> = images::uncommitted(&files, from).iter().map(|file| file.name.clone()).collect();
        files::delete_named(folder, &names)?;
    }
    Ok(())
}
