//! Reading episodes: all ranges of a batch are sorted, merged and read together, pictures are decoded in
//! parallel into the batch.

use super::convert::{blob, cast, convert, whole_numbers};
use super::schema::{self, EPISODE, Kind, STEP, StoredColumn};
use super::store::{self, Store, damaged, table_folder, wait};
use crate::Location;
use crate::format::{Episode, Reader, StepRange};
use crate::image;
use arrow_array::ArrayRef;
use futures::{StreamExt as _, TryStreamExt as _};
use lance_core::datatypes::Schema as LanceSchema;
use lance_encoding::decoder::FilterExpression;
use lance_file::reader::{FileReader, ReaderProjection};
use lance_file::versions::reader_projection_from_field_ids;
use lance_io::ReadBatchParams;
use lance_table::format::{DataFile, Manifest as Table};
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap, HashSet, VecDeque};
use std::ops::Range;
use std::path::Path;
use std::slice;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Error, Manifest, Result, Schema};

/// Data files that are kept open. Each takes a file descriptor, of which a process commonly has 1024.
const OPEN_FILES: usize = 128;

/// Data files that one read has open at a time, be they kept or not.
const FILES_AT_ONCE: usize = 64;

/// Data files up to this size are checked before even the numbers of their episodes are read.
const SMALL_FILE: u64 = 1 << 20;

/// Rows per decoded piece; more only costs memory.
const ROWS_PER_PIECE: u32 = 4096;

/// Opens a table.
pub fn open(location: &Location) -> Result<Arc<dyn Reader>> {
    let path = location.local("lance")?;
    Ok(Arc::new(LanceReader::open(path)?))
}

struct LanceReader {
    store: Store,
    table: Arc<Table>,
    schema: Schema,
    columns: Vec<StoredColumn>,
    episodes: Vec<Episode>,
    /// The first row of each episode, in the whole table.
    first_rows: Vec<u64>,
    /// The first row of each fragment, and the end.
    fragment_rows: Vec<u64>,
    files: Mutex<OpenFiles>,
    /// Data files whose content was checked.
    verified: Mutex<HashSet<String>>,
}

#[derive(Default)]
struct OpenFiles {
    by_path: HashMap<String, Arc<FileReader>>,
    /// Oldest first.
    order: VecDeque<String>,
}

/// Consecutive rows of one fragment, as stored.
struct Piece {
    values: ArrayRef,
    rows: usize,
}

impl LanceReader {
    fn open(path: &Path) -> Result<Self> {
        let folder = table_folder(path)?;
        let store = Store::new(&folder)?;
        let Some(version) = store.latest()? else {
            let problem = if folder.is_dir() { "the folder holds no Lance table" } else { "there is no such dataset" };
            return Err(Error::corrupt(&folder, problem, "check the path; `swm datasets` lists those at home"));
        };
        let table = version.manifest;
        let mut fragment_rows = vec![0];
        for fragment in table.fragments.iter() {
            if fragment.deletion_file.is_some() {
                return Err(Error::corrupt(
                    &folder,
                    "some of its rows are marked as deleted",
                    "compact it first (in Python: lance.dataset(path).optimize.compact_files())",
                ));
            }
            let rows = fragment.physical_rows.ok_or_else(|| damaged(&folder, "a fragment has no row count"))?;
            let last: u64 = fragment_rows[fragment_rows.len() - 1];
            fragment_rows.push(last + rows as u64);
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
            verified: Mutex::default(),
        };
        let (columns, schema) = schema::columns_to_read(&folder, &reader.table.schema, |column| {
            let pieces = reader.pieces(column, slice::from_ref(&(0..1.min(reader.rows()))))?;
            pieces.first().map(|piece| blob(&piece.values, 0).map(<[u8]>::to_vec)).transpose()
        })?;
        (reader.columns, reader.schema) = (columns, schema);
        reader.find_episodes()?;
        Ok(reader)
    }

    fn folder(&self) -> &Path {
        &self.store.folder
    }

