//! Reads numeric columns from column files.

use super::images::{SUFFIXES, image_path, video_path};
use super::journal::PendingEpisode;
use super::npz::Npz;
use super::{LENGTHS, METADATA, Metadata, OFFSETS, column_path, constant_member, journal};
use crate::dataset::episodes::{EpisodeRows, index_columns};
use crate::dataset::{Constants, Irregularity, StepRange};
use crate::formats::opened::Opened;
use crate::formats::set_aside::COLUMN_FILES;
use std::collections::BTreeMap;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema, files};

/// The numeric columns of a folder, and the rows of its episodes. A column is read at its first access and then
/// cached in memory.
pub(crate) struct ColumnFiles {
    folder: PathBuf,
    rows: EpisodeRows,
    recorded: Metadata,
    columns: Vec<Column>,
    skipped: Vec<String>,
    /// Constants of the episodes that are in the journal but not yet in the column files.
    pending_constants: Vec<Constants>,
    opened: Opened,
    /// [`Self::identity`] when the dataset was opened, if it could be read and there were rows in the files.
    first_rows: Option<String>,
}

struct Column {
    spec: ColumnSpec,
    /// Number of committed rows in the column's file, which may hold more rows.
    in_file: usize,
    /// Rows that are in the journal but not yet in the column's file.
    unmerged_rows: Vec<u8>,
    data: OnceLock<Vec<u8>>,
}

impl ColumnFiles {
    /// Opens the column files of a folder.
    ///
    /// # Errors
    /// If the column files are damaged or inconsistent.
    pub fn open(folder: &Path) -> Result<Self> {
        let opened = Opened::new(folder, &COLUMN_FILES);
        // Reads the journal before the lengths, so that episodes merged between the two reads are skipped.
        let journal_path = journal::path(folder);
        let journal = match files::read(&journal_path, u64::MAX) {
            Err(Error::Io { source, .. }) if source.kind() == std::io::ErrorKind::NotFound => vec![],
            read => read?,
        };
        let (lengths, recorded) = stored_metadata(folder)?;
        let offsets_path = column_path(folder, OFFSETS);
        let offsets = integers(&mut Npz::open(&offsets_path)?, &offsets_path)?;
        let damaged =
            |problem: String| Error::corrupt(folder, problem, "restore it from a copy, or rebuild the dataset");
        let mut rows = EpisodeRows::from_lengths(&lengths, &offsets).map_err(damaged)?;
        let in_files = usize::try_from(rows.total()).map_err(|e| damaged(e.to_string()))?;
        let (mut columns, skipped) = columns(folder, &recorded, in_files)?;
        let specs: Vec<&ColumnSpec> = columns.iter().map(|column| &column.spec).collect();
        let pending = journal::replay(&journal_path, &journal, &specs, lengths.len())?;
        let mut pending_constants = vec![];
        for PendingEpisode { rows: length, columns: unmerged, constants } in pending {
            rows.push(length);
            columns
                .iter_mut()
                .zip(unmerged)
                .for_each(|(column, unmerged_rows)| column.unmerged_rows.extend(unmerged_rows));
            pending_constants.push(constants);
        }
        let folder = folder.to_owned();
        let mut files = Self { folder, rows, recorded, columns, skipped, pending_constants, opened, first_rows: None };
        files.first_rows = (in_files > 0).then(|| files.identity().ok()).flatten();
        // All that was read so far is of one dataset.
        files.check()?;
        Ok(files)
    }

    /// Checks, after something was read from the folder, that the dataset is still the one that was opened.
    ///
    /// # Errors
    /// If it was replaced.
    pub fn check(&self) -> Result<()> {
        self.opened.check(|| self.is_same())
    }

    /// Finds the column files with more rows than the episodes in `ep_len.npz`. While the journal has episodes, more rows are what
    /// a merge leaves that is not finished.
    ///
    /// # Errors
    /// If a column file cannot be read.
    pub fn excess_rows(&self) -> Result<Vec<Irregularity>> {
        let episodes = self.rows.episodes();
        if self.episodes_in_files() < episodes.len() || episodes.is_empty() {
            return Ok(vec![]);
        }
        let expected: usize = episodes.iter().map(|episode| episode.length).sum();
        let mut found = vec![];
        for ColumnSpec { name, .. } in self.columns() {
            let rows = Npz::open(&column_path(&self.folder, name))?.header()?.rows();
            if rows > expected {
                let what = format!("'{name}' has {rows} rows, and the episodes have {expected}");
                found.push(Irregularity { episode: None, what });
            }
        }
        self.check()?;
        Ok(found)
    }

