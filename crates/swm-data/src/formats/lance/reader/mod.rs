//! Reading episodes: all ranges of a batch are sorted, merged and read together, pictures are decoded in
//! parallel into the batch.
//!
//! [`numbers`] and [`pictures`] say how; what is laid out unlike they expect, or does not fit, goes through Lance's
//! decoder ([`pieces`]). [`files`] opens data files and checks them.

mod files;
mod images;
mod pieces;
mod values;

use self::files::Recent;
use self::images::LaidOut;
use self::values::Numbers;
use super::convert::{blob, cast, whole_numbers};
use super::record::{CONSTANTS_KEY, ContentHash};
use super::schema::{self, EPISODE, Kind, STEP, StoredColumn};
use super::store::{Store, damaged};
use crate::dataset::Location;
use crate::dataset::objects::Blocks;
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use lance_file::reader::FileReader;
use lance_table::format::Manifest as Table;
use std::collections::{BTreeMap, HashMap, HashSet};
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::slice;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use swm_core::{Error, Manifest, Result, Schema};

/// Opens a table.
pub fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    Ok(Arc::new(LanceReader::open(location)?))
}

/// A table of episodes.
pub struct LanceReader {
    store: Store,
    table: Arc<Table>,
    schema: Schema,
    columns: Vec<StoredColumn>,
    episodes: Vec<Episode>,
    /// The first row of each episode, in the whole table.
    first_rows: Vec<u64>,
    /// The first row of each fragment, and the end.
    fragment_rows: Vec<u64>,
    files: Mutex<Recent<FileReader>>,
    /// Data files of this machine, open for reading.
    handles: Mutex<Recent<File>>,
    /// Where pictures are.
    places: Mutex<Places>,
    numbers: Mutex<Numbers>,
    /// What was fetched from an object store.
    blocks: Arc<Blocks>,
    /// Data files whose content was checked.
    verified: Mutex<HashSet<String>>,
}

/// By fragment and name of the column; `None` where pictures are laid out otherwise and Lance must look.
type Places = HashMap<(usize, String), Option<Arc<LaidOut>>>;

