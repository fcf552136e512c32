//! Reading episodes: all ranges of a batch are sorted, merged and read together, pictures are decoded in
//! parallel into the batch.
//!
//! Pictures are read from where they lie ([`Places`]). Numbers are small: those of a data file are decoded whole when
//! the first of them is wanted, and kept. What is laid out otherwise, or does not fit, is left to Lance's decoder.

use super::convert::{blob, cast, convert, whole_numbers};
use super::pictures::{Place, Places};
use super::record::{CONSTANTS_KEY, ContentHash, EPISODES_KEY, Record};
use super::schema::{self, EPISODE, Kind, STEP, StoredColumn};
use super::store::{self, Store, damaged, wait};
use crate::format::{Constants, Episode, Irregularity, Reader, StepRange};
use crate::objects;
use crate::{Location, image};
use arrow_array::ArrayRef;
use bytes::Bytes;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_core::datatypes::Schema as LanceSchema;
use lance_encoding::decoder::FilterExpression;
use lance_file::reader::{FileReader, ReaderProjection};
use lance_file::versions::reader_projection_from_field_ids;
use lance_io::ReadBatchParams;
use lance_table::format::{DataFile, Manifest as Table};
use rayon::prelude::*;
use std::cell::RefCell;
use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::os::unix::fs::FileExt as _;
use std::path::Path;
use std::slice;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use swm_core::{Error, Manifest, Result, Schema};

/// Data files that are kept open, and files that one read has open at a time. Each takes up to two file descriptors,
/// of which a process commonly has 1024.
const OPEN_FILES: usize = 32;

/// Data files up to this size are checked before even the numbers of their episodes are read.
const SMALL_FILE: u64 = 1 << 20;

/// Rows per decoded piece; more only costs memory.
const ROWS_PER_PIECE: u32 = 4096;

/// Bytes of decoded numbers that are kept. A hundred thousand steps of sixty numbers take a quarter of it.
const KEPT_NUMBERS: usize = 128 << 20;

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
    /// Where pictures are, by fragment and name of the column; `None` where Lance must look.
    places: Mutex<HashMap<(usize, String), Option<Arc<LaidOut>>>>,
    numbers: Mutex<Numbers>,
    /// Data files whose content was checked.
    verified: Mutex<HashSet<String>>,
}

/// What was used last, by the path of a data file, up to [`OPEN_FILES`].
struct Recent<T> {
    by_path: HashMap<String, Arc<T>>,
    /// Oldest first.
    order: VecDeque<String>,
}

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Self { by_path: HashMap::new(), order: VecDeque::new() }
    }
}

impl<T> Recent<T> {
    fn get(&self, path: &str) -> Option<Arc<T>> {
        self.by_path.get(path).map(Arc::clone)
    }

    fn keep(&mut self, path: &str, file: &Arc<T>) {
        if self.by_path.insert(path.to_owned(), Arc::clone(file)).is_some() {
            return;
        }
        self.order.push_back(path.to_owned());
        if self.order.len() > OPEN_FILES
            && let Some(oldest) = self.order.pop_front()
        {
            self.by_path.remove(&oldest);
        }
    }
}

/// The pictures of one column in one data file.
struct LaidOut {
    /// The data file.
    path: String,
    places: Places,
}

/// Decoded numbers, by fragment and name of the column.
#[derive(Default)]
struct Numbers {
    kept: HashMap<(usize, String), Arc<Vec<u8>>>,
    bytes: usize,
}

/// A row of the table, and the place in a batch that wants it.
type Wanted<'a> = (u64, &'a mut [u8]);

