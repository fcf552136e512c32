//! Reads episodes: sorts and merges the ranges of a batch, reads them together, and decodes images in parallel.
//!
//! - [`values`]: numeric columns, cached per fragment; [`images`]: images, read directly from their locations.
//! - [`stored_rows`]: reads of all other data, with Lance's decoder.
//! - [`files`]: opens and verifies data files.
//! - [`lance_reader`]: the state of an open table.

mod files;
#[cfg(test)]
mod hostile;
mod images;
mod lance_reader;
mod stored_rows;
mod values;

pub use self::lance_reader::LanceReader;

use self::lance_reader::{RecentFiles, RowSlot};
use super::convert::{image_bytes, integers};
use super::errors::damaged;
use super::record::{CONSTANTS_KEY, ContentHash};
use super::schema::{self, Kind, StoredColumn};
use super::store::{self, Store};
use crate::dataset::Location;
use crate::dataset::objects::BlockCache;
use crate::dataset::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::formats::cast::cast;
use lance_table::format::{DataFile, Manifest as Table};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::PathBuf;
use std::slice;
use std::sync::{Arc, Mutex};
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{Error, Manifest, Result, Schema};

/// The most rows that are read at a time: each takes memory beside its bytes, and a small file can hold many equal rows.
const PIECE_ROWS: usize = 1 << 20;

/// Opens a table.
pub fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    Ok(Arc::new(LanceReader::open(location)?))
}

impl LanceReader {
    /// Opens the newest version of a table.
    ///
    /// # Errors
    /// If there is no table, or the table is damaged.
    pub fn open(location: &Location) -> Result<Self> {
        let store = Store::new(location)?;
        store.with_latest(|found| match found {
            Some(version) => Self::of(store.clone(), version.manifest),
            None => {
                let exists = store.remote || store.label.is_dir();
                let problem = if exists { "it holds no Lance table" } else { "there is no such dataset" };
                let fix = "check the path; `swm datasets` lists the stored datasets";
                Err(Error::corrupt(&store.label, problem, fix))
            }
        })
    }

    /// Opens a version of a table.
    ///
    /// # Errors
    /// If the table is damaged.
    pub fn of(store: Store, table: Arc<Table>) -> Result<Self> {
        let label = store.label.clone();
        let mut fragment_rows = vec![0];
        for fragment in table.fragments.iter() {
            if fragment.deletion_file.is_some() {
                return Err(Error::corrupt(
                    &label,
                    "some rows of the table are marked as deleted",
                    "compact the table first (in Python: lance.dataset(path).optimize.compact_files())",
                ));
            }
            if fragment.files.iter().any(|file| file.base_id.is_some()) {
                return Err(Error::corrupt(
                    &label,
                    "the table is a shallow clone, whose data files are those of another table",
                    "open the other table, or copy it as a whole",
                ));
            }
            let rows = fragment.physical_rows.ok_or_else(|| damaged(&label, "a fragment has no row count"))?;
            let last: u64 = fragment_rows[fragment_rows.len() - 1];
            fragment_rows.push(last.saturating_add(rows as u64));
        }
        let files = table.fragments.iter().flat_map(|fragment| &fragment.files);
        let total = files.filter_map(|file| file.file_size_bytes.get()).map(|size| size.get()).sum();
        let (files, handles) = (RecentFiles::new(&store), RecentFiles::new(&store));
        let mut reader = Self {
            blocks: Arc::new(BlockCache::new(total)),
            store,
            table,
            schema: Schema::new([])?,
            columns: vec![],
            episodes: vec![],
            first_rows: vec![],
            fragment_rows,
            files: Mutex::new(files),
            handles: Mutex::new(handles),
            image_locations: Mutex::default(),
            value_cache: Mutex::default(),
            verified: Mutex::default(),
        };
        let (columns, schema) = schema::columns_to_read(&label, &reader.table.schema, |column| {
            let stored = reader.stored_rows(column, slice::from_ref(&(0..1.min(reader.rows()))))?;
            stored.first().map(|rows_read| image_bytes(&rows_read.values, 0).map(<[u8]>::to_vec)).transpose()
        })?;
        (reader.columns, reader.schema) = (columns, schema);
        reader.find_episodes()?;
        Ok(reader)
    }

    /// The next free `episode_idx`.
    pub fn next_episode(&self) -> i64 {
        self.episodes.last().map_or(0, |episode| episode.index + 1)
    }