    /// Whether the dataset in the folder is this one, or has grown from it. A program that replaces files by itself counts no
    /// replacement: the columns that were read so far are compared, or the manifests and first rows if none was.
    fn is_same(&self) -> Result<bool> {
        let (lengths, now) = stored_metadata(&self.folder)?;
        let own = self.rows.episodes()[..self.episodes_in_files()].iter().map(|episode| episode.length as i64);
        if now.replaced != self.recorded.replaced || !lengths.iter().copied().take(own.len()).eq(own) {
            return Ok(false);
        }
        let mut read = self.columns.iter().filter_map(|column| Some((column, column.data.get()?))).peekable();
        if read.peek().is_none() {
            let is_recorded = now.manifest.is_some() && now.manifest == self.recorded.manifest;
            return Ok(is_recorded || (self.first_rows.is_some() && self.first_rows == self.identity().ok()));
        }
        for (column, data) in read {
            let in_file = column.in_file * column.spec.row_bytes();
            let (header, found) = Npz::open(&column_path(&self.folder, &column.spec.name))?.array()?;
            let is_equal = found.get(..in_file) == data.get(..in_file);
            if header.spec(&column.spec.name).as_ref() != Some(&column.spec) || !is_equal {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// See [`crate::Reader::identity`]: how often the dataset was replaced, and the first row of each column.
    ///
    /// # Errors
    /// If the file of a column is damaged.
    pub fn identity(&self) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.recorded.replaced.to_le_bytes());
        for Column { spec, in_file, unmerged_rows, .. } in &self.columns {
            let size = spec.row_bytes();
            let row = match in_file {
                0 => unmerged_rows.iter().take(size).copied().collect(),
                _ => Npz::open(&column_path(&self.folder, &spec.name))?.first_bytes(size)?,
            };
            hasher.update(spec.name.as_bytes());
            hasher.update(&row);
        }
        Ok(hasher.finalize().to_hex().to_string())
    }

    /// How often the dataset was replaced by another one at its path.
    pub(super) const fn replaced(&self) -> u64 {
        self.recorded.replaced
    }

    /// The rows of each episode.
    pub const fn rows(&self) -> &EpisodeRows {
        &self.rows
    }

    /// The folder of the dataset.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The numeric columns.
    pub fn columns(&self) -> impl Iterator<Item = &ColumnSpec> {
        self.columns.iter().map(|column| &column.spec)
    }

    /// The schema passed to the writer, including image columns; `None` for third-party datasets.
    pub const fn recorded(&self) -> Option<&Schema> {
        self.recorded.schema.as_ref()
    }

    /// The schema for readers: index columns, then numeric and image columns, in the order of the recorded schema or,
    /// without a recorded schema, by name.
    ///
    /// # Errors
    /// If two columns have the same name.
    pub fn schema(&self, images: Vec<ColumnSpec>) -> Result<Schema> {
        let known = self.recorded().map(Schema::columns).unwrap_or_default();
        let all: Vec<ColumnSpec> = self.columns().cloned().chain(images).collect();
        let indices = index_columns(if known.is_empty() { &all } else { known });
        let mut columns: Vec<ColumnSpec> =
            all.into_iter().filter(|c| c.name != EPISODE_IDX && c.name != STEP_IDX).collect();
        let position = |column: &ColumnSpec| known.iter().position(|k| k.name == column.name).unwrap_or(known.len());
        columns.sort_by(|a, b| position(a).cmp(&position(b)).then_with(|| a.name.cmp(&b.name)));
        columns.splice(0..0, indices);
        Schema::new(columns)
    }

    /// Returns whether `name` is an index column or a numeric column.
    pub fn has(&self, name: &str) -> bool {
        self.columns().any(|column| column.name == name) || name == EPISODE_IDX || name == STEP_IDX
    }

    /// Reads ranges of rows of a numeric column or an index column.
    ///
    /// # Errors
    /// See [`Reader::read_column`](crate::Reader::read_column).
    pub fn read(&self, spec: &ColumnSpec, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        if spec.name == EPISODE_IDX || spec.name == STEP_IDX {
            return self.rows.fill_index_column(spec, ranges, out);
        }
        EpisodeRows::check_output(spec, ranges, out)?;
        let data = self.data(&spec.name)?;
        let size = spec.row_bytes();
        let mut rest = out;
        for range in ranges {
            let rows = self.rows.range(range)?;
            let (target, after) = rest.split_at_mut(range.length * size);
            target.copy_from_slice(&data[rows.start as usize * size..rows.end as usize * size]);
            rest = after;
        }
        Ok(())
    }

    /// All rows of a numeric column.
    ///
    /// # Errors
    /// If there is no such column, or its file is damaged.
    pub fn data(&self, name: &str) -> Result<&[u8]> {
        let column = self.column(name)?;
        if let Some(data) = column.data.get() {
            return Ok(data);
        }
        let mut data = self.in_file(name)?;
        data.extend(&column.unmerged_rows);
        Ok(column.data.get_or_init(|| data))
    }

    /// Reads the committed rows of a column from the column's file.
    pub(super) fn in_file(&self, name: &str) -> Result<Vec<u8>> {
        let column = self.column(name)?;
        if column.in_file == 0 {
            return Ok(vec![]);
        }
        let path = column_path(&self.folder, name);
        let (header, mut data) = Npz::open(&path)?.array()?;
        if header.spec(name).as_ref() != Some(&column.spec) || header.rows() < column.in_file {
            return Err(Error::corrupt(path, "it changed since the dataset was opened", "open the dataset again"));
        }
        data.truncate(column.in_file * column.spec.row_bytes());
        self.check()?;
        Ok(data)
    }

    fn column(&self, name: &str) -> Result<&Column> {
        self.columns.iter().find(|column| column.spec.name == name).ok_or_else(|| {
            let known: Vec<&str> = self.columns().map(|column| column.name.as_str()).collect();
            let hint = format!("the numeric columns are {}", known.join(", "));
            Error::unknown("column", name, known, hint)
        })
    }

    /// The stored manifest.
    pub fn manifest(&self) -> Option<Manifest> {
        self.recorded.manifest.clone()
    }

    /// The constants of an episode.
    ///
    /// # Errors
    /// If `ep_len.npz` is damaged.
    pub fn constants(&self, episode: usize) -> Result<Constants> {
        let in_file = self.rows.episodes().len() - self.pending_constants.len();
        if let Some(pending) = episode.checked_sub(in_file).and_then(|i| self.pending_constants.get(i)) {
            return Ok(pending.clone());
        }
        let Some(named) = self.recorded.constants.get(episode).filter(|named| !named.is_empty()) else {
            return Ok(Constants::new());
        };
        let mut lengths = Npz::open(&column_path(&self.folder, LENGTHS))?;
        let read = |(name, &index): (&String, &usize)| Ok((name.clone(), lengths.member(&constant_member(index))?));
        let constants = named.iter().map(read).collect();
        self.check()?;
        constants
    }

    /// Names of the column files that are not read, because their elements are not numeric.
    pub(super) fn skipped(&self) -> &[String] {
        &self.skipped
    }

    /// Reads the constants in `ep_len.npz`, sorted by the indices of their members.
    pub(super) fn stored_constants(&self) -> Result<Vec<Vec<u8>>> {
        let count = self.recorded.constants.iter().flat_map(BTreeMap::values).max().map_or(0, |last| last + 1);
        let mut lengths = Npz::open(&column_path(&self.folder, LENGTHS))?;
        (0..count).map(|index| lengths.member(&constant_member(index))).collect()
    }

    /// For each episode in `ep_len.npz`, the names of its constants and the indices of their members.
    pub(super) fn constants_in_file(&self) -> &[BTreeMap<String, usize>] {
        &self.recorded.constants
    }

    /// Number of episodes in the column files.
    pub(super) fn episodes_in_files(&self) -> usize {
        self.rows.episodes().len() - self.pending_constants.len()
    }

    /// Size in bytes of each column (including its subfolder) and of all other files in total, largest first.
    ///
    /// # Errors
    /// If the folder cannot be listed.
    pub fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut parts: BTreeMap<String, u64> = BTreeMap::new();
        let io = |e| Error::io(&self.folder, "listing the folder", e);
        for entry in std::fs::read_dir(&self.folder).map_err(io)? {
            let entry = entry.map_err(io)?;
            let metadata = entry.metadata().map_err(io)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            let column = name.strip_suffix(".npz").unwrap_or(&name);
            let (part, size) = if metadata.is_dir() {
                (name, folder_size(&entry.path())?)
            } else if self.columns().any(|spec| spec.name == column) {
                (column.to_owned(), metadata.len())
            } else {
                ("(lengths of the episodes, constants and metadata)".to_owned(), metadata.len())
            };
            *parts.entry(part).or_default() += size;
        }
        let mut parts: Vec<(String, u64)> = parts.into_iter().collect();
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }
}

