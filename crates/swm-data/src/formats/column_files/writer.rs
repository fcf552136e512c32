//! Writing the columns of numbers: journal first, column files now and then.

use super::journal::{self, Journal};
use super::npz::NpzWriter;
use super::{ColumnFiles, LENGTHS, OFFSETS, Pending, RECORDED, Recorded, check_name, constant_member, file, is_there};
use crate::dataset::episodes::{self, EPISODE, Rows, STEP};
use crate::dataset::{CommitPolicy, Constants, StepRange, WriteMode, WriteOptions};
use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::Instant;
use swm_core::{Batch, ColumnSpec, DType, Error, Result, Schema};

/// The journal is folded into the column files when it is half as long as they are, but not below and always above
/// these bytes, which also bound the memory.
const FOLD: std::ops::RangeInclusive<usize> = 16 << 20..=256 << 20;

/// Commits episodes' numbers. A format writes the pictures of an episode first, then calls [`ColumnFilesWriter::write`].
pub(crate) struct ColumnFilesWriter {
    folder: PathBuf,
    /// Locked, so that nobody else writes there.
    _lock: File,
    journal: Option<Journal>,
    schema: Schema,
    /// The columns of numbers.
    columns: Vec<ColumnSpec>,
    recorded: Recorded,
    policy: CommitPolicy,
    last_commit: Instant,
    /// All episodes, committed or not.
    rows: Rows,
    /// Records of episodes that are not committed.
    group: Vec<u8>,
    in_group: usize,
    /// Rows that are in the files, and their bytes.
    rows_in_files: usize,
    bytes_in_files: usize,
    /// What is not in the files: the bytes of each column, and constants.
    tails: Vec<Vec<u8>>,
    new_constants: Vec<Vec<u8>>,
    /// Members that hold constants, and which of them holds what, by its hash.
    constants: usize,
    known_constants: HashMap<blake3::Hash, usize>,
    /// Whether a commit failed.
    failed: bool,
}

impl ColumnFilesWriter {
    /// Creates, continues or replaces the column files of a folder. When they are to be continued, `known` is what its
    /// reader says of the columns.
    ///
    /// # Errors
    /// When there is a dataset and must not be, its columns differ, somebody else writes to it, or the disk refuses.
    pub fn create(folder: &Path, schema: &Schema, options: &WriteOptions, known: Option<&Schema>) -> Result<Self> {
        for column in schema.columns() {
            check_name(&column.name)?;
            let problem = match &*column.name {
                _ if column.is_empty() => "holds no number",
                EPISODE | STEP if column.len() != 1 => "numbers rows, and must be one number",
                _ => continue,
            };
            return Err(Error::config("schema", format!("column '{}' {problem}", column.name), "leave it out"));
        }
        let exists = is_there(folder);
        if !exists && folder.read_dir().is_ok_and(|mut entries| entries.next().is_some()) {
            let problem = format!("{} holds something else", folder.display());
            return Err(Error::config("dataset", problem, "choose another path"));
        }
        if exists {
            match options.mode {
                WriteMode::Create => {
                    let problem = format!("{} exists already", folder.display());
                    let fix = "choose another path, or say whether to append to it or to overwrite it";
                    return Err(Error::config("dataset", problem, fix));
                }
                WriteMode::Overwrite => replace(folder)?,
                WriteMode::Append => {}
            }
        }
        std::fs::create_dir_all(folder).map_err(|e| Error::io(folder, "creating the folder", e))?;
        let lock = lock(folder)?;
        let columns = schema.columns().iter().filter(|c| !c.is_image()).cloned().collect::<Vec<_>>();
        let mut writer = Self {
            folder: folder.to_owned(),
            _lock: lock,
            journal: None,
            schema: schema.clone(),
            tails: vec![vec![]; columns.len()],
            columns,
            recorded: Recorded { schema: Some(schema.clone()), manifest: options.manifest.clone(), constants: vec![] },
            policy: options.commit,
            last_commit: Instant::now(),
            rows: Rows::default(),
            group: vec![],
            in_group: 0,
            rows_in_files: 0,
            bytes_in_files: 0,
            new_constants: vec![],
            constants: 0,
            known_constants: HashMap::new(),
            failed: false,
        };
        if exists && options.mode == WriteMode::Append {
            writer.continue_from(known)?;
        }
        writer.fold()?;
        writer.journal = Some(Journal::create(folder)?);
        Ok(writer)
    }