    /// Reads `episode_idx` and derives the episodes and their first rows.
    fn find_episodes(&mut self) -> Result<()> {
        let mut row = 0;
        let mut episodes: Vec<Episode> = vec![];
        for piece in pieces_of_rows(self.rows()) {
            for rows_read in self.stored_rows(EPISODE_IDX, slice::from_ref(&piece))? {
                let mut indices = vec![0_i64; rows_read.rows];
                integers(&rows_read.values, &mut indices)?;
                for index in indices {
                    match episodes.last_mut() {
                        Some(episode) if episode.index == index => episode.length += 1,
                        Some(episode) if episode.index > index => {
                            return Err(Error::corrupt(
                                self.folder(),
                                format!("episode {index} comes after episode {} in row {row}", episode.index),
                                "rows of an episode must be consecutive, and episodes must be in ascending order; rebuild the dataset",
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
        }
        self.episodes = episodes;
        Ok(())
    }

    /// The stored column with this name in the schema.
    fn column(&self, name: &str) -> Result<&StoredColumn> {
        let index = self.schema.index(name)?;
        Ok(&self.columns[index - 2])
    }

    /// The rows of a range, counted over the table.
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
                format!("episode position {}", range.episode),
                format!("positions below {}", self.episodes.len()),
            )),
        }
    }

    /// Computes `episode_idx` or `step_idx` without reading the table.
    fn read_index_column(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let mut values = vec![];
        for range in ranges {
            self.table_rows(range)?;
            let index = self.episodes[range.episode].index;
            values.extend((range.start..range.start + range.length).map(|step| match name {
                EPISODE_IDX => index,
                _ => step as i64,
            }));
        }
        let dtype = self.schema.column(name)?.dtype;
        self.check_length(name, values.len(), out)?;
        cast(values.into_iter(), dtype, out)
            .map_err(|problem| damaged(self.folder(), format!("column '{name}': {problem}")))
    }

    fn check_length(&self, name: &str, rows: usize, out: &[u8]) -> Result<()> {
        let expected = rows * self.schema.column(name)?.row_bytes();
        if out.len() == expected {
            return Ok(());
        }
        Err(Error::mismatch(
            format!("reading column '{name}'"),
            format!("an output of {} bytes", out.len()),
            format!("{expected} for {rows} rows"),
        ))
    }

    /// The constants of an episode, which is in this fragment.
    fn stored_constants(&self, episode: usize, fragment: usize) -> Result<Constants> {
        let Some((reader, record)) = self.record(fragment)? else { return Ok(Constants::new()) };
        let Some(values) = self.buffer(&reader, CONSTANTS_KEY)? else { return Ok(Constants::new()) };
        let position = episode - self.first_rows.partition_point(|&first| first < self.fragment_rows[fragment]);
        record.constants(position, &values).map_err(|problem| damaged(self.folder(), problem))
    }

    /// Reads rows of a column that is no index column, as [`Reader::read_column`] does.
    fn read_rows(&self, name: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        let column = self.column(name)?;
        let rows: usize = ranges.iter().map(|range| range.length).sum();
        self.check_length(name, rows, out)?;
        if rows > PIECE_ROWS {
            let mut rest = out;
            for piece in pieces(ranges) {
                let rows: usize = piece.iter().map(|range| range.length).sum();
                let (now, after) = rest.split_at_mut(rows * column.spec.row_bytes());
                self.read_rows(name, &piece, now)?;
                rest = after;
            }
            return Ok(());
        }
        // Every requested row with its bytes in `out`, sorted by row.
        let mut requested: Vec<RowSlot> = Vec::with_capacity(rows);
        let mut slots = out.chunks_exact_mut(column.spec.row_bytes());
        for range in ranges {
            requested.extend(self.table_rows(range)?.zip(slots.by_ref()));
        }
        requested.sort_by_key(|(row, _)| *row);
        match column.kind {
            Kind::Values(_) => self.read_values(column, &mut requested),
            Kind::Image => self.read_images(column, &mut requested),
        }
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
        if name == EPISODE_IDX || name == STEP_IDX {
            return self.read_index_column(name, ranges, out);
        }
        self.read_rows(name, ranges, out).map_err(|error| self.explained(error))
    }

    /// Compares data files in an object store with the hashes in their names (local ones are verified when they are read), the content
    /// hash that is stated of each episode with its values, and the stored `step_idx` with the position in the episode. The latter
    /// two differ if two episodes were written with the same index.
    fn irregularities(&self) -> Result<Vec<Irregularity>> {
        let mut found = self.false_files()?;
        found.extend(self.false_hashes()?);
        if self.table.schema.field(STEP_IDX).is_none() {
            return Ok(found);
        }
        let (mut episode, mut expected, mut valid) = (0, 0, true);
        for piece in pieces_of_rows(self.rows()) {
            for rows_read in self.stored_rows(STEP_IDX, slice::from_ref(&piece))? {
                let mut steps = vec![0_i64; rows_read.rows];
                integers(&rows_read.values, &mut steps)?;
                for step in steps {
                    if step != expected && valid {
                        let what = format!("the stored steps do not count up from 0: row {expected} holds {step}");
                        found.push(Irregularity { episode: Some(episode), what });
                        valid = false;
                    }
                    expected += 1;
                    if expected == self.episodes[episode].length as i64 {
                        (episode, expected, valid) = (episode + 1, 0, true);
                    }
                }
            }
        }
        Ok(found)
    }

    fn check_files(&self) -> Result<()> {
        match self.false_names()?.first() {
            Some((_, name)) => Err(damaged(&self.folder().join("data").join(name), files::OTHER_CONTENT)),
            None => Ok(()),
        }
    }

    fn sources(&self) -> Vec<PathBuf> {
        vec![self.store.label.clone()]
    }

    fn unread(&self) -> Vec<String> {
        let fields = self.table.schema.fields.iter().map(|field| field.name.clone());
        let is_read = |name: &String| {
            [EPISODE_IDX, STEP_IDX].contains(&name.as_str()) || self.columns.iter().any(|column| column.name == *name)
        };
        fields.filter(|name| !is_read(name)).collect()
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
        let total = if self.store.lists { self.store.list("")?.iter().map(|file| file.size).sum() } else { known };
        let rest = total.saturating_sub(known);
        let mut parts: Vec<(String, u64)> = columns.into_iter().collect();
        parts.push(("(versions and file metadata)".to_owned(), rest));
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }

    fn constants(&self, episode: usize) -> Result<Constants> {
        let Some(&row) = self.first_rows.get(episode) else {
            let problem = format!("episode position {episode}");
            return Err(Error::mismatch(
                "reading constants",
                problem,
                format!("positions below {}", self.episodes.len()),
            ));
        };
        self.stored_constants(episode, self.fragment_of(row)).map_err(|error| self.explained(error))
    }

    fn content_hash(&self) -> Result<String> {
        self.hash_of_episodes("", |fragment, episodes| self.hashes(fragment, episodes))
    }

    /// The names of the data files, which are hashes of the content or random.
    fn identity(&self, episodes: usize) -> Result<String> {
        let end = self.first_rows.get(episodes).copied().unwrap_or_else(|| self.rows());
        let fragments = self.table.fragments.iter().zip(&self.fragment_rows).take_while(|(_, first)| **first < end);
        let files = fragments.flat_map(|(fragment, _)| &fragment.files).map(|file| file.path.as_str());
        Ok(files.collect::<Vec<_>>().join("\n"))
    }

    /// The hashes that data files state of episodes are the word of who wrote them. So local files are known by the hashes in
    /// their names, which are verified when they are read, and by what the manifest says of them, such as which of their
    /// columns is which; other files by their values, and those of a store by its URI too.
    fn cache_key(&self) -> Result<String> {
        let store = if self.store.remote { self.store.label.display().to_string() } else { String::new() };
        let ids: Vec<_> = self.table.schema.fields_pre_order().map(|field| (&field.name, field.id)).collect();
        self.hash_of_episodes(&format!("{store} {ids:?}"), |fragment, episodes| {
            let fragment = &self.table.fragments[fragment];
            let is_named = |file: &DataFile| store::hash_in_name(&file.path).is_some();
            if !self.store.remote && !fragment.files.iter().all(is_named) {
                return episodes.map(|episode| self.compute_hash(episode)).collect();
            }
            let described = format!("{fragment:?}");
            Ok(episodes.map(|_| described.clone()).collect())
        })
    }
}

impl LanceReader {
    /// Returns a hash of `more`, of the columns, and of the index, the length and a hash of each episode; `of_fragment` returns those of
    /// the episodes in a fragment.
    fn hash_of_episodes(
        &self,
        more: &str,
        of_fragment: impl Fn(usize, Range<usize>) -> Result<Vec<String>>,
    ) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        let mut add = |bytes: &[u8]| {
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        if !more.is_empty() {
            add(more.as_bytes());
        }
        for column in &self.columns {
            add(schema::json(&column.spec)?.as_bytes());
        }
        for (fragment, episodes) in self.episodes_of_fragments().enumerate() {
            for (episode, hash) in self.episodes[episodes.clone()].iter().zip(of_fragment(fragment, episodes)?) {
                add(&episode.index.to_le_bytes());
                add(&(episode.length as u64).to_le_bytes());
                add(hash.as_bytes());
            }
        }
        Ok(hasher.finalize().to_hex().to_string())
    }

    /// The positions of the episodes that begin in each fragment.
    fn episodes_of_fragments(&self) -> impl Iterator<Item = Range<usize>> {
        let begin = |row: u64| self.first_rows.partition_point(|&first| first < row);
        self.fragment_rows.windows(2).map(move |rows| begin(rows[0])..begin(rows[1]))
    }

    /// Returns the hashes of a fragment's episodes, from the fragment's record if it exists, otherwise computed from
    /// the data.
    fn hashes(&self, fragment: usize, episodes: Range<usize>) -> Result<Vec<String>> {
        match self.stated_hashes(fragment, episodes.clone())? {
            Some(stated) => Ok(stated),
            None => episodes.map(|episode| self.compute_hash(episode)).collect(),
        }
    }

    /// Returns the hashes in a fragment's record, if it has one of these episodes.
    fn stated_hashes(&self, fragment: usize, episodes: Range<usize>) -> Result<Option<Vec<String>>> {
        let Some((_, record)) = self.record(fragment)? else { return Ok(None) };
        let stored = self.episodes[episodes].iter().map(|episode| episode.length as u64);
        let is_of_these = stored.eq(record.episodes.iter().map(|episode| episode.rows));
        Ok(is_of_these.then(|| record.episodes.into_iter().map(|episode| episode.hash).collect()))
    }

    /// Finds the episodes whose values do not have the hash that is stated of them; those that cannot be read are left out.
    fn false_hashes(&self) -> Result<Vec<Irregularity>> {
        let mut found = vec![];
        for (fragment, episodes) in self.episodes_of_fragments().enumerate() {
            let Some(stated) = self.stated_hashes(fragment, episodes.clone())? else { continue };
            for (episode, stated) in episodes.zip(stated) {
                if self.compute_hash(episode).is_ok_and(|hash| hash != stated) {
                    let what = "its values do not have the content hash that its data file states".to_owned();
                    found.push(Irregularity { episode: Some(episode), what });
                }
            }
        }
        Ok(found)
    }

    /// Computes the hash of an episode from its stored values.
    fn compute_hash(&self, episode: usize) -> Result<String> {
        let rows = self.table_rows(&StepRange::new(episode, 0, self.episodes[episode].length))?;
        let mut hash = ContentHash::new();
        for column in &self.columns {
            for rows_read in self.stored_rows(&column.name, slice::from_ref(&rows))? {
                hash.add(column, &rows_read.values).map_err(|problem| damaged(self.folder(), problem))?;
            }
        }
        Ok(hash.finish(&self.constants(episode)?))
    }
}

/// Splits the rows of a table into pieces.
fn pieces_of_rows(rows: u64) -> impl Iterator<Item = Range<u64>> {
    (0..rows).step_by(PIECE_ROWS).map(move |first| first..rows.min(first + PIECE_ROWS as u64))
}

/// Splits ranges into pieces of at most [`PIECE_ROWS`] rows.
fn pieces(ranges: &[StepRange]) -> Vec<Vec<StepRange>> {
    let mut found: Vec<Vec<StepRange>> = vec![vec![]];
    let mut free = PIECE_ROWS;
    for &StepRange { episode, mut start, mut length } in ranges {
        while length > 0 {
            if free == 0 {
                found.push(vec![]);
                free = PIECE_ROWS;
            }
            let part = length.min(free);
            if let Some(piece) = found.last_mut() {
                piece.push(StepRange::new(episode, start, part));
            }
            (start, length, free) = (start + part, length - part, free - part);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_hold_all_rows_in_order() {
        let ranges = [(0, 3, 5), (1, 0, 2 * PIECE_ROWS), (2, 7, 0), (2, 1, PIECE_ROWS - 5), (3, 4, 1)];
        let ranges = ranges.map(|(episode, start, length)| StepRange::new(episode, start, length));
        let pieces = pieces(&ranges);
        let rows = |ranges: &[StepRange]| ranges.iter().map(|range| range.length).sum::<usize>();
        assert_eq!(pieces.iter().map(|piece| rows(piece)).collect::<Vec<_>>(), [PIECE_ROWS, PIECE_ROWS, PIECE_ROWS, 1]);
        let all = pieces.concat();
        let starts: Vec<_> = all.iter().map(|range| (range.episode, range.start)).collect();
        assert_eq!(starts, [(0, 3), (1, 0), (1, PIECE_ROWS - 5), (1, 2 * PIECE_ROWS - 5), (2, 1), (3, 4)]);
        assert_eq!(
            pieces_of_rows(PIECE_ROWS as u64 + 1).map(|piece| piece.end).collect::<Vec<_>>(),
            [1 << 20, (1 << 20) + 1]
        );
    }
}