/// The content of `ep_len.npz`: the lengths of the episodes, and the metadata, which is empty if another program wrote it.
///
/// # Errors
/// If the file is missing or damaged.
pub(super) fn stored_metadata(folder: &Path) -> Result<(Vec<i64>, Metadata)> {
    let path = column_path(folder, LENGTHS);
    let mut file = Npz::open(&path)?;
    let lengths = integers(&mut file, &path)?;
    let damaged = |problem: String| Error::corrupt(folder, problem, "restore it from a copy, or rebuild the dataset");
    let recorded = if file.has(METADATA) {
        serde_json::from_slice(&file.member(METADATA)?)
            .map_err(|e| damaged(format!("the metadata in {LENGTHS}.npz is unreadable: {e}")))?
    } else if file.is_plain() {
        Metadata::default()
    } else {
        return Err(damaged(format!("{LENGTHS}.npz has members that this version does not know")));
    };
    Ok((lengths, recorded))
}

/// Returns whether the images of a dataset are videos: whether a column has a video and no image of the first episode.
pub(crate) fn contains_videos(folder: &Path) -> bool {
    let Ok((lengths, recorded)) = stored_metadata(folder) else { return false };
    // All episodes may be in the journal; writers store no episode without rows.
    let first = lengths.iter().position(|&length| length > 0).unwrap_or(0);
    let columns: Vec<String> = match recorded.schema {
        Some(schema) => schema.columns().iter().filter(|c| c.is_image()).map(|c| c.name.clone()).collect(),
        None => {
            let entries = folder.read_dir().into_iter().flatten().flatten();
            entries.filter_map(|entry| entry.file_name().into_string().ok()).collect()
        }
    };
    let has_image = |column: &str| SUFFIXES.iter().any(|end| image_path(folder, column, first, 0, end).is_file());
    columns.iter().any(|column| video_path(folder, column, first).is_file() && !has_image(column))
}

