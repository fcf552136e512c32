//! One column: where the chunks of its dataset are, and how the rows that a batch wants are read from them.

use super::filters::{Pipeline, Scratch};
use super::source::Source;
use crate::dataset::episodes::RowSlot;
use crate::dataset::objects::Bytes;
use crate::formats::stored_scalar::{Class, StoredScalar};
use hdf5_pure::{Dataset, Datatype, DatatypeByteOrder, FloatingPointLayout, Layout};
use rayon::prelude::*;
use std::cell::RefCell;
use std::collections::HashMap;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::OnceLock;
use swm_core::ColumnSpec;

/// Chunks larger than this are refused: nobody writes them, and damaged files promise any size.
const MAX_CHUNK_BYTES: u64 = 128 << 20;

/// Bytes of a contiguous dataset that are read at once.
const RUN_BYTES: u64 = 1 << 20;

thread_local! {
    static BUFFERS: RefCell<Buffers> = RefCell::default();
}

/// Memory of a thread for reading chunks.
#[derive(Default)]
struct Buffers {
    stored: Vec<u8>,
    chunk: Vec<u8>,
    numbers: Vec<u8>,
    scratch: Scratch,
}

/// A dataset of rows.
pub(super) struct Column {
    pub spec: ColumnSpec,
    /// How many rows it has.
    pub rows: u64,
    dataset: Dataset,
    stored: StoredScalar,
    storage: Storage,
    /// Whether we wrote it: then every chunk is there.
    pub written_here: bool,
}

enum Storage {
    /// One row after another from this byte on, or in the dataset's header.
    Contiguous(Option<u64>),
    Compact,
    Chunked {
        pipeline: Pipeline,
        /// Rows of a chunk, and its sides within a row.
        rows: u64,
        sides: Vec<usize>,
        index: OnceLock<Result<Index, String>>,
    },
}

/// Where the chunks are, by their slot in the grid of chunks.
struct Index {
    chunks: Vec<Chunk>,
    /// The decoded last row of chunks, when its chunks hold several rows: a writer at work moves it.
    tail: Option<(u64, Vec<u8>)>,
}

#[derive(Clone, Copy, Debug)]
struct Chunk {
    /// Its number in the grid.
    number: u64,
    address: u64,
    size: u32,
    filter_mask: u32,
}

/// Runs code of `hdf5-pure`, in which a damaged file may provoke a panic.
pub(super) fn catch_panic<T, E: std::fmt::Display>(
    what: &str,
    code: impl FnOnce() -> Result<T, E>,
) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(code)) {
        Ok(result) => result.map_err(|e| format!("{what}: {e}")),
        Err(_) => Err(format!("{what}: the library that reads HDF5 gave up on it")),
    }
}

/// The number type of a dataset; none for text and records.
fn scalar_type(datatype: &Datatype) -> Option<StoredScalar> {
    let (class, size, order) = match datatype {
        Datatype::FixedPoint { size, byte_order, layout } => {
            if layout.bit_offset != 0 || u32::from(layout.bit_precision) != size * 8 {
                return None;
            }
            (if layout.signed { Class::Signed } else { Class::Unsigned }, *size, *byte_order)
        }
        Datatype::FloatingPoint { size, byte_order, layout } => {
            // IEEE 754, of 16, 32 or 64 bits.
            let half = FloatingPointLayout {
                bit_precision: 16,
                exponent_location: 10,
                exponent_size: 5,
                mantissa_size: 10,
                exponent_bias: 15,
                ..FloatingPointLayout::IEEE754_BINARY32
            };
            let known =
                [(2, half), (4, FloatingPointLayout::IEEE754_BINARY32), (8, FloatingPointLayout::IEEE754_BINARY64)];
            if !known.contains(&(*size, *layout)) {
                return None;
            }
            (Class::Float, *size, *byte_order)
        }
        // What h5py makes of booleans.
        Datatype::Enumeration { size: 1, members, .. } if members.len() == 2 => {
            (Class::Bool, 1, DatatypeByteOrder::LittleEndian)
        }
        Datatype::Enumeration { base_type, .. } => return scalar_type(base_type),
        _ => return None,
    };
    let big_endian = match order {
        DatatypeByteOrder::LittleEndian => false,
        DatatypeByteOrder::BigEndian => true,
        DatatypeByteOrder::Vax => return None,
    };
    let stored = StoredScalar { class, size: size as usize, big_endian };
    stored.dtype().map(|_| stored)
}