    /// Takes over what is there; what an interrupted writer left in the journal is folded next.
    fn continue_from(&mut self, known: Option<&Schema>) -> Result<()> {
        let old = ColumnFiles::open(&self.folder)?;
        if let [name, ..] = old.left_out() {
            let problem = format!("its column '{name}' holds no numbers, which cannot be continued");
            return Err(Error::corrupt(&self.folder, problem, "convert it to a new dataset, without this column"));
        }
        let known = match known {
            Some(known) => known.clone(),
            None => old.schema(vec![])?,
        };
        episodes::check_continued(&self.folder.display(), &self.schema, &known)?;
        if !old.rows().is_contiguous() {
            let problem = "its episodes do not follow each other";
            return Err(Error::corrupt(&self.folder, problem, "convert it to a new dataset first"));
        }
        let in_files = old.episodes_in_files();
        self.rows_in_files = old.rows().episodes()[..in_files].iter().map(|episode| episode.length).sum();
        self.columns = old.columns().cloned().collect();
        self.tails = vec![];
        for column in &self.columns {
            let in_file = self.rows_in_files * column.row_bytes();
            self.bytes_in_files += in_file;
            self.tails.push(old.data(&column.name)?[in_file..].to_vec());
        }
        // What is stored stays as it is, numbering included; only new pictures and numbers come.
        let stored = |column: &&ColumnSpec| column.is_image() || self.columns.contains(column);
        let columns: Vec<ColumnSpec> = known.columns().iter().filter(stored).cloned().collect();
        self.recorded.schema = Some(old.recorded().cloned().map_or_else(|| Schema::new(columns), Ok)?);
        self.recorded.manifest = self.recorded.manifest.take().or_else(|| old.manifest());
        self.recorded.constants = old.constants_in_file().to_vec();
        // A foreign dataset has none.
        self.recorded.constants.resize(in_files, BTreeMap::new());
        let stored = old.stored_constants()?;
        self.constants = stored.len();
        self.known_constants.extend(stored.iter().map(|bytes| blake3::hash(bytes)).zip(0..));
        for episode in in_files..old.rows().episodes().len() {
            self.remember(&old.constants(episode)?);
        }
        self.rows = old.rows().clone();
        Ok(())
    }