/// Size of all files in a folder of images, in bytes.
fn folder_size(folder: &Path) -> Result<u64> {
    let io = |e| Error::io(folder, "listing the folder", e);
    std::fs::read_dir(folder)
        .map_err(io)?
        .map(|entry| entry.and_then(|entry| entry.metadata()).map(|metadata| metadata.len()).map_err(io))
        .sum()
}

/// The numeric columns of the recorded schema or, without a recorded schema, of all files with numeric elements. Also
/// returns the names of the column files whose elements are not numeric.
fn columns(folder: &Path, recorded: &Metadata, rows: usize) -> Result<(Vec<Column>, Vec<String>)> {
    let names: Vec<String> = match &recorded.schema {
        Some(schema) => schema.columns().iter().filter(|c| !c.is_image()).map(|c| c.name.clone()).collect(),
        None => column_file_names(folder)?,
    };
    let (mut columns, mut skipped) = (vec![], vec![]);
    for name in names {
        super::check_name(&name)?;
        let path = column_path(folder, &name);
        let known = recorded.schema.as_ref().and_then(|schema| schema.column(&name).ok());
        let mut spec = known.cloned();
        // A dataset without committed rows need not have column files yet.
        if rows > 0 || known.is_none() {
            let header = Npz::open(&path)?.header()?;
            let Some(found) = header.spec(&name).filter(|spec| !spec.is_empty()) else {
                if known.is_some() {
                    let problem = "it holds no numbers that can be read, which contradicts the recorded schema";
                    return Err(Error::corrupt(path, problem, "restore it from a copy, or rebuild the dataset"));
                }
                skipped.push(name);
                continue;
            };
            let problem = if known.is_some_and(|known| *known != found) {
                format!("it holds {} {:?}, which contradicts the recorded schema", found.dtype.name(), found.shape)
            } else if header.rows() < rows {
                format!("it has {} rows; the episodes have {rows}", header.rows())
            } else {
                String::new()
            };
            if !problem.is_empty() {
                return Err(Error::corrupt(path, problem, "restore it from a copy, or rebuild the dataset"));
            }
            spec = Some(found);
        }
        if let Some(spec) = spec {
            columns.push(Column { spec, in_file: rows, unmerged_rows: vec![], data: OnceLock::new() });
        }
    }
    Ok((columns, skipped))
}