/// A row of the table, and the place in a batch that wants it.
type Wanted<'a> = (u64, &'a mut [u8]);

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // What is guarded is valid at every step, so a thread that panicked did no harm.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl LanceReader {
    /// Opens a table.
    ///
    /// # Errors
    /// When there is none, or it is damaged.
    pub fn open(location: &Location) -> Result<Self> {
        let store = Store::new(location)?;
        let Some(version) = store.latest()? else {
            let there = store.remote || store.label.is_dir();
            let problem = if there { "it holds no Lance table" } else { "there is no such dataset" };
            return Err(Error::corrupt(&store.label, problem, "check the path; `swm datasets` lists those at home"));
        };
        Self::of(store, version.manifest)
    }

    /// The table in one of its versions.
    ///
    /// # Errors
    /// When it is damaged.
    pub fn of(store: Store, table: Arc<Table>) -> Result<Self> {
        let label = store.label.clone();
        let mut fragment_rows = vec![0];
        for fragment in table.fragments.iter() {
            if fragment.deletion_file.is_some() {
                return Err(Error::corrupt(
                    &label,
                    "some of its rows are marked as deleted",
                    "compact it first (in Python: lance.dataset(path).optimize.compact_files())",
                ));
            }
            let rows = fragment.physical_rows.ok_or_else(|| damaged(&label, "a fragment has no row count"))?;
            let last: u64 = fragment_rows[fragment_rows.len() - 1];
            fragment_rows.push(last.saturating_add(rows as u64));
        }
        let files = table.fragments.iter().flat_map(|fragment| &fragment.files);
        let total = files.filter_map(|file| file.file_size_bytes.get()).map(|size| size.get()).sum();
        let (files, handles) = (Recent::new(&store), Recent::new(&store));
        let mut reader = Self {
            blocks: Arc::new(Blocks::new(total)),
            store,
            table,
            schema: Schema::new([])?,
            columns: vec![],
            episodes: vec![],
            first_rows: vec![],
            fragment_rows,
            files: Mutex::new(files),
            handles: Mutex::new(handles),
            places: Mutex::default(),
            numbers: Mutex::default(),
            verified: Mutex::default(),
        };
        let (columns, schema) = schema::columns_to_read(&label, &reader.table.schema, |column| {
            let pieces = reader.pieces(column, slice::from_ref(&(0..1.min(reader.rows()))))?;
            pieces.first().map(|piece| blob(&piece.values, 0).map(<[u8]>::to_vec)).transpose()
        })?;
        (reader.columns, reader.schema) = (columns, schema);
        reader.find_episodes()?;
        Ok(reader)
    }

    /// The number of the next episode.
    pub fn next_episode(&self) -> i64 {
        self.episodes.last().map_or(0, |episode| episode.index + 1)
    }

    fn folder(&self) -> &Path {
        &self.store.label
    }

    fn rows(&self) -> u64 {
        self.fragment_rows[self.fragment_rows.len() - 1]
    }

    /// The fragment that holds a row.
    fn fragment_of(&self, row: u64) -> usize {
        self.fragment_rows.partition_point(|&first| first <= row) - 1
    }

    /// Reads where episodes begin and end.
    fn find_episodes(&mut self) -> Result<()> {
        let mut row = 0;
        let mut episodes: Vec<Episode> = vec![];
        for piece in self.pieces(EPISODE, slice::from_ref(&(0..self.rows())))? {
            let mut indices = vec![0_i64; piece.rows];
            whole_numbers(&piece.values, &mut indices)?;
            for index in indices {
                match episodes.last_mut() {
                    Some(episode) if episode.index == index => episode.length += 1,
                    Some(episode) if episode.index > index => {
                        return Err(Error::corrupt(
                            self.folder(),
                            format!("episode {index} comes after episode {} in row {row}", episode.index),
                            "rows of an episode must follow each other, episodes in rising order; rebuild the dataset",
                        ));
                    }
                    _ => {
                        episodes.push(Episode { index, length: 1 });
                        self.first_rows.push(row);
                    }
                }
                row += 1;
            }
        }
        self.episodes = episodes;
        Ok(())
    }

    /// The column of that name, by our name or its name in the table.
    fn column(&self, name: &str) -> Result<&StoredColumn> {
        let index = self.schema.index(name)?;
        Ok(&self.columns[index - 2])
    }

    /// The rows of a range in the whole table.
    fn table_rows(&self, range: &StepRange) -> Result<Range<u64>> {
        match self.episodes.get(range.episode) {
            Some(episode) if range.start + range.length <= episode.length => {
                let first = self.first_rows[range.episode] + range.start as u64;
                Ok(first..first + range.length as u64)
            }
            Some(episode) => Err(Error::mismatch(
                "reading rows",
                format!("rows {}..{} of episode {}", range.start, range.start + range.length, range.episode),
                format!("rows below {}", episode.length),
            )),
            None => Err(Error::mismatch(
                "reading rows",
                format!("the episode in position {}", range.episode),
                format!("positions below {}", self.episodes.len()),
            )),
        }
    }

    /// `episode_idx` or `step_idx`, which need no reading.
    fn numbering(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let mut values = vec![];
        for range in ranges {
            self.table_rows(range)?;
            let index = self.episodes[range.episode].index;
            values.extend((range.start..range.start + range.length).map(|step| match name {
                EPISODE => index,
                #[allow(clippy::cast_possible_wrap)]
                _ => step as i64,
            }));
        }
        let dtype = self.schema.column(name)?.dtype;
        self.check_length(name, values.len(), out)?;
        cast(values.into_iter(), dtype, out);
        Ok(())
    }

    fn check_length(&self, name: &str, rows: usize, out: &[u8]) -> Result<()> {
        let expected = rows * self.schema.column(name)?.row_bytes();
        if out.len() == expected {
            return Ok(());
        }
        Err(Error::mismatch(
            format!("reading column '{name}'"),
            format!("room for {} bytes", out.len()),
            format!("{expected} for {rows} rows"),
        ))
    }
}

impl Reader for LanceReader {
    fn schema(&self) -> &Schema {
        &self.schema
    }

    fn episodes(&self) -> &[Episode] {
        &self.episodes
    }

