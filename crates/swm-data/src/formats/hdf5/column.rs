//! One column: the storage layout of the column in the file, and the reading of requested rows.

use super::chunks::{Chunk, Grid, Index, read_chunk};
use super::filters::{Pipeline, Scratch};
use super::source::Source;
use super::structure::{catch_panic, scalar_type};
use crate::dataset::episodes::RowSlot;
use crate::dataset::objects::Bytes;
use crate::formats::stored_scalar::{Class, StoredScalar};
use hdf5_pure::{Dataset, H5Element, Layout};
use rayon::prelude::*;
use std::cell::RefCell;
use std::collections::HashMap;
use std::ops::Range;
use std::sync::OnceLock;
use swm_core::ColumnSpec;

/// Maximum size of a chunk in bytes. Only damaged files declare larger chunks.
const MAX_CHUNK_BYTES: u64 = 128 << 20;

/// Maximum size of rows in the header of a dataset, in bytes: that of a header message, and of booleans as integers.
const MAX_COMPACT_BYTES: u64 = 8 << 16;

/// Maximum number of bytes that one read of contiguous rows covers.
const RUN_BYTES: u64 = 1 << 20;

thread_local! {
    static BUFFERS: RefCell<Buffers> = RefCell::default();
}

/// Buffers of a thread for reading chunks.
#[derive(Default)]
struct Buffers {
    stored: Vec<u8>,
    chunk: Vec<u8>,
    rows_buffer: Vec<u8>,
    scratch: Scratch,
}

/// An HDF5 dataset of rows.
pub(super) struct Column {
    pub spec: ColumnSpec,
    /// Number of rows.
    pub rows: u64,
    dataset: Dataset,
    stored: StoredScalar,
    storage: Storage,
    /// Whether this format's writer wrote the file. If so, a missing chunk is an error.
    pub written_here: bool,
}

enum Storage {
    /// Rows are contiguous from this address on.
    Contiguous(u64),
    /// No row was written. Each reads as this one, in its stored form.
    Unwritten(Vec<u8>),
    /// Rows are in the dataset's header.
    Compact,
    /// Rows are divided into chunks.
    Chunked {
        pipeline: Pipeline,
        /// Rows per chunk.
        rows: u64,
        /// Side lengths of a chunk along the axes of a row, in elements.
        sides: Vec<usize>,
        /// An element that was never written, in its stored form; `None` if only the library knows it.
        fill: Option<Vec<u8>>,
        index: OnceLock<Result<Index, String>>,
    },
}

/// The value of an element that was never written, in its stored form: 0 unless the file says otherwise. `None` for types whose
/// value the library does not tell, such as enumerations.
fn fill_element(dataset: &Dataset, stored: StoredScalar) -> Option<Vec<u8>> {
    fn of<T: H5Element, const SIZE: usize>(dataset: &Dataset, bytes: fn(T) -> [u8; SIZE]) -> Option<Vec<u8>> {
        let value = catch_panic("reading the value of unwritten elements", || dataset.fill_value::<T>()).ok()?;
        Some(value.map_or_else(|| vec![0; SIZE], |value| bytes(value).to_vec()))
    }
    let mut bytes = match (stored.class, stored.size) {
        (Class::Signed, 1) => of(dataset, i8::to_le_bytes),
        (Class::Signed, 2) => of(dataset, i16::to_le_bytes),
        (Class::Signed, 4) => of(dataset, i32::to_le_bytes),
        (Class::Signed, 8) => of(dataset, i64::to_le_bytes),
        (Class::Unsigned, 1) => of(dataset, u8::to_le_bytes),
        (Class::Unsigned, 2) => of(dataset, u16::to_le_bytes),
        (Class::Unsigned, 4) => of(dataset, u32::to_le_bytes),
        (Class::Unsigned, 8) => of(dataset, u64::to_le_bytes),
        (Class::Float, 4) => of(dataset, f32::to_le_bytes),
        (Class::Float, 8) => of(dataset, f64::to_le_bytes),
        _ => None,
    }?;
    if stored.big_endian {
        bytes.reverse();
    }
    Some(bytes)
}

