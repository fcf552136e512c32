//! Reads the episodes of an HDF5 file.

use super::column::Column;
use super::layout::{self, LENGTHS, OFFSETS};
use super::links::Contents;
use super::record::Record;
use super::source::Source;
use super::structure::catch_panic;
use super::table;
use super::unchanged::{Seen, Unchanged};
use crate::dataset::Location;
use crate::dataset::episodes::{EpisodeRows, content_hash, index_columns};
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, Error, Manifest, Result, Schema};

/// Number of rows that are read together for the content hash.
const ROWS_PER_READ: usize = 64;

/// Opens a file.
pub(super) fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    let location = super::file(location)?;
    if let Some(path) = location.path().filter(|path| super::is_unfinished(path)) {
        let problem = "is being created: its writer has not finished its first bytes, or was killed before it did";
        return Err(Error::corrupt(path, problem, "open it again in a moment; if no writer runs, collect it again"));
    }
    Ok(Arc::new(Hdf5Reader::open(&location)?))
}

pub(super) struct Hdf5Reader {
    source: Source,
    unchanged: Unchanged,
    rows: EpisodeRows,
    schema: Schema,
    columns: Vec<Column>,
    record: Record,
    /// Names of datasets that are not numeric.
    non_numeric: Vec<String>,
    /// Names of groups, whose datasets are not read; none in files of this module.
    groups: Vec<String>,
    /// Names of soft links.
    links: Vec<String>,
}

impl Hdf5Reader {
    /// Opens a local or remote file.
    pub fn open(location: &Location) -> Result<Self> {
        Self::of(Source::open(location)?)
    }

    /// Reads the structure of a file.
    pub fn of(source: Source) -> Result<Self> {
        let unchanged = Unchanged::new(&source);
        let damaged = |problem: String| damaged(&source, problem);
        let file = catch_panic("opening the file as HDF5", || hdf5_pure::File::from_source(source.clone()))
            .map_err(damaged)?;
        let contents = Contents::read(&file, &source).map_err(damaged)?;
        let names = &contents.datasets;
        let record = layout::record(&source).map_err(damaged)?;
        let record = record.map(|found| table::read_all(&found, &source)).transpose();
        let record = record.map_err(|e| damaged(format!("the record of the dataset is unreadable: {e}")))?;
        let column = |name: &str| {
            let dataset = catch_panic("reading its header", || file.dataset(name));
            let column = dataset.and_then(|dataset| Column::new(name, dataset, source.size()));
            let mut column = column.map_err(|problem| damaged(format!("column '{name}': {problem}")))?;
            column.iter_mut().for_each(|column| column.written_here = record.is_some());
            Ok(column)
        };
        let counts = |name: &str| -> Result<Vec<i64>> {
            let missing = || damaged(contents.lacks(name));
            if !names.iter().any(|known| known == name) {
                return Err(missing());
            }
            let found = column(name)?.filter(|column| column.spec.shape.is_empty()).ok_or_else(missing)?;
            let bytes = found.read_all(&source).map_err(|problem| damaged(format!("'{name}': {problem}")))?;
            match found.spec.dtype {
                DType::Int32 => Ok(bytes.as_chunks().0.iter().map(|&b| i32::from_ne_bytes(b).into()).collect()),
                DType::Int64 => Ok(bytes.as_chunks().0.iter().map(|&b| i64::from_ne_bytes(b)).collect()),
                _ => Err(missing()),
            }
        };
        let rows = EpisodeRows::from_lengths(&counts(LENGTHS)?, &counts(OFFSETS)?).map_err(damaged)?;
        let (mut columns, mut non_numeric) = (vec![], vec![]);
        for name in names.iter().filter(|name| *name != LENGTHS && *name != OFFSETS) {
            let Some(column) = column(name)? else {
                non_numeric.push(name.clone());
                continue;
            };
            if column.rows < rows.total() {
                let problem =
                    format!("column '{name}' has {} rows, but its episodes have {}", column.rows, rows.total());
                return Err(damaged(problem));
            }
            columns.push(column);
        }
        let record = match record {
            Some(bytes) => Record::parse(bytes, rows.episodes().len()).map_err(damaged)?,
            None => Record::default(),
        };
        for written in record.schema.iter().flat_map(Schema::columns) {
            let same = |column: &&Column| column.spec == *written && column.is_plain();
            if !columns.iter().any(|column| same(&column)) {
                let differs = format!("column '{}' differs from the record, or is missing", written.name);
                return Err(damaged(contents.link(&written.name).unwrap_or(differs)));
            }
        }
        let schema = sorted(&mut columns, &record)?;
        let groups = match record.schema {
            Some(_) => vec![],
            None => contents.groups(&file).map_err(damaged)?,
        };
        Ok(Self { source, unchanged, rows, schema, columns, record, non_numeric, groups, links: contents.links })
    }

    /// First row and length of every episode.
    pub const fn rows(&self) -> &EpisodeRows {
        &self.rows
    }

    /// The metadata that this format's writer stored in the file.
    pub const fn record(&self) -> &Record {
        &self.record
    }

    /// The columns of the file, in the order of the schema.
    pub fn stored(&self) -> Vec<ColumnSpec> {
        self.columns.iter().map(|column| column.spec.clone()).collect()
    }

    /// Reads stored rows of a column.
    fn read_rows(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let spec = self.schema.column(name)?;
        let Some(column) = self.columns.iter().find(|column| column.spec.name == name) else {
            return Err(self.fail(name, "it does not exist"));
        };
        let mut slots = self.rows.row_slots(spec, ranges, out)?;
        let first = self.rows.first_rows();
        if !self.rows.is_contiguous() {
            slots.sort_by_key(|&((episode, step), _)| first[episode] + step as u64);
        }
        let row_of = |(episode, step): (usize, usize)| first[episode] + step as u64;
        column.read(&self.source, &mut slots, row_of).map_err(|problem| self.fail(name, &problem))
    }

