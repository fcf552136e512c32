//! Chunks of a dataset: the list of chunks, the grid that they form over the rows, and the reading of single chunks.

use super::filters::{Pipeline, Scratch};
use super::source::Source;
use crate::dataset::objects::Bytes;
use std::ops::Range;

/// The chunks, sorted by their index in the grid of chunks.
pub(super) struct Index {
    pub chunks: Vec<Chunk>,
    /// Grid row and decoded bytes of the last chunk, if each chunk holds several whole rows. Cached, because an active
    /// writer moves the last chunk.
    pub tail: Option<(u64, Vec<u8>)>,
}

/// A stored chunk.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chunk {
    /// Index in the grid.
    pub index: u64,
    /// Offset in the file, in bytes.
    pub address: u64,
    /// Stored size in bytes.
    pub size: u32,
    /// Bits of the filters that were skipped.
    pub filter_mask: u32,
}

/// Reads and decodes a chunk into `out`. `fetched` holds the stored bytes of the chunk if they are in memory already.
pub(super) fn read_chunk(
    source: &Source,
    pipeline: &Pipeline,
    chunk: &Chunk,
    fetched: Option<&Bytes>,
    stored: &mut Vec<u8>,
    scratch: &mut Scratch,
    out: &mut [u8],
) -> Result<(), String> {
    let in_chunk = |problem: String| format!("chunk {}: {problem}", chunk.index);
    if let Some(bytes) = fetched {
        return pipeline.decode(bytes, chunk.filter_mask, scratch, out).map_err(in_chunk);
    }
    if pipeline.is_empty() {
        return source.read(chunk.address, out).map_err(|e| in_chunk(e.to_string()));
    }
    stored.resize(chunk.size as usize, 0);
    source.read(chunk.address, stored).map_err(|e| in_chunk(e.to_string()))?;
    pipeline.decode(stored, chunk.filter_mask, scratch, out).map_err(in_chunk)
}

impl Chunk {
    /// Byte range in the file.
    pub fn range(&self) -> Range<u64> {
        self.address..self.address + u64::from(self.size)
    }
}

impl Index {
    /// The chunks of one row of the grid.
    pub fn row(&self, row: u64, grid: &Grid) -> &[Chunk] {
        let per_row = grid.per_row() as u64;
        let at = |index: u64| self.chunks.partition_point(|chunk| chunk.index < index);
        &self.chunks[at(row.saturating_mul(per_row))..at((row + 1).saturating_mul(per_row))]
    }
}

/// The grid in which chunks tile the rows.
pub(super) struct Grid<'a> {
    /// Rows per chunk.
    pub rows: u64,
    /// Side lengths of a chunk along the axes of a row, in elements.
    sides: &'a [usize],
    /// Shape of a row.
    shape: &'a [usize],
    /// Number of chunks along each axis of a row.
    counts: Vec<usize>,
    /// Size of an element in bytes.
    size: usize,
    /// Decoded size of a chunk in bytes.
    pub chunk_bytes: usize,
}

impl<'a> Grid<'a> {
    /// The grid of chunks with `rows` rows and side lengths `sides`, over rows of shape `shape` with elements of `size`
    /// bytes.
    pub fn new(rows: u64, sides: &'a [usize], shape: &'a [usize], size: usize) -> Self {
        let counts = shape.iter().zip(sides).map(|(whole, side)| whole.div_ceil(*side)).collect();
        let chunk_bytes = sides.iter().product::<usize>() * rows as usize * size;
        Self { rows, sides, shape, counts, size, chunk_bytes }
    }

    /// Number of chunks that a row is divided into.
    pub fn per_row(&self) -> usize {
        self.counts.iter().product()
    }

    /// Whether chunks hold whole rows.
    pub fn covers_rows(&self) -> bool {
        self.sides == self.shape
    }

    /// Whether every chunk is exactly one row.
    pub fn is_row(&self) -> bool {
        self.rows == 1 && self.covers_rows()
    }

    /// The index of the chunk at an offset (row, then element along each axis of the row); `None` outside the grid.
    pub fn chunk_index(&self, offset: &[u64]) -> Option<u64> {
        let (&row, offsets) = offset.split_first()?;
        let mut index = row / self.rows;
        for ((&offset, &side), &count) in offsets.iter().zip(self.sides).zip(&self.counts) {
            let at = offset / side as u64;
            if at >= count as u64 {
                return None;
            }
            index = index.checked_mul(count as u64)?.checked_add(at)?;
        }
        Some(index)
    }

    /// Copies a chunk into the buffer of its grid row.
    pub fn copy_chunk(&self, index: u64, chunk: &[u8], rows: &mut [u8]) {
        let mut rest = index as usize;
        let mut begin = vec![0; self.sides.len()];
        for axis in (0..self.sides.len()).rev() {
            begin[axis] = rest % self.counts[axis] * self.sides[axis];
            rest /= self.counts[axis];
        }
        // Copies runs along the last axis, one run for each combination of the indices along the other axes.
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