impl Column {
    /// A dataset as a column of its rows; `None` when it holds no numbers.
    ///
    /// # Errors
    /// When it is damaged, or stored in a way that is not understood.
    pub fn new(name: &str, dataset: Dataset, file_size: u64) -> Result<Option<Self>, String> {
        let Some(stored) = scalar_type(&catch_panic("its type", || dataset.datatype())?) else { return Ok(None) };
        let Some(dtype) = stored.dtype() else { return Ok(None) };
        let shape = catch_panic("its shape", || dataset.shape())?;
        let Some((&rows, sides)) = shape.split_first() else { return Ok(None) };
        let sides: Vec<usize> = sides.iter().map(|&side| side as usize).collect();
        let row_bytes = sides.iter().try_fold(dtype.size() as u64, |n, &side| n.checked_mul(side as u64));
        if row_bytes == Some(0) {
            return Ok(None);
        }
        if row_bytes.is_none_or(|n| n > MAX_CHUNK_BYTES) {
            return Err(format!("its rows have the shape {sides:?}, which is too large"));
        }
        let layout = catch_panic("its layout", || dataset.layout()).map_err(|problem| match problem {
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
                Storage::Contiguous(address)
            }
            Layout::Compact { .. } => Storage::Compact,
            Layout::Chunked { chunk_shape, .. } => {
                let filters = catch_panic("its filters", || Ok::<_, String>(dataset.filter_pipeline()))?;
                let pipeline = Pipeline::new(&filters, stored.size)?;
                let bytes = chunk_shape.iter().try_fold(stored.size as u64, |n, &side| n.checked_mul(side));
                let block = row_bytes.and_then(|n| n.checked_mul(*chunk_shape.first()?));
                let fits = |n: Option<u64>| n.is_some_and(|n| (1..=MAX_CHUNK_BYTES).contains(&n));
                if chunk_shape.len() != shape.len() || !fits(bytes) || !fits(block) {
                    return Err(format!("its chunks have the shape {chunk_shape:?}, which is too large"));
                }
                // A chunk takes some bytes of the file, if only in the list of chunks.
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
                    index: OnceLock::new(),
                }
            }
            other => return Err(format!("its data are {other}, which is not read")),
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

    /// Whether numbers are stored as we store them.
    pub fn is_plain(&self) -> bool {
        self.stored.is_plain()
    }

    /// Bytes of a stored row.
    fn stored_row(&self) -> usize {
        self.spec.len() * self.stored.size
    }

    /// Bytes in the file.
    pub fn footprint(&self, source: &Source) -> Result<u64, String> {
        match &self.storage {
            Storage::Contiguous(_) | Storage::Compact => Ok(self.rows * self.stored_row() as u64),
            Storage::Chunked { .. } => Ok(self.index(source)?.chunks.iter().map(|chunk| u64::from(chunk.size)).sum()),
        }
    }

    /// All rows, as the column holds them.
    ///
    /// # Errors
    /// When they are damaged.
    pub fn read_all(&self, source: &Source) -> Result<Vec<u8>, String> {
        let size = self.spec.row_bytes();
        let mut all = vec![0; self.rows as usize * size];
        let mut slots: Vec<RowSlot<'_>> =
            all.chunks_exact_mut(size).enumerate().map(|(row, slot)| ((0, row), slot)).collect();
        self.read(source, &mut slots, |(_, row)| row as u64)?;
        Ok(all)
    }

    /// Reads rows of the table, each to its slot. They are sorted by `row_of` their keys.
    ///
    /// # Errors
    /// When they are damaged.
    pub fn read(
        &self,
        source: &Source,
        slots: &mut [RowSlot<'_>],
        row_of: impl Fn((usize, usize)) -> u64 + Sync,
    ) -> Result<(), String> {
        match &self.storage {
            Storage::Compact => {
                let all = catch_panic("its data", || self.dataset.read_raw())?;
                self.copy_rows(&all, 0, slots, &row_of)
            }
            Storage::Contiguous(None) => {
                slots.iter_mut().for_each(|(_, slot)| slot.fill(0));
                Ok(())
            }
            Storage::Contiguous(Some(address)) => self.read_contiguous(source, *address, slots, &row_of),
            Storage::Chunked { pipeline, rows, sides, .. } => {
                let grid = Grid::new(*rows, sides, self);
                self.read_chunks(source, pipeline, &grid, slots, &row_of)
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
        // Runs of rows that follow each other, each read in one go.
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
        let fetched = source.fetch(&ranges).map_err(|e| e.to_string())?;
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

    /// Copies slots rows from stored ones, the first of which is row `first`.
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
            let row = stored.get(at..at + size).ok_or("its data are cut off")?;
            self.stored.convert(row, slot)?;
        }
        Ok(())
    }

    fn read_chunks(
        &self,
        source: &Source,
        pipeline: &Pipeline,
        grid: &Grid,
        slots: &mut [RowSlot<'_>],
        row_of: &(impl Fn((usize, usize)) -> u64 + Sync),
    ) -> Result<(), String> {
        let index = self.index(source)?;
        let same_chunks = |a: &RowSlot<'_>, b: &RowSlot<'_>| row_of(a.0) / grid.rows == row_of(b.0) / grid.rows;
        // From far away, all chunks are fetched at once.
        let mut ranges: Vec<Range<u64>> = vec![];
        if source.is_remote() {
            let rows = slots.chunk_by(same_chunks).map(|group| row_of(group[0].0) / grid.rows);
            ranges.extend(rows.flat_map(|row| index.row(row, grid)).map(Chunk::range));
        }
        let fetched = source.fetch(&ranges).map_err(|e| e.to_string())?;
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
                let Buffers { stored, chunk, numbers, scratch } = buffers;
                let chunks = index.row(row, grid);
                // The usual case: the chunk is the row, slots once.
                if let ([found], [(_, slot)], true) = (chunks, &mut *group, self.stored.is_plain() && grid.is_row()) {
                    return read_chunk(source, pipeline, found, fetched(found), stored, scratch, slot);
                }
                numbers.resize(grid.rows as usize * self.stored_row(), 0);
                if chunks.len() != grid.per_row() {
                    // Never written: numbers that nobody set.
                    numbers.fill(0);
                }
                for found in chunks {
                    if grid.covers_rows() {
                        read_chunk(source, pipeline, found, fetched(found), stored, scratch, numbers)?;
                    } else {
                        chunk.resize(grid.chunk_bytes, 0);
                        read_chunk(source, pipeline, found, fetched(found), stored, scratch, chunk)?;
                        grid.copy_chunk(found.number, chunk, numbers);
                    }
                }
                self.copy_rows(numbers, row * grid.rows, group, row_of)
            })
        })
    }

