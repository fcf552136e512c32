//! Reading the columns of numbers.

use super::npz::Npz;
use super::{LENGTHS, OFFSETS, Pending, RECORDED, Recorded, constant_member, file, journal};
use crate::dataset::episodes::{EPISODE, Rows, STEP, numbering};
use crate::dataset::{Constants, StepRange};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use swm_core::{ColumnSpec, DType, Error, Manifest, Result, Schema};

/// The columns of numbers of a folder, and where its episodes begin. A column is read when it is first asked for, and
/// kept.
pub(crate) struct ColumnFiles {
    folder: PathBuf,
    rows: Rows,
    recorded: Recorded,
    columns: Vec<Column>,
    left_out: Vec<String>,
    /// Constants of the episodes that are in the journal only.
    pending_constants: Vec<Constants>,
}

struct Column {
    spec: ColumnSpec,
    /// Committed rows that are in its file, which may hold more.
    in_file: usize,
    /// Rows that are in the journal only.
    tail: Vec<u8>,
    data: OnceLock<Vec<u8>>,
}

impl ColumnFiles {
    /// Opens the column files of a folder.
    ///
    /// # Errors
    /// When they are damaged or contradict each other.
    pub fn open(folder: &Path) -> Result<Self> {
        // Before the lengths: what is folded into the files meanwhile is skipped then.
        let journal_path = journal::path(folder);
        let journal = match std::fs::read(&journal_path) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => vec![],
            Err(e) => return Err(Error::io(&journal_path, "reading the journal", e)),
        };
        let lengths_path = file(folder, LENGTHS);
        let mut lengths_file = Npz::open(&lengths_path)?;
        let lengths = whole_numbers(&mut lengths_file, &lengths_path)?;
        let offsets_path = file(folder, OFFSETS);
        let offsets = whole_numbers(&mut Npz::open(&offsets_path)?, &offsets_path)?;
        let damaged =
            |problem: String| Error::corrupt(folder, problem, "restore it from a copy, or rebuild the dataset");
        let mut rows = Rows::at(&lengths, &offsets).map_err(damaged)?;
        let recorded: Recorded = if lengths_file.has(RECORDED) {
            serde_json::from_slice(&lengths_file.member(RECORDED)?)
                .map_err(|e| damaged(format!("what {LENGTHS}.npz records is unreadable: {e}")))?
        } else if lengths_file.is_plain() {
            Recorded::default()
        } else {
            return Err(damaged(format!("{LENGTHS}.npz holds something that nobody writes")));
        };
        let in_files = usize::try_from(rows.total()).map_err(|e| damaged(e.to_string()))?;
        let (mut columns, left_out) = columns(folder, &recorded, in_files)?;
        let specs: Vec<&ColumnSpec> = columns.iter().map(|column| &column.spec).collect();
        let pending = journal::replay(&journal_path, &journal, &specs, lengths.len())?;
        let mut pending_constants = vec![];
        for Pending { rows: length, columns: tails, constants } in pending {
            rows.push(length);
            columns.iter_mut().zip(tails).for_each(|(column, tail)| column.tail.extend(tail));
            pending_constants.push(constants);
        }
        Ok(Self { folder: folder.to_owned(), rows, recorded, columns, left_out, pending_constants })
    }

    /// The episodes and their rows.
    pub const fn rows(&self) -> &Rows {
        &self.rows
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The columns of numbers.
    pub fn columns(&self) -> impl Iterator<Item = &ColumnSpec> {
        self.columns.iter().map(|column| &column.spec)
    }

    /// All columns as the writer was given them, pictures included; none where another program wrote them.
    pub const fn recorded(&self) -> Option<&Schema> {
        self.recorded.schema.as_ref()
    }

    /// What readers see: the numbering, then numbers and `pictures` in the order that was recorded, else by name.
    ///
    /// # Errors
    /// When two columns share a name.
    pub fn schema(&self, pictures: Vec<ColumnSpec>) -> Result<Schema> {
        let known = self.recorded().map(Schema::columns).unwrap_or_default();
        let all: Vec<ColumnSpec> = self.columns().cloned().chain(pictures).collect();
        let numbers = numbering(if known.is_empty() { &all } else { known });
        let mut columns: Vec<ColumnSpec> = all.into_iter().filter(|c| c.name != EPISODE && c.name != STEP).collect();
        let place = |column: &ColumnSpec| known.iter().position(|k| k.name == column.name).unwrap_or(known.len());
        columns.sort_by(|a, b| place(a).cmp(&place(b)).then_with(|| a.name.cmp(&b.name)));
        columns.splice(0..0, numbers);
        Schema::new(columns)
    }

    /// Whether the numbers of this column are here.
    pub fn has(&self, name: &str) -> bool {
        self.columns().any(|column| column.name == name) || name == EPISODE || name == STEP
    }

    /// The rows of some ranges of a column of numbers, or of the numbering.
    ///
    /// # Errors
    /// As [`Reader::read_column`](crate::Reader::read_column).
    pub fn read(&self, spec: &ColumnSpec, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        if spec.name == EPISODE || spec.name == STEP {
            return self.rows.number(spec, ranges, out);
        }
        Rows::check_room(spec, ranges, out)?;
        let data = self.data(&spec.name)?;
        let size = spec.row_bytes();
        let mut rest = out;
        for range in ranges {
            let rows = self.rows.range(range)?;
            let (place, after) = rest.split_at_mut(range.length * size);
            // The rows are below the column's, which are a `usize`.
            #[allow(clippy::cast_possible_truncation)]
            place.copy_from_slice(&data[rows.start as usize * size..rows.end as usize * size]);
            rest = after;
        }
        Ok(())
    }

    /// All rows of a column of numbers.
    ///
    /// # Errors
    /// When there is no such column, or its file is damaged.
    pub fn data(&self, name: &str) -> Result<&[u8]> {
        let column = self.column(name)?;
        if let Some(data) = column.data.get() {
            return Ok(data);
        }
        let mut data = self.in_file(name)?;
        data.extend(&column.tail);
        Ok(column.data.get_or_init(|| data))
    }

    /// The committed rows of a column that are in its file.
    pub(super) fn in_file(&self, name: &str) -> Result<Vec<u8>> {
        let column = self.column(name)?;
        if column.in_file == 0 {
            return Ok(vec![]);
        }
        let path = file(&self.folder, name);
        let (header, mut data) = Npz::open(&path)?.array()?;
        if header.spec(name).as_ref() != Some(&column.spec) || header.rows() < column.in_file {
            return Err(Error::corrupt(path, "it changed since the dataset was opened", "open the dataset again"));
        }
        data.truncate(column.in_file * column.spec.row_bytes());
        Ok(data)
    }

    fn column(&self, name: &str) -> Result<&Column> {
        self.columns.iter().find(|column| column.spec.name == name).ok_or_else(|| {
            Error::unknown("column", name, self.columns().map(|c| c.name.as_str()), "it is none of numbers")
        })
    }

    /// Where the data come from.
    pub fn manifest(&self) -> Option<Manifest> {
        self.recorded.manifest.clone()
    }

    /// The constants of an episode.
    ///
    /// # Errors
    /// When they are damaged.
    pub fn constants(&self, episode: usize) -> Result<Constants> {
        let in_file = self.rows.episodes().len() - self.pending_constants.len();
        if let Some(pending) = episode.checked_sub(in_file).and_then(|i| self.pending_constants.get(i)) {
            return Ok(pending.clone());
        }
        let Some(named) = self.recorded.constants.get(episode).filter(|named| !named.is_empty()) else {
            return Ok(Constants::new());
        };
        let mut lengths = Npz::open(&file(&self.folder, LENGTHS))?;
        named.iter().map(|(name, &index)| Ok((name.clone(), lengths.member(&constant_member(index))?))).collect()
    }

    /// Columns in files that hold no numbers.
    pub(super) fn left_out(&self) -> &[String] {
        &self.left_out
    }

    /// The constants in `ep_len.npz`, in the order of its members.
    pub(super) fn stored_constants(&self) -> Result<Vec<Vec<u8>>> {
        let count = self.recorded.constants.iter().flat_map(BTreeMap::values).max().map_or(0, |last| last + 1);
        let mut lengths = Npz::open(&file(&self.folder, LENGTHS))?;
        (0..count).map(|index| lengths.member(&constant_member(index))).collect()
    }

    /// Names of the constants that are in `ep_len.npz`, and the members that hold them.
    pub(super) fn constants_in_file(&self) -> &[BTreeMap<String, usize>] {
        &self.recorded.constants
    }

    /// How many episodes are in the files.
    pub(super) fn episodes_in_files(&self) -> usize {
        self.rows.episodes().len() - self.pending_constants.len()
    }

    /// What takes how many bytes, largest first: columns, subfolders included, and the rest.
    ///
    /// # Errors
    /// When the folder cannot be listed.
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

/// Bytes of all files in a folder of pictures.
fn folder_size(folder: &Path) -> Result<u64> {
    let io = |e| Error::io(folder, "listing the folder", e);
    std::fs::read_dir(folder)
        .map_err(io)?
        .map(|entry| entry.and_then(|entry| entry.metadata()).map(|metadata| metadata.len()).map_err(io))
        .sum()
}

/// The columns of numbers: those recorded, else whatever files of numbers there are. And the names of files without.
fn columns(folder: &Path, recorded: &Recorded, rows: usize) -> Result<(Vec<Column>, Vec<String>)> {
    let names: Vec<String> = match &recorded.schema {
        Some(schema) => schema.columns().iter().filter(|c| !c.is_image()).map(|c| c.name.clone()).collect(),
        None => names_of_files(folder)?,
    };
    let (mut columns, mut left_out) = (vec![], vec![]);
    for name in names {
        super::check_name(&name)?;
        let path = file(folder, &name);
        let known = recorded.schema.as_ref().and_then(|schema| schema.column(&name).ok());
        let mut spec = known.cloned();
        // Of a dataset without committed rows, columns need not be there yet.
        if rows > 0 || known.is_none() {
            let header = Npz::open(&path)?.header()?;
            let Some(found) = header.spec(&name).filter(|spec| !spec.is_empty()) else {
                left_out.push(name);
                continue;
            };
            let problem = if known.is_some_and(|known| *known != found) {
                format!("it holds {} {:?}, unlike recorded", found.dtype.name(), found.shape)
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
            columns.push(Column { spec, in_file: rows, tail: vec![], data: OnceLock::new() });
        }
    }
    Ok((columns, left_out))
}

/// The columns of a folder that another program wrote, by name.
fn names_of_files(folder: &Path) -> Result<Vec<String>> {
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

/// The array of an archive, as whole numbers.
fn whole_numbers(npz: &mut Npz, path: &Path) -> Result<Vec<i64>> {
    let (header, bytes) = npz.array()?;
    match header.spec("").filter(|_| header.shape.len() == 1).map(|spec| spec.dtype) {
        Some(DType::Int32) => Ok(bytes.as_chunks().0.iter().map(|&b| i64::from(i32::from_ne_bytes(b))).collect()),
        Some(DType::Int64) => Ok(bytes.as_chunks().0.iter().map(|&b| i64::from_ne_bytes(b)).collect()),
        _ => Err(Error::corrupt(path, "it holds no list of whole numbers", "rebuild the dataset")),
    }
}