impl Column {
    /// Interprets a dataset as a column; `None` if it is not numeric.
    ///
    /// # Errors
    /// If the dataset is damaged, or its layout or filters are not supported.
    #[allow(clippy::too_many_lines, reason = "one case per storage layout")]
    pub fn new(name: &str, dataset: Dataset, file_size: u64) -> Result<Option<Self>, String> {
        let Some(stored) = scalar_type(&catch_panic("reading its type", || dataset.datatype())?) else {
            return Ok(None);
        };
        let Some(dtype) = stored.dtype() else { return Ok(None) };
        let shape = catch_panic("reading its shape", || dataset.shape())?;
        let Some((&rows, sides)) = shape.split_first() else { return Ok(None) };
        let sides: Vec<usize> = sides.iter().map(|&side| side as usize).collect();
        let row_bytes = sides.iter().try_fold(dtype.size() as u64, |n, &side| n.checked_mul(side as u64));
        if row_bytes == Some(0) {
            return Ok(None);
        }
        if row_bytes.is_none_or(|n| n > MAX_CHUNK_BYTES) {
            return Err(format!("its rows have the shape {sides:?}, which is too large"));
        }
        let layout = catch_panic("reading its layout", || dataset.layout()).map_err(|problem| match problem {
            newest if newest.contains("layout version: 5") => {
                format!("{newest} (HDF5 2 with libver='latest'; `h5repack --high=3` makes it readable)")
            }
            other => other,
        })?;
        let storage = match layout {
            Layout::Contiguous { address, .. } => {
                let bytes = sides.iter().product::<usize>() as u64 * stored.size as u64;
                let end = bytes.checked_mul(rows).and_then(|bytes| bytes.checked_add(address.unwrap_or(0)));
                if end.is_none_or(|end| end > file_size) {
                    return Err(format!("{rows} rows of {bytes} bytes do not fit the file"));
                }
                match address {
                    Some(address) => Storage::Contiguous(address),
                    // The library refuses values in other files, which have no address either.
                    None => Storage::Unwritten(catch_panic("reading its data", || dataset.read_raw_rows(0, 1))?),
                }
            }
            Layout::Compact { .. } => {
                if row_bytes.and_then(|bytes| bytes.checked_mul(rows)).is_none_or(|bytes| bytes > MAX_COMPACT_BYTES) {
                    return Err(format!("{rows} rows do not fit the header of a dataset"));
                }
                Storage::Compact
            }
            Layout::Chunked { chunk_shape, .. } => {
                let filters = catch_panic("reading its filters", || Ok::<_, String>(dataset.filter_pipeline()))?;
                let pipeline = Pipeline::new(&filters, stored.size)?;
                let bytes = chunk_shape.iter().try_fold(stored.size as u64, |n, &side| n.checked_mul(side));
                let block = row_bytes.and_then(|n| n.checked_mul(*chunk_shape.first()?));
                let fits = |n: Option<u64>| n.is_some_and(|n| (1..=MAX_CHUNK_BYTES).contains(&n));
                if chunk_shape.len() != shape.len() || !fits(bytes) || !fits(block) {
                    return Err(format!("its chunks have the shape {chunk_shape:?}, which is too large"));
                }
                // Every chunk takes some bytes of the file, at least in the list of chunks.
                let least = if pipeline.is_empty() { bytes.unwrap_or(0) } else { 8 };
                let chunks = shape
                    .iter()
                    .zip(&chunk_shape)
                    .try_fold(1_u64, |n, (&whole, side)| n.checked_mul(whole.div_ceil(*side)));
                if chunks.and_then(|n| (n / 2).checked_mul(least)).is_none_or(|n| n > file_size) {
                    return Err(format!("{rows} rows in chunks of {chunk_shape:?} do not fit the file"));
                }
                Storage::Chunked {
                    pipeline,
                    rows: chunk_shape[0],
                    sides: chunk_shape[1..].iter().map(|&side| side as usize).collect(),
                    fill: fill_element(&dataset, stored),
                    index: OnceLock::new(),
                }
            }
            other => return Err(format!("its data layout {other} is not supported")),
        };
        Ok(Some(Self {
            spec: ColumnSpec::new(name, dtype, sides),
            rows,
            dataset,
            stored,
            storage,
            written_here: false,
        }))
    }