    /// Where the chunks are. Read when it is first asked for.
    fn index(&self, source: &Source) -> Result<&Index, String> {
        let Storage::Chunked { pipeline, rows, sides, index } = &self.storage else {
            return Err("it has no chunks".to_owned());
        };
        let grid = Grid::new(*rows, sides, self);
        let index = index.get_or_init(|| self.read_index(source, pipeline, &grid));
        index.as_ref().map_err(Clone::clone)
    }

    fn read_index(&self, source: &Source, pipeline: &Pipeline, grid: &Grid) -> Result<Index, String> {
        let listed = catch_panic("the list of its chunks", || self.dataset.chunks())?;
        let mut chunks = Vec::with_capacity(listed.len());
        for chunk in listed {
            let whole = pipeline.is_empty() && chunk.storage_size != grid.chunk_bytes as u64;
            let (Ok(size), false) = (u32::try_from(chunk.storage_size), whole) else {
                return Err(format!("a chunk of {} bytes is stored in {}", grid.chunk_bytes, chunk.storage_size));
            };
            let inside = chunk.address.checked_add(size.into()).is_some_and(|end| end <= source.size());
            if !inside {
                return Err(format!("a chunk lies at byte {}, beyond the end of the file", chunk.address));
            }
            let number = grid.number(&chunk.offset).ok_or("a chunk lies outside its grid")?;
            chunks.push(Chunk { number, address: chunk.address, size, filter_mask: chunk.filter_mask });
        }
        chunks.sort_unstable_by_key(|chunk| chunk.number);
        if chunks.windows(2).any(|pair| pair[0].number == pair[1].number) {
            return Err("two chunks are in the same slot".to_owned());
        }
        // Files of others may be sparse, though more often they are damaged.
        let expected = self.rows.div_ceil(grid.rows).saturating_mul(grid.per_row() as u64);
        let present = chunks.partition_point(|chunk| chunk.number < expected) as u64;
        if present < if self.written_here { expected } else { expected / 2 } {
            return Err(format!("of its {expected} chunks there are {present}"));
        }
        let mut addresses: Vec<u64> = chunks.iter().map(|chunk| chunk.address).collect();
        addresses.sort_unstable();
        if addresses.windows(2).any(|pair| pair[0] == pair[1]) {
            return Err("two chunks lie in the same slot of the file".to_owned());
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
            index.tail = Some((last.number, decoded));
        }
        Ok(index)
    }
}