    fn rows(&self) -> u64 {
        self.fragment_rows[self.fragment_rows.len() - 1]
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
            let mut fragment = self.fragment_rows.partition_point(|&first| first <= start) - 1;
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
        for jobs in jobs.chunks(FILES_AT_ONCE) {
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
    /// until its data are asked for, as opening a dataset must not read all of it.
    fn verify(&self, file: &DataFile, data_wanted: bool) -> Result<()> {
        let Some(expected) = store::hash_in_name(&file.path) else { return Ok(()) };
        let lock = || self.verified.lock().unwrap_or_else(PoisonError::into_inner);
        if lock().contains(&file.path) {
            return Ok(());
        }
        let path = self.folder().join("data").join(&file.path);
        let io = |e: std::io::Error| match e.kind() {
            std::io::ErrorKind::NotFound => damaged(&path, "a data file is missing"),
            _ => Error::io(&path, "checking a data file", e),
        };
        if !data_wanted && std::fs::metadata(&path).map_err(io)?.len() > SMALL_FILE {
            return Ok(());
        }
        if store::hash_file(&path).map_err(io)? != expected {
            return Err(damaged(&path, "its content does not match the hash in its name"));
        }
        lock().insert(file.path.clone());
        Ok(())
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
        let lock = || self.files.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(reader) = lock().by_path.get(&file.path) {
            return Ok(Arc::clone(reader));
        }
        let (store, data_file) = (self.store.clone(), file.clone());
        let path = self.folder().join("data").join(&file.path);
        let reader = wait(&path, "opening a data file", async move { store.open_file(&data_file).await })?;
        let reader = Arc::new(reader);
        let mut files = lock();
        if files.by_path.insert(file.path.clone(), Arc::clone(&reader)).is_none() {
            files.order.push_back(file.path.clone());
            if files.order.len() > OPEN_FILES
                && let Some(oldest) = files.order.pop_front()
            {
                files.by_path.remove(&oldest);
            }
        }
        Ok(reader)
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
        let mut wanted: Vec<(u64, &mut [u8])> = Vec::with_capacity(rows);
        let mut places = out.chunks_exact_mut(column.spec.row_bytes());
        for range in ranges {
            wanted.extend(self.table_rows(range)?.zip(places.by_ref()));
        }
        wanted.sort_by_key(|(row, _)| *row);
        let mut merged: Vec<Range<u64>> = vec![];
        for &(row, _) in &wanted {
            match merged.last_mut() {
                Some(range) if row < range.end => {}
                Some(range) if row == range.end => range.end += 1,
                _ => merged.push(row..row + 1),
            }
        }
        let pieces = self.pieces(&column.name, &merged)?;
        // One group for every stored row: the places that want it.
        let mut groups = wanted.chunk_by_mut(|a, b| a.0 == b.0);
        match column.kind {
            Kind::Numbers => {
                let mut row = vec![];
                for piece in &pieces {
                    row.resize(piece.rows * column.spec.row_bytes(), 0);
                    convert(&piece.values, column.spec.len(), column.spec.dtype, &mut row)
                        .map_err(|problem| damaged(self.folder(), format!("column '{name}': {problem}")))?;
                    for (value, group) in row.chunks_exact(column.spec.row_bytes()).zip(groups.by_ref()) {
                        group.iter_mut().for_each(|(_, place)| place.copy_from_slice(value));
                    }
                }
            }
            Kind::Image => {
                let mut jobs = Vec::with_capacity(rows);
                for piece in &pieces {
                    for (i, group) in (0..piece.rows).zip(groups.by_ref()) {
                        jobs.push((blob(&piece.values, i)?, group));
                    }
                }
                let (height, width) = (column.spec.shape[0], column.spec.shape[1]);
                jobs.into_par_iter().with_max_len(1).try_for_each(|(bytes, group)| {
                    let Some(((row, first), others)) = group.split_first_mut() else { return Ok(()) };
                    image::decode(bytes, height, width, first).map_err(|problem| {
                        damaged(self.folder(), format!("picture of row {row}, column '{name}': {problem}"))
                    })?;
                    others.iter_mut().for_each(|(_, place)| place.copy_from_slice(first));
                    Ok(())
                })?;
            }
        }
        Ok(())
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
        let rest = folder_size(self.folder())?.saturating_sub(known);
        let mut parts: Vec<(String, u64)> = columns.into_iter().collect();
        parts.push(("(versions and file metadata)".to_owned(), rest));
        parts.sort_by(|a, b| b.1.cmp(&a.1).then_with(|| a.0.cmp(&b.0)));
        Ok(parts)
    }

    fn content_hash(&self) -> Result<String> {
        let mut hasher = blake3::Hasher::new();
        let mut add = |bytes: &[u8]| {
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(bytes);
        };
        for episode in &self.episodes {
            add(&episode.index.to_le_bytes());
            add(&(episode.length as u64).to_le_bytes());
        }
        for column in &self.columns {
            add(schema::json(&column.spec)?.as_bytes());
            let mut start = 0;
            while start < self.rows() {
                let end = (start + u64::from(ROWS_PER_PIECE)).min(self.rows());
                for piece in self.pieces(&column.name, slice::from_ref(&(start..end)))? {
                    match column.kind {
                        Kind::Image => {
                            for row in 0..piece.rows {
                                add(blob(&piece.values, row)?);
                            }
                        }
                        Kind::Numbers => {
                            let mut bytes = vec![0; column.spec.row_bytes() * piece.rows];
                            convert(&piece.values, column.spec.len(), column.spec.dtype, &mut bytes)
                                .map_err(|problem| damaged(self.folder(), problem))?;
                            bytes.chunks_exact(column.spec.row_bytes()).for_each(&mut add);
                        }
                    }
                }
                start = end;
            }
        }
        Ok(hasher.finalize().to_hex().to_string())
    }
}

/// Bytes of all files below a folder.
fn folder_size(folder: &Path) -> Result<u64> {
    let io = |e| Error::io(folder, "listing the folder", e);
    let mut size = 0;
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let entry = entry.map_err(io)?;
        let metadata = entry.metadata().map_err(io)?;
        size += if metadata.is_dir() { folder_size(&entry.path())? } else { metadata.len() };
    }
    Ok(size)
}