    /// Whether the file, which was written to, holds this dataset and what a writer of this format appended. `seen` has rows that
    /// were read before.
    fn grew(&self, seen: &Seen) -> bool {
        let Ok(now) = self.source.with_present_size().and_then(Self::of) else { return false };
        let same_row = |(column, (range, row)): (&String, &(StepRange, Vec<u8>))| {
            let mut found = vec![0; row.len()];
            now.read_rows(column, &[*range], &mut found).is_ok() && found == *row
        };
        now.record.continues(&self.record) && now.episodes().starts_with(self.episodes()) && seen.iter().all(same_row)
    }

    fn fail(&self, column: &str, problem: &str) -> Error {
        damaged(&self.source, format!("column '{column}': {problem}"))
    }
}

fn damaged(source: &Source, problem: String) -> Error {
    Error::corrupt(source.label(), problem, "restore it from a copy, or convert the columns that h5py can read")
}

/// Sorts the columns: those of the record in its order, then the others by name. Returns their schema.
fn sorted(columns: &mut [Column], record: &Record) -> Result<Schema> {
    let known = record.schema.as_ref().map(Schema::columns).unwrap_or_default();
    let position = |column: &Column| known.iter().position(|k| k.name == column.spec.name).unwrap_or(known.len());
    columns.sort_by(|a, b| position(a).cmp(&position(b)).then_with(|| a.spec.name.cmp(&b.spec.name)));
    let specs: Vec<ColumnSpec> = columns.iter().map(|column| column.spec.clone()).collect();
    let data = specs.iter().filter(|spec| spec.name != EPISODE_IDX && spec.name != STEP_IDX).cloned();
    Schema::new(index_columns(&specs).into_iter().chain(data).collect::<Vec<_>>())
}

impl Reader for Hdf5Reader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        self.rows.episodes()
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let spec = self.schema.column(name)?;
        if name == EPISODE_IDX || name == STEP_IDX {
            return self.rows.fill_index_column(spec, ranges, out);
        }
        let read = self.read_rows(name, ranges, out);
        // Rows that could not be read are no rows that were seen.
        let ranges = if read.is_ok() { ranges } else { &[] };
        self.unchanged.check(&self.source, (name, ranges, out), |seen| self.grew(seen)).and(read)
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        Ok(self.record.constants(episode))
    }

    /// Reports episodes that share rows, and stored step indices that differ from the positions in the episode.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let mut found = vec![];
        let mut order: Vec<usize> = (0..self.episodes().len()).collect();
        order.sort_by_key(|&episode| self.rows.first_rows()[episode]);
        for pair in order.windows(2) {
            if self.rows.first_rows()[pair[0]] + self.episodes()[pair[0]].length as u64
                > self.rows.first_rows()[pair[1]]
            {
                let what = format!("some of its rows also belong to episode {}", pair[0]);
                found.push(Irregularity { episode: Some(pair[1]), what });
            }
        }
        let Some(column) = self.columns.iter().find(|column| column.spec.name == STEP_IDX && column.spec.len() == 1)
        else {
            return Ok(found);
        };
        let mut steps = Batch::zeros(&Schema::new([column.spec.clone()])?, 0);
        let row_of = |(episode, step): (usize, usize)| self.rows.first_rows()[episode] + step as u64;
        for (position, episode) in self.episodes().iter().enumerate() {
            steps.try_resize(episode.length)?;
            let range = [StepRange::new(position, 0, episode.length)];
            let mut slots = self.rows.row_slots(&column.spec, &range, steps.bytes_mut(0))?;
            column.read(&self.source, &mut slots, row_of).map_err(|problem| self.fail(STEP_IDX, &problem))?;
            if let Some((row, step)) =
                steps.to_f32(STEP_IDX)?.into_iter().enumerate().find(|&(row, step)| step != row as f32)
            {
                let what = format!("the stored steps do not count up from 0: row {row} holds {step}");
                found.push(Irregularity { episode: Some(position), what });
            }
        }
        Ok(found)
    }

    fn sources(&self) -> Vec<PathBuf> {
        vec![self.source.label().to_owned()]
    }

    fn unread(&self) -> Vec<String> {
        let groups = self.groups.iter().map(|group| format!("{group}/"));
        let links = self.links.iter().map(|link| format!("{link} (a soft link)"));
        self.non_numeric.iter().cloned().chain(links).chain(groups).collect()
    }

    fn manifest(&self) -> Option<Manifest> {
        self.record.manifest.clone()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut parts = vec![];
        for column in &self.columns {
            let size = column.footprint(&self.source).map_err(|problem| self.fail(&column.spec.name, &problem))?;
            parts.push((column.spec.name.clone(), size));
        }
        let known: u64 = parts.iter().map(|(_, size)| size).sum();
        parts.push(("(structure of the file)".to_owned(), self.source.size().saturating_sub(known)));
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }

    fn content_hash(&self) -> Result<String> {
        content_hash(&self.rows, &self.schema.columns()[2..], |column, add| {
            let mut bytes = vec![];
            for (position, episode) in self.rows.episodes().iter().enumerate() {
                for start in (0..episode.length).step_by(ROWS_PER_READ) {
                    let length = ROWS_PER_READ.min(episode.length - start);
                    bytes.resize(length * column.row_bytes(), 0);
                    self.read_column(&column.name, &[StepRange::new(position, start, length)], &mut bytes)?;
                    bytes.chunks_exact(column.row_bytes()).for_each(&mut *add);
                }
            }
            Ok(())
        })
    }
}