fn read_chunk(
    source: &Source,
    pipeline: &Pipeline,
    chunk: &Chunk,
    fetched: Option<&Bytes>,
    stored: &mut Vec<u8>,
    scratch: &mut Scratch,
    out: &mut [u8],
) -> Result<(), String> {
    let within = |problem: String| format!("chunk {}: {problem}", chunk.number);
    if let Some(bytes) = fetched {
        return pipeline.decode(bytes, chunk.filter_mask, scratch, out).map_err(within);
    }
    if pipeline.is_empty() {
        return source.read(chunk.address, out).map_err(|e| within(e.to_string()));
    }
    stored.resize(chunk.size as usize, 0);
    source.read(chunk.address, stored).map_err(|e| within(e.to_string()))?;
    pipeline.decode(stored, chunk.filter_mask, scratch, out).map_err(within)
}

impl Chunk {
    fn range(&self) -> Range<u64> {
        self.address..self.address + u64::from(self.size)
    }
}

impl Index {
    /// The chunks of a row of the grid.
    fn row(&self, row: u64, grid: &Grid) -> &[Chunk] {
        let per_row = grid.per_row() as u64;
        let at = |number: u64| self.chunks.partition_point(|chunk| chunk.number < number);
        &self.chunks[at(row.saturating_mul(per_row))..at((row + 1).saturating_mul(per_row))]
    }
}

/// How chunks tile the rows.
struct Grid<'a> {
    /// Rows of a chunk.
    rows: u64,
    /// Its sides within a row, and the row's.
    sides: &'a [usize],
    shape: &'a [usize],
    /// Chunks along each side.
    counts: Vec<usize>,
    size: usize,
    chunk_bytes: usize,
}

impl<'a> Grid<'a> {
    fn new(rows: u64, sides: &'a [usize], column: &'a Column) -> Self {
        let shape = &column.spec.shape;
        let counts = shape.iter().zip(sides).map(|(whole, side)| whole.div_ceil(*side)).collect();
        let size = column.stored.size;
        let chunk_bytes = sides.iter().product::<usize>() * rows as usize * size;
        Self { rows, sides, shape, counts, size, chunk_bytes }
    }

    /// How many chunks a row is cut into.
    fn per_row(&self) -> usize {
        self.counts.iter().product()
    }

    /// Whether a chunk holds whole rows and nothing else.
    fn covers_rows(&self) -> bool {
        self.sides == self.shape
    }

    /// Whether a chunk is a row.
    fn is_row(&self) -> bool {
        self.rows == 1 && self.covers_rows()
    }

    /// The number of the chunk that begins there.
    fn number(&self, offset: &[u64]) -> Option<u64> {
        let (&row, offsets) = offset.split_first()?;
        let mut number = row / self.rows;
        for ((&offset, &side), &count) in offsets.iter().zip(self.sides).zip(&self.counts) {
            let at = offset / side as u64;
            if at >= count as u64 {
                return None;
            }
            number = number.checked_mul(count as u64)?.checked_add(at)?;
        }
        Some(number)
    }

    /// Copies what a chunk holds to its slot in the rows of the grid's row.
    fn copy_chunk(&self, number: u64, chunk: &[u8], rows: &mut [u8]) {
        let mut rest = number as usize;
        let mut begin = vec![0; self.sides.len()];
        for axis in (0..self.sides.len()).rev() {
            begin[axis] = rest % self.counts[axis] * self.sides[axis];
            rest /= self.counts[axis];
        }
        // Runs along the last side, one for each combination of the others.
        let Some((&last, outer)) = self.sides.split_last() else { return };
        let axis = outer.len();
        let run = last.min(self.shape[axis] - begin[axis]) * self.size;
        let row_bytes = self.shape.iter().product::<usize>() * self.size;
        for (i, source) in chunk.chunks_exact(last * self.size).enumerate() {
            let (mut rest, mut at, mut stride) = (i, begin[axis] * self.size, self.shape[axis] * self.size);
            let mut inside = true;
            for axis in (0..outer.len()).rev() {
                let position = begin[axis] + rest % self.sides[axis];
                inside &= position < self.shape[axis];
                at += position * stride;
                stride *= self.shape[axis];
                rest /= self.sides[axis];
            }
            if inside {
                at += rest * row_bytes;
                rows[at..at + run].copy_from_slice(&source[..run]);
            }
        }
    }
}