    fn read_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        if name == EPISODE || name == STEP {
            return self.numbering(name, ranges, out);
        }
        let column = self.column(name)?;
        let rows: usize = ranges.iter().map(|range| range.length).sum();
        self.check_length(name, rows, out)?;
        // Every wanted row with its place in `out`, in the order of the table.
        let mut wanted: Vec<Wanted> = Vec::with_capacity(rows);
        let mut places = out.chunks_exact_mut(column.spec.row_bytes());
        for range in ranges {
            wanted.extend(self.table_rows(range)?.zip(places.by_ref()));
        }
        wanted.sort_by_key(|(row, _)| *row);
        match column.kind {
            Kind::Numbers(_) => self.read_numbers(column, &mut wanted),
            Kind::Image => self.read_pictures(column, &mut wanted),
        }
    }

    /// Steps are numbered by their places here; what is stored should say the same. Where two episodes were written under one
    /// number, it does not.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let mut found = vec![];
        if self.table.schema.field(STEP).is_none() {
            return Ok(found);
        }
        let (mut episode, mut expected, mut sound) = (0, 0, true);
        for piece in self.pieces(STEP, slice::from_ref(&(0..self.rows())))? {
            let mut steps = vec![0_i64; piece.rows];
            whole_numbers(&piece.values, &mut steps)?;
            for step in steps {
                if step != expected && sound {
                    let what = format!("the stored steps do not count up from 0: {step} stands in row {expected}");
                    found.push(Irregularity { episode: Some(episode), what });
                    sound = false;
                }
                expected += 1;
                #[allow(clippy::cast_possible_wrap)]
                if expected == self.episodes[episode].length as i64 {
                    (episode, expected, sound) = (episode + 1, 0, true);
                }
            }
        }
        Ok(found)
    }

    fn manifest(&self) -> Option<Manifest> {
        schema::manifest(&self.table.schema)
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        let mut columns: BTreeMap<String, u64> = BTreeMap::new();
        for i in 0..self.table.fragments.len() {
            for field in &self.table.schema.fields {
                let Ok((file, projection)) = self.locate(i, &field.name) else { continue };
                let statistics = file.file_statistics();
                let bytes = projection.column_indices.iter().filter_map(|&c| statistics.columns.get(c as usize));
                *columns.entry(field.name.clone()).or_default() += bytes.map(|c| c.size_bytes).sum::<u64>();
            }
        }
        let known: u64 = columns.values().sum();
        let whole = if self.store.lists { self.store.list("")?.iter().map(|file| file.size).sum() } else { known };
        let rest = whole.saturating_sub(known);
        let mut parts: Vec<(String, u64)> = columns.into_iter().collect();
        parts.push(("(versions and file metadata)".to_owned(), rest));
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        let Some(&row) = self.first_rows.get(episode) else {
            let problem = format!("the episode in position {episode}");
            return Err(Error::mismatch(
                "reading constants",
                problem,
                format!("positions below {}", self.episodes.len()),
            ));
        };
        let fragment = self.fragment_of(row);
        let Some((reader, record)) = self.record(fragment)? else { return Ok(Constants::new()) };
        let Some(values) = self.buffer(&reader, CONSTANTS_KEY)? else { return Ok(Constants::new()) };
        let position = episode - self.first_rows.partition_point(|&first| first < self.fragment_rows[fragment]);
        record.constants(position, &values).map_err(|problem| damaged(self.folder(), problem))
    }

    fn content_hash(&self) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        let mut add = |bytes: &[u8]| {
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        for column in &self.columns {
            add(schema::json(&column.spec)?.as_bytes());
        }
        let mut at = 0;
        for (fragment, rows) in self.fragment_rows.windows(2).enumerate() {
            let first = at;
            while at < self.episodes.len() && self.first_rows[at] < rows[1] {
                at += 1;
            }
            for (episode, hash) in self.episodes[first..at].iter().zip(self.hashes(fragment, first..at)?) {
                add(&episode.index.to_le_bytes());
                add(&(episode.length as u64).to_le_bytes());
                add(hash.as_bytes());
            }
        }
        Ok(hasher.finalize().to_hex().to_string())
    }
}

impl LanceReader {
    /// The hashes of a fragment's episodes: as recorded, where the fragment was written here, so that a large dataset
    /// need not be read for them.
    fn hashes(&self, fragment: usize, episodes: Range<usize>) -> Result<Vec<String>> {
        if let Some((_, record)) = self.record(fragment)? {
            let stored = self.episodes[episodes.clone()].iter().map(|episode| episode.length as u64);
            if stored.eq(record.episodes.iter().map(|episode| episode.rows)) {
                return Ok(record.episodes.into_iter().map(|episode| episode.hash).collect());
            }
        }
        episodes.map(|episode| self.hash_of(episode)).collect()
    }

    /// The hash of an episode, from all that is stored of it.
    fn hash_of(&self, episode: usize) -> Result<String> {
        let rows = self.table_rows(&StepRange::new(episode, 0, self.episodes[episode].length))?;
        let mut hash = ContentHash::new();
        for column in &self.columns {
            for piece in self.pieces(&column.name, slice::from_ref(&rows))? {
                hash.add(column, &piece.values).map_err(|problem| damaged(self.folder(), problem))?;
            }
        }
        Ok(hash.finish(&self.constants(episode)?))
    }
}

/// The ranges of rising rows.
fn merged(wanted: &[&mut Wanted]) -> Vec<Range<u64>> {
    let mut merged: Vec<Range<u64>> = vec![];
    for &&mut (row, _) in wanted {
        match merged.last_mut() {
            Some(range) if row < range.end => {}
            Some(range) if row == range.end => range.end += 1,
            _ => merged.push(row..row + 1),
        }
    }
    merged
}
