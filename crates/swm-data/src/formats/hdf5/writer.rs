//! Writes episodes: rows are appended to the file immediately and become visible when they are committed.

use super::layout::{END_AT, Layout, SIGNATURE, VERSIONS};
use super::reader::Hdf5Reader;
use super::record::RecordWriter;
use super::source::Source;
use super::table::{Space, TableState, TableWriter};
use crate::dataset::Location;
use crate::dataset::episodes::{self, EpisodeRows};
use crate::dataset::{CommitPolicy, Constants, Reader as _, StepRange, WriteMode, WriteOptions, Writer, with_stored};
use crate::formats::replacing::ReplacingWriter;
use std::io;
use std::os::unix::fs::{FileExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::files::{self, Lock};
use swm_core::{Batch, Error, Manifest, Result, Schema};

/// Creates, continues or replaces a file.
pub(super) fn create(location: &Location, schema: &Schema, options: WriteOptions) -> Result<Box<dyn Writer>> {
    let location = super::file(location)?;
    let path = location.local("hdf5")?;
    for name in [EPISODE_IDX, STEP_IDX] {
        if schema.column(name).is_ok_and(|column| column.len() != 1) {
            let problem = format!("column '{name}' must be a scalar");
            return Err(Error::config("schema", problem, "leave it out"));
        }
    }
    let manifest = options.manifest.as_ref();
    let mut writer = match (options.mode, is_complete_file(path)?) {
        (_, false) => create_file(path, schema, manifest)?,
        (WriteMode::Create, true) => {
            let problem = format!("{} exists already", path.display());
            let fix = "choose another path, append to it, or overwrite it";
            return Err(Error::config("dataset", problem, fix));
        }
        (WriteMode::Overwrite, true) => {
            let old = Lock::file(path)?;
            check_is_dataset(&old, path)?;
            Layout::new(schema.columns())?;
            let (path, schema, incoming) = (path.to_owned(), schema.clone(), schema.clone());
            let replace = move || -> Result<Box<dyn Writer>> {
                let temporary = temporary_path(&path)?;
                let mut writer = create_file(&temporary, &schema, options.manifest.as_ref())?;
                writer.policy = options.commit;
                writer.replaces = Some(Replaced { path, _lock: old });
                Ok(Box::new(writer))
            };
            let check = move |episode: &Batch, _: &Constants| episodes::check_episode(episode, &incoming);
            return Ok(ReplacingWriter::boxed(check, replace));
        }
        (WriteMode::Append, true) => {
            let old = Lock::file(path)?;
            let reader = reader(&old, path)?;
            options.continues.iter().try_for_each(|continued| continued.check(&reader, &location))?;
            episodes::check_appendable(&location, schema, reader.schema())?;
            let mut writer = match Hdf5Writer::resume(path, &reader, old)? {
                Ok(writer) => writer,
                Err(old) => copy_to_this_layout(path, &reader, old)?,
            };
            if let Some(manifest) = manifest
                && reader.manifest().as_ref() != Some(manifest)
            {
                writer.append_record(&RecordWriter::manifest(manifest)?)?;
                writer.commit()?;
            }
            writer
        }
    };
    writer.schema = schema.clone();
    writer.policy = options.commit;
    Ok(Box::new(writer))
}

/// Whether a file exists at `path`, other than an empty file or one whose creation was killed.
pub(super) fn is_complete_file(path: &Path) -> Result<bool> {
    // The signature is written last when a file is created.
    let killed = [[0; SIGNATURE.len()], VERSIONS].concat();
    let mut start = [0; 2 * SIGNATURE.len()];
    match files::open(path) {
        Ok(file) => {
            let size = file.read_at(&mut start, 0).map_err(|e| Error::io(path, "reading the file", e))?;
            Ok(start[..size] != killed[..size])
        }
        Err(Error::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// Creates a file without episodes. Leaves no file if that fails.
fn create_file(path: &Path, schema: &Schema, manifest: Option<&Manifest>) -> Result<Hdf5Writer> {
    let file = Lock::file(path)?;
    // Another process may have created the file before it was locked.
    if is_complete_file(path)? {
        return Err(Error::config("dataset", format!("{} exists already", path.display()), "choose another path"));
    }
    Hdf5Writer::begin(path, file, schema, manifest).inspect_err(|_| {
        // Returns the error of the file, even if it cannot be removed.
        let _ = files::delete_file(path);
    })
}

/// Reads a locked file.
fn reader(file: &Lock, path: &Path) -> Result<Hdf5Reader> {
    Hdf5Reader::of(Source::of(file.try_clone().map_err(|e| Error::io(path, "opening it", e))?, path)?)
}

/// Checks that a file may be replaced by a dataset.
fn check_is_dataset(file: &Lock, path: &Path) -> Result<()> {
    reader(file, path).map(drop).map_err(|error| {
        let problem = format!("it is not a dataset that can be replaced: {error}");
        Error::config(path.display().to_string(), problem, "choose another path, or remove the file")
    })
}

/// The temporary path of a file that replaces the one at `path`, whose lock the caller holds. Deletes what a kill left there.
fn temporary_path(path: &Path) -> Result<PathBuf> {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let temporary = path.with_file_name(format!(".{name}.copy.tmp"));
    files::delete_file(&temporary)?;
    Ok(temporary)
}

/// The old file, which stays locked until the new one replaces it.
struct Replaced {
    path: PathBuf,
    _lock: Lock,
}

/// Copies the locked file at `path` to this module's layout, and replaces the file with the copy.
fn copy_to_this_layout(path: &Path, reader: &Hdf5Reader, lock: Lock) -> Result<Hdf5Writer> {
    if let [name, ..] = &reader.unread()[..] {
        let problem = format!("'{name}' is no numeric dataset, and appending would lose it");
        return Err(Error::corrupt(path, problem, "convert the file to a new dataset, which leaves it out"));
    }
    let schema = Schema::new(reader.stored())?;
    let temporary = temporary_path(path)?;
    let mut writer = create_file(&temporary, &schema, reader.manifest().as_ref())?;
    writer.replaces = Some(Replaced { path: path.to_owned(), _lock: lock });
    let names: Vec<&str> = schema.columns().iter().map(|column| &*column.name).collect();
    let copied = (0..).zip(reader.episodes()).try_for_each(|(position, episode)| {
        let batch = reader.read(&names, &[StepRange::new(position, 0, episode.length)])?;
        writer.append(&batch, &reader.constants(position)?)
    });
    if let Err(error) = copied.and_then(|()| writer.commit()).and_then(|()| writer.take_place()) {
        // A part of the copy must not replace the file.
        writer.failed = true;
        return Err(error);
    }
    Ok(writer)
}

/// The state of a writer before an episode was added.
struct Snapshot {
    space: Space,
    tables: Vec<TableState>,
    episodes: usize,
    in_group: usize,
}

struct Hdf5Writer {
    path: PathBuf,
    file: Lock,
    /// The file that this one, at a temporary path, replaces at its first commit of episodes.
    replaces: Option<Replaced>,
    space: Space,
    /// The record, lengths and first rows of episodes, then the columns.
    tables: Vec<TableWriter>,
    /// Columns of the episodes to add.
    schema: Schema,
    policy: CommitPolicy,
    last_commit: Instant,
    /// End of the file at the last commit.
    committed_end: u64,
    /// Number of committed episodes, and of episodes since the last commit.
    committed: usize,
    in_group: usize,
    /// States after 1, 2, 4, … episodes since the last commit.
    earlier: Vec<Snapshot>,
    /// Whether a commit changes the committed part of the file at present.
    changing: bool,
    /// Whether episodes were added since the record was last closed.
    unclosed: bool,
    rows: EpisodeRows,
    record: RecordWriter,
    /// Whether a write failed.
    failed: bool,
    scratch: Vec<u8>,
}

/// Index of the record in [`Hdf5Writer::tables`].
const RECORD: usize = 0;
/// Index of the lengths of episodes in [`Hdf5Writer::tables`].
const LENGTHS: usize = 1;
/// Index of the first rows of episodes in [`Hdf5Writer::tables`].
const OFFSETS: usize = 2;
/// Index of the first column in [`Hdf5Writer::tables`].
const COLUMNS: usize = 3;

impl Hdf5Writer {
    /// Creates a file without episodes.
    fn begin(path: &Path, file: Lock, schema: &Schema, manifest: Option<&Manifest>) -> Result<Self> {
        let layout = Layout::new(schema.columns())?;
        let io = |e| Error::io(path, "creating the file", e);
        let (signature, rest) = layout.bytes.split_at(SIGNATURE.len());
        file.set_len(0).map_err(io)?;
        file.write_all_at(rest, signature.len() as u64).map_err(io)?;
        let space = Space::new(layout.bytes.len() as u64);
        let tables = layout.tables.into_iter().map(TableWriter::new).collect();
        let mut writer = Self::of(path, file, space, tables, schema);
        writer.append_record(&RecordWriter::schema(schema)?)?;
        if let Some(manifest) = manifest {
            writer.append_record(&RecordWriter::manifest(manifest)?)?;
        }
        writer.commit()?;
        writer.file.write_all_at(signature, 0).map_err(io)?;
        writer.file.sync_all().map_err(io)?;
        Ok(writer)
    }

    /// Continues a file with this layout; returns any other file unchanged.
    fn resume(path: &Path, reader: &Hdf5Reader, file: Lock) -> Result<Result<Self, Lock>> {
        let Some(schema) = &reader.record().schema else { return Ok(Err(file)) };
        let layout = Layout::new(schema.columns())?;
        let mut start = vec![0; layout.bytes.len()];
        let source = Source::of(file.try_clone().map_err(|e| Error::io(path, "opening the file again", e))?, path)?;
        if source.size() < start.len() as u64 {
            return Ok(Err(file));
        }
        source.read(0, &mut start)?;
        if !layout.matches_start(&start) || !reader.rows().is_contiguous() {
            return Ok(Err(file));
        }
        let rows = reader.rows().clone();
        let count = rows.episodes().len() as u64;
        let counts = [reader.record().committed as u64, count, count];
        let mut tables = vec![];
        for (i, table) in layout.tables.into_iter().enumerate() {
            let name = table.spec.name.clone();
            let rows = counts.get(i).copied().unwrap_or(rows.total());
            let table = TableWriter::load(table, &source, rows);
            tables.push(table.map_err(|problem| {
                Error::corrupt(path, format!("column '{name}': {problem}"), "convert it to a new dataset")
            })?);
        }
        let record = RecordWriter::resume(reader.record());
        let mut writer = Self::of(path, file, Space::new(source.size()), tables, schema);
        (writer.committed, writer.rows, writer.record) = (rows.episodes().len(), rows, record);
        Ok(Ok(writer))
    }

    fn of(path: &Path, file: Lock, space: Space, tables: Vec<TableWriter>, schema: &Schema) -> Self {
        Self {
            path: path.to_owned(),
            file,
            replaces: None,
            committed_end: space.end,
            space,
            tables,
            schema: schema.clone(),
            policy: CommitPolicy::default(),
            last_commit: Instant::now(),
            committed: 0,
            in_group: 0,
            earlier: vec![],
            changing: false,
            unclosed: false,
            rows: EpisodeRows::default(),
            record: RecordWriter::default(),
            failed: false,
            scratch: vec![],
        }
    }

    fn append_rows(&mut self, table: usize, rows: &[u8]) -> Result<()> {
        let written = self.tables[table].append(&self.file, &mut self.space, rows);
        written.map_err(|e| Error::io(&self.path, "writing an episode", e))
    }

    fn append_record(&mut self, lines: &[u8]) -> Result<()> {
        self.append_rows(RECORD, lines)
    }

    /// Appends the rows of an episode.
    fn append(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        let position = self.rows.episodes().len();
        let first = self.rows.total();
        let too_many = || Error::mismatch("writing an episode", "more than 2^31 - 1 rows", "fewer rows");
        let length = i32::try_from(episode.rows()).map_err(|_| too_many())?;
        // Remains `true` if a write fails, because incomplete data must not be committed.
        self.failed = true;
        self.rows.push(episode.rows());
        for at in COLUMNS..self.tables.len() {
            let spec = self.tables[at].table.spec.clone();
            if spec.name == EPISODE_IDX || spec.name == STEP_IDX {
                let mut indices = std::mem::take(&mut self.scratch);
                indices.resize(episode.rows() * spec.row_bytes(), 0);
                self.rows.fill_index_column(&spec, &[StepRange::new(position, 0, episode.rows())], &mut indices)?;
                self.append_rows(at, &indices)?;
                self.scratch = indices;
            } else {
                let column = episode.schema().index(&spec.name)?;
                let written = self.tables[at].append(&self.file, &mut self.space, episode.bytes(column));
                written.map_err(|e| Error::io(&self.path, "writing an episode", e))?;
            }
        }
        let lines = self.record.episode(position, constants)?;
        self.append_record(&lines)?;
        self.append_rows(OFFSETS, &first.to_le_bytes())?;
        self.append_rows(LENGTHS, &length.to_le_bytes())?;
        self.in_group += 1;
        self.unclosed = true;
        self.failed = false;
        Ok(())
    }

    /// Commits all added episodes and record lines.
    fn commit(&mut self) -> Result<()> {
        self.failed = true;
        self.try_commit().map_err(|e| Error::io(&self.path, "committing episodes", e))?;
        self.failed = false;
        (self.in_group, self.committed_end, self.last_commit) = (0, self.space.end, Instant::now());
        self.committed = self.rows.episodes().len();
        self.earlier.clear();
        if self.committed > 0 { self.take_place() } else { Ok(()) }
    }

    /// Moves the file to the place of the one that it replaces, if there is one.
    fn take_place(&mut self) -> Result<()> {
        let Some(old) = self.replaces.take() else { return Ok(()) };
        if let Err(error) = std::fs::rename(&self.path, &old.path) {
            let error = Error::io(&old.path, "replacing the file", error);
            (self.failed, self.replaces) = (true, Some(old));
            return Err(error);
        }
        self.path.clone_from(&old.path);
        Ok(())
    }

    fn try_commit(&mut self) -> io::Result<()> {
        let Self { file, space, tables, changing, .. } = self;
        for table in &mut *tables {
            table.write_new(file, space)?;
        }
        file.set_len(space.end)?;
        *changing = true;
        file.write_all_at(&space.end.to_le_bytes(), END_AT)?;
        file.sync_data()?;
        for table in &mut *tables {
            table.write_changes(file)?;
        }
        file.sync_data()?;
        // Writes the lengths of the episodes last.
        for at in (COLUMNS..tables.len()).chain([RECORD, OFFSETS, LENGTHS]) {
            tables[at].write_rows(file)?;
        }
        file.sync_data()?;
        *changing = false;
        Ok(())
    }

    /// Commits the remaining episodes and marks the file as complete.
    fn close(&mut self) -> Result<()> {
        if self.in_group == 0 && !self.unclosed {
            return Ok(());
        }
        self.failed = true;
        self.append_record(&RecordWriter::closed(self.rows.episodes().len())?)?;
        self.commit()?;
        self.unclosed = false;
        Ok(())
    }

    fn snapshot(&self) -> Snapshot {
        Snapshot {
            space: self.space.clone(),
            tables: self.tables.iter().map(|table| table.state.clone()).collect(),
            episodes: self.episodes(),
            in_group: self.in_group,
        }
    }

    /// Removes the episode that could not be stored, and commits the finished episodes before it, or fewer if the disk
    /// has no room for the commit. Returns the error to report.
    fn fail(&mut self, before: Snapshot, error: Error) -> Error {
        let mut next = Some(before);
        while let Some(state) = next.filter(|_| !self.changing) {
            self.space = state.space;
            self.tables.iter_mut().zip(state.tables).for_each(|(table, state)| table.state = state);
            self.rows.truncate(state.episodes);
            self.in_group = state.in_group;
            next = self.earlier.pop();
            // Frees the space of the removed episodes, which the commit may need.
            let shortened = self.file.set_len(self.space.end).map_err(|e| Error::io(&self.path, "shortening it", e));
            match shortened.and_then(|()| self.close()) {
                Ok(()) => break,
                Err(other) => tracing::debug!("after {error}: {other}"),
            }
        }
        self.failed = true;
        with_stored(error, self.committed)
    }

    fn earlier_failure() -> Error {
        Error::external("writing an episode", "an earlier write failed; later episodes are not stored")
    }
}

impl Writer for Hdf5Writer {
    fn write_episode_with(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        episodes::check_episode(episode, &self.schema)?;
        if self.failed {
            return Err(Self::earlier_failure());
        }
        let before = self.snapshot();
        if let Err(error) = self.append(episode, constants) {
            return Err(self.fail(before, error));
        }
        let due = self.in_group >= self.policy.episodes
            || self.space.end - self.committed_end >= self.policy.bytes as u64
            || self.last_commit.elapsed() >= self.policy.interval;
        if due {
            return self.commit().map_err(|error| self.fail(before, error));
        }
        if before.in_group.is_power_of_two() {
            self.earlier.push(before);
        }
        Ok(())
    }

    fn episodes(&self) -> usize {
        self.rows.episodes().len()
    }

    fn finish(mut self: Box<Self>) -> Result<()> {
        if self.failed {
            return Err(Self::earlier_failure());
        }
        self.close()?;
        let id = |found: std::fs::Metadata| (found.dev(), found.ino());
        if std::fs::metadata(&self.path).ok().map(id) != self.file.metadata().ok().map(id) {
            let problem = "another program moved, deleted or replaced it while episodes were written to it";
            return Err(Error::corrupt(
                &self.path,
                problem,
                "look for it under another name, or write the episodes again",
            ));
        }
        self.take_place()
    }
}

impl Drop for Hdf5Writer {
    fn drop(&mut self) {
        if !self.failed
            && let Err(error) = self.close()
        {
            tracing::error!(dataset = %self.path.display(), "the last episodes could not be stored: {error}");
        }
        if self.replaces.is_some()
            && let Err(error) = files::delete_file(&self.path)
        {
            tracing::debug!("the temporary file stays: {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::{ColumnSpec, DType};

    #[test]
    fn rejects_invalid_column_names() {
        for name in ["ep_len", "a/b", "."] {
            let error = Layout::new(&[ColumnSpec::new(name, DType::U8, [])])
                .err()
                .expect("an invalid column name must be an error");
            assert!(error.to_string().contains(name), "{error}");
        }
    }
}