    /// Whether the stored type equals the type of the column.
    pub fn is_plain(&self) -> bool {
        self.stored.is_plain()
    }

    /// Size of a stored row in bytes.
    fn stored_row(&self) -> usize {
        self.spec.len() * self.stored.size
    }

    /// Size in the file, in bytes.
    pub fn footprint(&self, source: &Source) -> Result<u64, String> {
        match &self.storage {
            Storage::Unwritten(_) => Ok(0),
            Storage::Contiguous(_) | Storage::Compact => Ok(self.rows * self.stored_row() as u64),
            Storage::Chunked { .. } => Ok(self.index(source)?.chunks.iter().map(|chunk| u64::from(chunk.size)).sum()),
        }
    }

    /// Reads all rows.
    ///
    /// # Errors
    /// If the rows are damaged.
    pub fn read_all(&self, source: &Source) -> Result<Vec<u8>, String> {
        let size = self.spec.row_bytes();
        let length = usize::try_from(self.rows).ok().and_then(|rows| rows.checked_mul(size));
        let length = length.ok_or_else(|| format!("{} rows do not fit into memory", self.rows))?;
        let mut all = vec![];
        all.try_reserve_exact(length).map_err(|_| format!("its {length} bytes do not fit into memory"))?;
        all.resize(length, 0);
        let mut slots: Vec<RowSlot<'_>> =
            all.chunks_exact_mut(size).enumerate().map(|(row, slot)| ((0, row), slot)).collect();
        self.read(source, &mut slots, |(_, row)| row as u64)?;
        Ok(all)
    }