    /// Episodes, committed or not.
    pub fn episodes(&self) -> usize {
        self.rows.episodes().len()
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Adds the numbers of an episode, which [`episodes::check`] has seen, and commits when it is time.
    ///
    /// # Errors
    /// When a commit fails, now or before.
    pub fn write(&mut self, episode: &Batch, constants: &Constants) -> Result<()> {
        if self.failed {
            return Err(Error::external("writing an episode", "an earlier commit failed; nothing more is kept"));
        }
        let number = self.episodes();
        self.rows.push(episode.rows());
        let mut pending = Pending { rows: episode.rows(), columns: vec![], constants: constants.clone() };
        for column in &self.columns {
            if column.name == EPISODE || column.name == STEP {
                let mut bytes = vec![0; episode.rows() * column.row_bytes()];
                self.rows.number(column, &[StepRange::new(number, 0, episode.rows())], &mut bytes)?;
                pending.columns.push(bytes);
            } else {
                pending.columns.push(episode.bytes(episode.schema().index(&column.name)?).to_vec());
            }
        }
        journal::record(number, &pending, &mut self.group)?;
        self.in_group += 1;
        self.tails.iter_mut().zip(&pending.columns).for_each(|(tail, bytes)| tail.extend(bytes));
        self.remember(constants);
        let due = self.in_group >= self.policy.episodes
            || self.group.len() >= self.policy.bytes
            || self.last_commit.elapsed() >= self.policy.interval;
        if due { self.commit() } else { Ok(()) }
    }

    fn remember(&mut self, constants: &Constants) {
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

    /// Commits what is not yet committed.
    fn commit(&mut self) -> Result<()> {
        self.last_commit = Instant::now();
        let Some(journal) = self.journal.as_mut() else { return Ok(()) };
        // True until it is done.
        self.failed = true;
        if self.in_group > 0 {
            journal.append(&self.group)?;
            (self.in_group, self.group) = (0, vec![]);
        }
        let waiting: usize = self.tails.iter().chain(&self.new_constants).map(Vec::len).sum();
        if waiting >= (self.bytes_in_files / 2).clamp(*FOLD.start(), *FOLD.end()) {
            self.fold()?;
            if let Some(journal) = self.journal.as_mut() {
                journal.clear()?;
            }
        }
        self.failed = false;
        Ok(())
    }

    /// Writes the column files anew, with the rows that are only in the journal. Each appears at once, complete; the
    /// lengths are the last.
    fn fold(&mut self) -> Result<()> {
        let old = is_there(&self.folder).then(|| ColumnFiles::open(&self.folder)).transpose()?;
        let old_constants = old.as_ref().map_or_else(|| Ok(vec![]), ColumnFiles::stored_constants)?;
        let rows = usize::try_from(self.rows.total()).map_err(|e| Error::external("writing columns", e))?;
        for (column, tail) in self.columns.iter().zip(&self.tails) {
            if tail.is_empty() {
                continue;
            }
            let before = old.as_ref().map_or_else(|| Ok(vec![]), |old| old.in_file(&column.name))?;
            self.put(&column.name, |npz| npz.array(column.dtype, rows, &column.shape, &[&before, tail]))?;
        }
        let list = |values: &[i64]| -> Vec<u8> { values.iter().flat_map(|value| value.to_ne_bytes()).collect() };
        #[allow(clippy::cast_possible_wrap)]
        let first: Vec<i64> = self.rows.first().iter().map(|&row| row as i64).collect();
        #[allow(clippy::cast_possible_wrap)]
        let lengths: Vec<i64> = self.rows.episodes().iter().map(|episode| episode.length as i64).collect();
        let count = lengths.len();
        self.put(OFFSETS, |npz| npz.array(DType::Int64, count, &[], &[&list(&first)]))?;
        let recorded = serde_json::to_vec(&self.recorded).map_err(|e| Error::external("describing the dataset", e))?;
        self.put(LENGTHS, |npz| {
            npz.array(DType::Int64, count, &[], &[&list(&lengths)])?;
            npz.member(RECORDED, &recorded)?;
            let constants = old_constants.iter().chain(&self.new_constants);
            for (index, bytes) in constants.enumerate() {
                npz.member(&constant_member(index), bytes)?;
            }
            Ok(())
        })?;
        self.bytes_in_files += self.tails.iter().map(Vec::len).sum::<usize>();
        self.rows_in_files = rows;
        self.tails.iter_mut().for_each(Vec::clear);
        self.new_constants.clear();
        Ok(())
    }

    /// Writes a file beside the one it replaces, then puts it in its place.
    fn put(&self, name: &str, fill: impl FnOnce(&mut NpzWriter) -> Result<()>) -> Result<()> {
        // The one name that the reference does not take for a column's.
        let passing = self.folder.join(format!("{LENGTHS}.tmp"));
        let mut npz = NpzWriter::create(&passing)?;
        fill(&mut npz)?;
        npz.finish()?;
        let path = file(&self.folder, name);
        std::fs::rename(&passing, &path).map_err(|e| Error::io(&path, "replacing a column file", e))
    }

    /// Commits everything and completes the column files.
    ///
    /// # Errors
    /// When a commit fails, now or before.
    pub fn finish(&mut self) -> Result<()> {
        if self.failed {
            return Err(Error::external("completing the dataset", "an earlier commit failed; nothing more is kept"));
        }
        self.commit()?;
        let Some(journal) = self.journal.take() else { return Ok(()) };
        self.failed = true;
        self.fold()?;
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
            tracing::error!(dataset = %self.folder.display(), "the last episodes are lost: {error}");
        }
    }
}

/// Locks a folder against other writers, until the file is dropped or the process ends.
pub(crate) fn lock(folder: &Path) -> Result<File> {
    let file = File::open(folder).map_err(|e| Error::io(folder, "opening the folder", e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(std::fs::TryLockError::WouldBlock) => {
            let problem = format!("somebody else writes to {}", folder.display());
            Err(Error::config("dataset", problem, "wait until they are done, or choose another path"))
        }
        Err(std::fs::TryLockError::Error(e)) => Err(Error::io(folder, "locking the folder", e)),
    }
}

/// Removes a dataset. It is renamed first, so that nothing is ever half there.
pub(crate) fn replace(folder: &Path) -> Result<()> {
    let _lock = lock(folder)?;
    let mut aside = folder.as_os_str().to_owned();
    aside.push(format!(".replaced-{}", uuid::Uuid::new_v4().simple()));
    std::fs::rename(folder, &aside).map_err(|e| Error::io(folder, "replacing the dataset", e))?;
    if let Err(error) = std::fs::remove_dir_all(&aside) {
        tracing::warn!(folder = %Path::new(&aside).display(), "a replaced dataset stays: {error}");
    }
    Ok(())
}