/// The names of the column files in a folder, sorted.
fn column_file_names(folder: &Path) -> Result<Vec<String>> {
    let io = |e| Error::io(folder, "listing the folder", e);
    let mut names = vec![];
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let name = entry.map_err(io)?.file_name();
        if let Some(column) = name.to_str().and_then(|name| name.strip_suffix(".npz"))
            && super::check_name(column).is_ok()
        {
            names.push(column.to_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// The most episodes of a dataset.
const MAX_EPISODES: usize = 1 << 24;

/// Reads the integers in the one-dimensional array of an archive.
fn integers(npz: &mut Npz, path: &Path) -> Result<Vec<i64>> {
    let rows = npz.header()?.rows();
    if rows > MAX_EPISODES {
        let problem = format!("it has {rows} episodes, more than {MAX_EPISODES}");
        return Err(Error::corrupt(path, problem, "rebuild the dataset"));
    }
    let (header, bytes) = npz.array()?;
    match header.spec("").filter(|_| header.shape.len() == 1).map(|spec| spec.dtype) {
        Some(DType::Int32) => Ok(bytes.as_chunks().0.iter().map(|&b| i64::from(i32::from_ne_bytes(b))).collect()),
        Some(DType::Int64) => Ok(bytes.as_chunks().0.iter().map(|&b| i64::from_ne_bytes(b)).collect()),
        _ => Err(Error::corrupt(path, "it is not a one-dimensional array of integers", "rebuild the dataset")),
    }
}

/// What tells whether another program wrote to files: a hash of their sizes, their times and what they are. `each` calls the given
/// function with every path.
pub fn state_of(each: impl Fn(&mut dyn FnMut(&Path))) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    each(&mut |file| {
        let Ok(found) = std::fs::metadata(file) else { return };
        let times = [found.mtime(), found.mtime_nsec(), found.ctime(), found.ctime_nsec()];
        for number in [found.dev(), found.ino(), found.size()].into_iter().chain(times.map(i64::cast_unsigned)) {
            hasher.update(&number.to_le_bytes());
        }
    });
    hasher.finalize()
}

/// Checks that no other program wrote to files since [`state_of`] gave their state.
///
/// # Errors
/// If one did.
pub fn check_unchanged(folder: &Path, before: blake3::Hash, each: impl Fn(&mut dyn FnMut(&Path))) -> Result<()> {
    if state_of(each) == before {
        return Ok(());
    }
    let problem = "another program wrote to its files while they were read";
    Err(Error::corrupt(folder, problem, "run the command again once that program has ended"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_that_another_program_writes_to_are_found() {
        let folder = tempfile::tempdir().expect("creating a folder");
        let paths = ["a", "b"].map(|name| folder.path().join(name));
        paths.iter().for_each(|path| std::fs::write(path, "one").expect("writing"));
        let each = |visit: &mut dyn FnMut(&Path)| paths.iter().for_each(|path| visit(path));
        let before = state_of(each);
        check_unchanged(folder.path(), before, each).expect("unchanged files");
        std::fs::write(folder.path().join("new"), "two").expect("writing");
        std::fs::rename(folder.path().join("new"), &paths[1]).expect("replacing");
        let error = check_unchanged(folder.path(), before, each).expect_err("another file").to_string();
        assert!(error.contains("another program wrote"), "{error}");
    }
}