    /// Reads rows into `slots`, which are sorted by the row that `row_of` returns for their keys.
    ///
    /// # Errors
    /// If the rows are damaged.
    pub fn read(
        &self,
        source: &Source,
        slots: &mut [RowSlot<'_>],
        row_of: impl Fn((usize, usize)) -> u64 + Sync,
    ) -> Result<(), String> {
        match &self.storage {
            Storage::Compact => {
                let all = catch_panic("reading its data", || self.dataset.read_raw())?;
                self.copy_rows(&all, 0, slots, &row_of)
            }
            Storage::Unwritten(row) => slots.iter_mut().try_for_each(|(_, slot)| self.stored.convert(row, slot)),
            Storage::Contiguous(address) => self.read_contiguous(source, *address, slots, &row_of),
            Storage::Chunked { pipeline, rows, sides, fill, .. } => {
                let grid = Grid::new(*rows, sides, &self.spec.shape, self.stored.size);
                self.read_chunks(source, (pipeline, fill.as_deref()), &grid, slots, &row_of)
            }
        }
    }

    fn read_contiguous(
        &self,
        source: &Source,
        address: u64,
        slots: &mut [RowSlot<'_>],
        row_of: &(impl Fn((usize, usize)) -> u64 + Sync),
    ) -> Result<(), String> {
        let size = self.stored_row() as u64;
        let most = (RUN_BYTES / size).max(1);
        // Runs of consecutive rows; each run is read with one request.
        let runs: Vec<&mut [RowSlot<'_>]> = {
            let mut runs = vec![];
            let mut rest = slots;
            while let Some(((key, _), _)) = rest.split_first() {
                let first = row_of(*key);
                let mut last = first;
                let length = rest
                    .iter()
                    .take_while(|(key, _)| {
                        let row = row_of(*key);
                        let fits = row <= last + 1 && row - first < most;
                        last = if fits { row } else { last };
                        fits
                    })
                    .count();
                let (run, after) = rest.split_at_mut(length);
                runs.push(run);
                rest = after;
            }
            runs
        };
        let bounds = |run: &[RowSlot<'_>]| row_of(run[0].0)..row_of(run[run.len() - 1].0) + 1;
        let ranges: Vec<Range<u64>> = runs
            .iter()
            .map(|run| bounds(run))
            .map(|rows| address + rows.start * size..address + rows.end * size)
            .collect();
        let fetched = source.fetch(&ranges, false).map_err(|e| e.to_string())?;
        runs.into_par_iter().enumerate().try_for_each(|(i, run)| {
            let first = row_of(run[0].0);
            if let Some(bytes) = fetched.get(i) {
                return self.copy_rows(bytes, first, run, row_of);
            }
            if let ([(_, slot)], true) = (&mut *run, self.stored.is_plain()) {
                return source.read(ranges[i].start, slot).map_err(|e| e.to_string());
            }
            BUFFERS.with_borrow_mut(|buffers| {
                buffers.stored.resize((ranges[i].end - ranges[i].start) as usize, 0);
                source.read(ranges[i].start, &mut buffers.stored).map_err(|e| e.to_string())?;
                self.copy_rows(&buffers.stored, first, run, row_of)
            })
        })
    }

    /// Copies rows into their slots. `stored` starts with row `first`.
    fn copy_rows(
        &self,
        stored: &[u8],
        first: u64,
        slots: &mut [RowSlot<'_>],
        row_of: &impl Fn((usize, usize)) -> u64,
    ) -> Result<(), String> {
        let size = self.stored_row();
        for (key, slot) in slots {
            let at = (row_of(*key) - first) as usize * size;
            let row = stored.get(at..at + size).ok_or("its data is truncated")?;
            self.stored.convert(row, slot)?;
        }
        Ok(())
    }

    fn read_chunks(
        &self,
        source: &Source,
        (pipeline, fill): (&Pipeline, Option<&[u8]>),
        grid: &Grid,
        slots: &mut [RowSlot<'_>],
        row_of: &(impl Fn((usize, usize)) -> u64 + Sync),
    ) -> Result<(), String> {
        let index = self.index(source)?;
        let same_chunks = |a: &RowSlot<'_>, b: &RowSlot<'_>| row_of(a.0) / grid.rows == row_of(b.0) / grid.rows;
        // All chunks of a remote file are fetched together.
        let mut ranges: Vec<Range<u64>> = vec![];
        if source.is_remote() {
            let rows = slots.chunk_by(same_chunks).map(|group| row_of(group[0].0) / grid.rows);
            ranges.extend(rows.flat_map(|row| index.row(row, grid)).map(Chunk::range));
        }
        let fetched = source.fetch(&ranges, grid.rows > 1).map_err(|e| e.to_string())?;
        let fetched: HashMap<u64, Bytes> = ranges.iter().map(|range| range.start).zip(fetched).collect();
        let fetched = |chunk: &Chunk| fetched.get(&chunk.address);
        let groups: Vec<&mut [RowSlot<'_>]> = slots.chunk_by_mut(same_chunks).collect();
        groups.into_par_iter().with_max_len(1).try_for_each(|group| {
            let row = row_of(group[0].0) / grid.rows;
            if let Some((tail, decoded)) = &index.tail
                && *tail == row
            {
                return self.copy_rows(decoded, row * grid.rows, group, row_of);
            }
            BUFFERS.with_borrow_mut(|buffers| {
                let Buffers { stored, chunk, rows_buffer, scratch } = buffers;
                let chunks = index.row(row, grid);
                // In the common case, the chunk is one row that is requested once.
                if let ([found], [(_, slot)], true) = (chunks, &mut *group, self.stored.is_plain() && grid.is_row()) {
                    return read_chunk(source, pipeline, found, fetched(found), stored, scratch, slot);
                }
                rows_buffer.resize(grid.rows as usize * self.stored_row(), 0);
                if chunks.len() != grid.per_row() {
                    // Chunks that were never written.
                    let Some(fill) = fill else {
                        let first = row * grid.rows;
                        let all = catch_panic("reading its data", || self.dataset.read_raw_rows(first, grid.rows))?;
                        return self.copy_rows(&all, first, group, row_of);
                    };
                    rows_buffer.chunks_exact_mut(fill.len()).for_each(|element| element.copy_from_slice(fill));
                }
                for found in chunks {
                    if grid.covers_rows() {
                        read_chunk(source, pipeline, found, fetched(found), stored, scratch, rows_buffer)?;
                    } else {
                        chunk.resize(grid.chunk_bytes, 0);
                        read_chunk(source, pipeline, found, fetched(found), stored, scratch, chunk)?;
                        grid.copy_chunk(found.index, chunk, rows_buffer);
                    }
                }
                self.copy_rows(rows_buffer, row * grid.rows, group, row_of)
            })
        })
    }

    /// The index of chunks, read at the first access.
    fn index(&self, source: &Source) -> Result<&Index, String> {
        let Storage::Chunked { pipeline, rows, sides, index, .. } = &self.storage else {
            return Err("it has no chunks".to_owned());
        };
        let grid = Grid::new(*rows, sides, &self.spec.shape, self.stored.size);
        let index = index.get_or_init(|| self.read_index(source, pipeline, &grid));
        index.as_ref().map_err(Clone::clone)
    }

    fn read_index(&self, source: &Source, pipeline: &Pipeline, grid: &Grid) -> Result<Index, String> {
        let listed = catch_panic("listing its chunks", || self.dataset.chunks())?;
        let mut chunks = Vec::with_capacity(listed.len());
        for chunk in listed {
            let wrong_size = pipeline.is_empty() && chunk.storage_size != grid.chunk_bytes as u64;
            let (Ok(size), false) = (u32::try_from(chunk.storage_size), wrong_size) else {
                return Err(format!("a chunk of {} bytes is stored in {} bytes", grid.chunk_bytes, chunk.storage_size));
            };
            let inside = chunk.address.checked_add(size.into()).is_some_and(|end| source.reaches(end));
            if !inside {
                return Err(format!("a chunk lies at byte {}, beyond the end of the file", chunk.address));
            }
            let index = grid.chunk_index(&chunk.offset).ok_or("a chunk lies outside its grid")?;
            chunks.push(Chunk { index, address: chunk.address, size, filter_mask: chunk.filter_mask });
        }
        chunks.sort_unstable_by_key(|chunk| chunk.index);
        if chunks.windows(2).any(|pair| pair[0].index == pair[1].index) {
            return Err("two chunks have the same index".to_owned());
        }
        // Third-party files may be sparse, but a file without half of its chunks is more likely damaged.
        let expected = self.rows.div_ceil(grid.rows).saturating_mul(grid.per_row() as u64);
        let present = chunks.partition_point(|chunk| chunk.index < expected) as u64;
        if present < if self.written_here { expected } else { expected / 2 } {
            return Err(format!("only {present} of its {expected} chunks exist"));
        }
        let mut addresses: Vec<u64> = chunks.iter().map(|chunk| chunk.address).collect();
        addresses.sort_unstable();
        if addresses.windows(2).any(|pair| pair[0] == pair[1]) {
            return Err("two chunks have the same address".to_owned());
        }
        let mut index = Index { chunks, tail: None };
        if grid.rows > 1
            && grid.covers_rows()
            && !source.is_remote()
            && let Some(last) = index.chunks.last()
        {
            let mut decoded = vec![0; grid.chunk_bytes];
            let (mut stored, mut scratch) = (vec![], Scratch::default());
            read_chunk(source, pipeline, last, None, &mut stored, &mut scratch, &mut decoded)?;
            index.tail = Some((last.index, decoded));
        }
        Ok(index)
    }
}