/// Consecutive rows of one fragment, as stored.
struct Piece {
    values: ArrayRef,
    rows: usize,
}

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
        let mut reader = Self {
            store,
            table,
            schema: Schema::new([])?,
            columns: vec![],
            episodes: vec![],
            first_rows: vec![],
            fragment_rows,
            files: Mutex::default(),
            handles: Mutex::default(),
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

    /// The stored values of disjoint rising ranges of rows of the whole table.
    fn pieces(&self, stored_name: &str, ranges: &[Range<u64>]) -> Result<Vec<Piece>> {
        // Cut the ranges at the fragments' borders.
        let mut jobs: Vec<(usize, Vec<Range<u64>>)> = vec![];
        for range in ranges.iter().filter(|range| !range.is_empty()) {
            let mut start = range.start;
            let mut fragment = self.fragment_of(start);
            while start < range.end {
                let (first, end) = (self.fragment_rows[fragment], self.fragment_rows[fragment + 1]);
                let part = start - first..range.end.min(end) - first;
                start = first + part.end;
                match jobs.last_mut() {
                    Some((last, parts)) if *last == fragment => parts.push(part),
                    _ if !part.is_empty() => jobs.push((fragment, vec![part])),
                    _ => {}
                }
                fragment += 1;
            }
        }
        let mut pieces = vec![];
        for jobs in jobs.chunks(OPEN_FILES) {
            pieces.extend(self.read_pieces(stored_name, jobs)?);
        }
        Ok(pieces)
    }

    /// The stored values of some rows of some fragments.
    fn read_pieces(&self, stored_name: &str, jobs: &[(usize, Vec<Range<u64>>)]) -> Result<Vec<Piece>> {
        let mut reads = vec![];
        for (fragment, parts) in jobs {
            self.verify(self.data_file(*fragment, stored_name)?.0, stored_name != EPISODE)?;
            let (file, projection) = self.locate(*fragment, stored_name)?;
            let wanted: u64 = parts.iter().map(|part| part.end - part.start).sum();
            reads.push((file, projection, parts.clone(), wanted));
        }
        let action = format!("reading column '{stored_name}'");
        let lists = wait(self.folder(), &action, async move {
            futures::stream::iter(reads.into_iter().map(|(file, projection, parts, wanted)| async move {
                let params = ReadBatchParams::Ranges(parts.into());
                let mut tasks =
                    file.read_tasks(params, ROWS_PER_PIECE, Some(projection), FilterExpression::no_filter()).await?;
                let mut pieces = vec![];
                while let Some(task) = tasks.next().await {
                    let batch = task.task.await?;
                    pieces.push(Piece { rows: batch.num_rows(), values: Arc::clone(batch.column(0)) });
                }
                let rows: u64 = pieces.iter().map(|piece| piece.rows as u64).sum();
                if rows != wanted {
                    return Err(lance_core::Error::internal(format!("got {rows} rows instead of {wanted}")));
                }
                Ok(pieces)
            }))
            .buffered(16)
            .try_collect::<Vec<Vec<Piece>>>()
            .await
        })?;
        Ok(lists.into_iter().flatten().collect())
    }

    /// The file of a fragment that holds a column, and the table's schema of that column.
    fn data_file(&self, fragment: usize, stored_name: &str) -> Result<(&DataFile, LanceSchema)> {
        let missing = || damaged(self.folder(), format!("fragment {fragment} has no column '{stored_name}'"));
        let projected = self.table.schema.project(&[stored_name]).map_err(|_| missing())?;
        let id = projected.fields.first().ok_or_else(missing)?.id;
        let holds = |file: &&DataFile| file.fields.contains(&id);
        let file = self.table.fragments[fragment].files.iter().find(holds).ok_or_else(missing)?;
        Ok((file, projected))
    }

    /// Checks a file against the hash in its name, once, before anything in it is decoded: Lance trusts what
    /// it reads, so a flipped bit could make it ask for any amount of memory. A large file is left alone
    /// until its data are asked for, as opening a dataset must not read all of it. Object stores check what they hold
    /// themselves.
    fn verify(&self, file: &DataFile, data_wanted: bool) -> Result<()> {
        let Some(expected) = store::hash_in_name(&file.path).filter(|_| !self.store.remote) else { return Ok(()) };
        if lock(&self.verified).contains(&file.path) {
            return Ok(());
        }
        let path = self.store.local(&self.store.data_path(&file.path));
        let io = |e: std::io::Error| self.missing(&path, e);
        if !data_wanted && std::fs::metadata(&path).map_err(io)?.len() > SMALL_FILE {
            return Ok(());
        }
        if store::hash_file(&path).map_err(io)? != expected {
            return Err(damaged(&path, "its content does not match the hash in its name"));
        }
        lock(&self.verified).insert(file.path.clone());
        Ok(())
    }

    fn missing(&self, path: &Path, error: std::io::Error) -> Error {
        match error.kind() {
            std::io::ErrorKind::NotFound => damaged(path, "a data file is missing"),
            std::io::ErrorKind::UnexpectedEof => damaged(path, "a data file is too short"),
            _ => Error::io(path, "reading a data file", error),
        }
    }

    /// The open file of a fragment that holds a column, and where in it.
    fn locate(&self, fragment: usize, stored_name: &str) -> Result<(Arc<FileReader>, ReaderProjection)> {
        let (file, projected) = self.data_file(fragment, stored_name)?;
        #[allow(clippy::cast_sign_loss)]
        let places: BTreeMap<u32, u32> = file
            .fields
            .iter()
            .zip(file.column_indices.iter())
            .filter(|&(&field, &column)| field >= 0 && column >= 0)
            .map(|(&field, &column)| (field as u32, column as u32))
            .collect();
        let reader = self.file(file)?;
        let projection = reader_projection_from_field_ids(reader.version(), &projected, &places)
            .map_err(|e| damaged(self.folder(), e.to_string()))?;
        Ok((reader, projection))
    }

    fn file(&self, file: &DataFile) -> Result<Arc<FileReader>> {
        if let Some(reader) = lock(&self.files).get(&file.path) {
            return Ok(reader);
        }
        let (store, data_file) = (self.store.clone(), file.clone());
        let path = self.folder().join("data").join(&file.path);
        let reader = wait(&path, "opening a data file", async move { store.open_file(&data_file).await })?;
        let reader = Arc::new(reader);
        lock(&self.files).keep(&file.path, &reader);
        Ok(reader)
    }

    /// A data file of this machine, open for reading.
    fn handle(&self, path: &str) -> Result<Arc<File>> {
        if let Some(file) = lock(&self.handles).get(path) {
            return Ok(file);
        }
        let place = self.store.local(&self.store.data_path(path));
        let file = Arc::new(File::open(&place).map_err(|e| self.missing(&place, e))?);
        lock(&self.handles).keep(path, &file);
        Ok(file)
    }

    /// Bytes of data files: for each path its ranges.
    fn bytes(&self, wanted: Vec<(String, Vec<Range<u64>>)>) -> Result<Vec<Vec<Bytes>>> {
        let store = self.store.clone();
        wait(self.folder(), "reading data files", async move {
            futures::stream::iter(wanted.into_iter().map(|(path, ranges)| {
                let (file, store) = (store.data_path(&path), store.clone());
                async move { objects::fetch(&*store.inner(), &file, &ranges).await.map_err(lance_core::Error::from) }
            }))
            .buffered(16)
            .try_collect()
            .await
        })
    }

    /// Where the pictures of a column are in a fragment; `None` where they are not laid out one by one.
    fn places(&self, fragment: usize, column: &str) -> Result<Option<Arc<LaidOut>>> {
        let key = (fragment, column.to_owned());
        if let Some(known) = lock(&self.places).get(&key) {
            return Ok(known.clone());
        }
        let (file, _) = self.data_file(fragment, column)?;
        self.verify(file, true)?;
        let (reader, projection) = self.locate(fragment, column)?;
        let metadata = reader.metadata();
        let found = match projection.column_indices[..] {
            [index] => match metadata.column_infos.get(index as usize) {
                Some(info) => Places::read(info, metadata.file_size_bytes, |ranges| {
                    let mut lists = self.bytes(vec![(file.path.clone(), ranges.to_vec())])?;
                    Ok::<_, Error>(lists.pop().unwrap_or_default())
                })?,
                None => None,
            },
            _ => None,
        };
        let found = found.map(|places| Arc::new(LaidOut { path: file.path.clone(), places }));
        lock(&self.places).insert(key, found.clone());
        Ok(found)
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
        let whole: u64 = self.store.list("")?.iter().map(|file| file.size).sum();
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

    /// What a fragment's data file records of its episodes, and the file.
    fn record(&self, fragment: usize) -> Result<Option<(Arc<FileReader>, Record)>> {
        for file in &self.table.fragments[fragment].files {
            self.verify(file, false)?;
            let reader = self.file(file)?;
            if let Some(stored) = self.buffer(&reader, EPISODES_KEY)? {
                let record = Record::decode(&stored).map_err(|problem| damaged(self.folder(), problem))?;
                return Ok(Some((reader, record)));
            }
        }
        Ok(None)
    }

    /// The global buffer whose number is in the file's metadata.
    fn buffer(&self, reader: &Arc<FileReader>, key: &str) -> Result<Option<Bytes>> {
        let Some(number) = reader.schema().metadata.get(key).and_then(|number| number.parse::<u32>().ok()) else {
            return Ok(None);
        };
        let reader = Arc::clone(reader);
        let read = async move { reader.read_global_buffer(number).await.map(Some) };
        wait(self.folder(), "reading the record of its episodes", read)
    }

    fn read_numbers(&self, column: &StoredColumn, wanted: &mut [Wanted]) -> Result<()> {
        self.keep_numbers(column, wanted)?;
        let n = column.spec.row_bytes();
        let mut others = vec![];
        for rows in wanted.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            let kept = lock(&self.numbers).kept.get(&(fragment, column.name.clone())).map(Arc::clone);
            match kept {
                Some(values) => {
                    for (row, place) in rows {
                        let at = (*row - self.fragment_rows[fragment]) as usize * n;
                        place.copy_from_slice(&values[at..at + n]);
                    }
                }
                None => others.extend(rows),
            }
        }
        let pieces = self.pieces(&column.name, &merged(&others))?;
        // One group for every stored row: the places that want it.
        let mut groups = others.chunk_by_mut(|a, b| a.0 == b.0);
        let mut bytes = vec![];
        for piece in &pieces {
            bytes.resize(piece.rows * n, 0);
            self.convert(column, piece, &mut bytes)?;
            for (value, group) in bytes.chunks_exact(n).zip(groups.by_ref()) {
                group.iter_mut().for_each(|(_, place)| place.copy_from_slice(value));
            }
        }
        Ok(())
    }

    fn convert(&self, column: &StoredColumn, piece: &Piece, out: &mut [u8]) -> Result<()> {
        convert(&piece.values, column.spec.len(), column.spec.dtype, out)
            .map_err(|problem| damaged(self.folder(), format!("column '{}': {problem}", column.spec.name)))
    }

    /// Decodes the numbers of all fragments that have a wanted row, as long as there is room for them.
    fn keep_numbers(&self, column: &StoredColumn, wanted: &[Wanted]) -> Result<()> {
        let n = column.spec.row_bytes();
        let mut ranges: Vec<Range<u64>> = vec![];
        {
            let numbers = lock(&self.numbers);
            let mut room = KEPT_NUMBERS.saturating_sub(numbers.bytes);
            for rows in wanted.chunk_by(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
                let fragment = self.fragment_of(rows[0].0);
                let range = self.fragment_rows[fragment]..self.fragment_rows[fragment + 1];
                let size = (range.end - range.start).saturating_mul(n as u64);
                let known = numbers.kept.contains_key(&(fragment, column.name.clone()));
                if !known && size <= room as u64 {
                    room -= size as usize;
                    ranges.push(range);
                }
            }
        }
        let mut pieces = self.pieces(&column.name, &ranges)?.into_iter();
        for range in ranges {
            let mut values = vec![0; (range.end - range.start) as usize * n];
            let mut at = 0;
            while at < values.len() {
                let Some(piece) = pieces.next() else { break };
                let end = (at + piece.rows * n).min(values.len());
                self.convert(column, &piece, &mut values[at..end])?;
                at = end;
            }
            let mut numbers = lock(&self.numbers);
            numbers.bytes += values.len();
            let key = (self.fragment_of(range.start), column.name.clone());
            if let Some(twice) = numbers.kept.insert(key, Arc::new(values)) {
                numbers.bytes -= twice.len();
            }
        }
        Ok(())
    }

    fn read_pictures(&self, column: &StoredColumn, wanted: &mut [Wanted]) -> Result<()> {
        let mut laid_out = vec![];
        let mut others: Vec<&mut Wanted> = vec![];
        for rows in wanted.chunk_by_mut(|a, b| self.fragment_of(a.0) == self.fragment_of(b.0)) {
            let fragment = self.fragment_of(rows[0].0);
            match self.places(fragment, &column.name)? {
                Some(pictures) => laid_out.push((self.fragment_rows[fragment], pictures, rows)),
                None => others.extend(rows),
            }
        }
        for fragments in laid_out.chunks_mut(OPEN_FILES) {
            self.read_laid_out(column, fragments)?;
        }
        let pieces = self.pieces(&column.name, &merged(&others))?;
        let mut groups = others.chunk_by_mut(|a, b| a.0 == b.0);
        let mut jobs = vec![];
        for piece in &pieces {
            for (i, group) in (0..piece.rows).zip(groups.by_ref()) {
                jobs.push((blob(&piece.values, i)?, group));
            }
        }
        jobs.into_par_iter().with_max_len(1).try_for_each(|(bytes, group)| {
            let Some(((row, first), others)) = group.split_first_mut().map(|(a, b)| ((a.0, &mut *a.1), b)) else {
                return Ok(());
            };
            self.decode(column, row, bytes, first)?;
            others.iter_mut().for_each(|(_, place)| place.copy_from_slice(first));
            Ok(())
        })
    }

    /// Reads and decodes pictures whose places are known, of some fragments.
    fn read_laid_out(&self, column: &StoredColumn, fragments: &mut [(u64, Arc<LaidOut>, &mut [Wanted])]) -> Result<()> {
        let mut paths = vec![];
        let mut jobs = vec![];
        for (at, (first_row, pictures, rows)) in fragments.iter_mut().enumerate() {
            paths.push(pictures.path.clone());
            for group in rows.chunk_by_mut(|a, b| a.0 == b.0) {
                let row = group[0].0;
                let place = pictures.places.find(row - *first_row).ok_or_else(|| {
                    damaged(self.folder(), format!("row {row} of column '{}' is not in its data file", column.name))
                })?;
                jobs.push((at, place, group));
            }
        }
        let finish = |place: &Place, bytes: &[u8], group: &mut [Wanted]| {
            let Some(((row, first), others)) = group.split_first_mut() else { return Ok(()) };
            let picture = place.picture(bytes).ok_or_else(|| {
                damaged(self.folder(), format!("row {row} of column '{}' states another length", column.name))
            })?;
            self.decode(column, *row, picture, first)?;
            others.iter_mut().for_each(|(_, place)| place.copy_from_slice(first));
            Ok(())
        };
        if self.store.remote {
            let mut ranges: Vec<_> = paths.into_iter().map(|path| (path, vec![])).collect();
            jobs.iter().for_each(|(at, place, _)| ranges[*at].1.push(place.bytes.clone()));
            let fetched = self.bytes(ranges)?.into_iter().flatten();
            let jobs: Vec<_> = jobs.into_iter().zip(fetched).collect();
            return jobs
                .into_par_iter()
                .with_max_len(1)
                .try_for_each(|((_, place, group), bytes)| finish(&place, &bytes, group));
        }
        let files = paths.iter().map(|path| self.handle(path)).collect::<Result<Vec<_>>>()?;
        jobs.into_par_iter().with_max_len(1).try_for_each(|(at, place, group)| {
            SCRATCH.with_borrow_mut(|scratch| {
                scratch.resize((place.bytes.end - place.bytes.start) as usize, 0);
                files[at]
                    .read_exact_at(scratch, place.bytes.start)
                    .map_err(|e| self.missing(Path::new(&paths[at]), e))?;
                finish(&place, scratch, group)
            })
        })
    }

    fn decode(&self, column: &StoredColumn, row: u64, bytes: &[u8], out: &mut [u8]) -> Result<()> {
        let (height, width) = (column.spec.shape[0], column.spec.shape[1]);
        image::decode(bytes, height, width, out).map_err(|problem| {
            damaged(self.folder(), format!("picture of row {row}, column '{}': {problem}", column.spec.name))
        })
    }
}

thread_local! {
    /// An encoded picture, between reading and decoding.
    static SCRATCH: RefCell<Vec<u8>> = const { RefCell::new(vec![]) };
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
