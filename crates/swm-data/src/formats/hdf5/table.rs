//! Writes one HDF5 dataset: stores rows in chunks, which the next commit makes visible to readers.

use super::filters::{fletcher32, lzf};
use super::layout::{Table, stored_chunk_bytes};
use super::source::Source;
use super::tree::{Entry, Tree, read_u64};
use rayon::prelude::*;
use std::cell::RefCell;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;

/// Filter mask of a chunk that is stored without LZF, the first filter.
const NOT_COMPRESSED: u32 = 1;

/// Size in bytes of the regions in which nodes of B-trees are allocated together.
const NODE_REGION: u64 = 32 << 10;

thread_local! {
    static ENCODER: RefCell<lzf::Encoder> = RefCell::default();
}

/// Allocates space at the end of the file.
#[derive(Clone)]
pub(super) struct Space {
    /// Offset of the end of the file, in bytes.
    pub end: u64,
    /// Unused part of the latest region for nodes.
    nodes: std::ops::Range<u64>,
}

impl Space {
    pub fn new(end: u64) -> Self {
        Self { end: end.next_multiple_of(8), nodes: 0..0 }
    }

    fn take(&mut self, size: usize) -> u64 {
        let at = self.end;
        self.end = (at + size as u64).next_multiple_of(8);
        at
    }

    fn take_node(&mut self, size: usize) -> u64 {
        let size = size.next_multiple_of(8) as u64;
        if self.nodes.end - self.nodes.start < size {
            let at = self.take(NODE_REGION.max(size) as usize);
            self.nodes = at..self.end;
        }
        self.nodes.start += size;
        self.nodes.start - size
    }
}

/// Appends the rows of a dataset.
pub(super) struct TableWriter {
    pub table: Table,
    /// The stored rows, without the buffers that are used while rows are appended.
    pub state: TableState,
    /// Encoded chunks of an episode.
    encoded: Vec<Vec<u8>>,
    /// Bytes of the current write; the buffer is reused.
    writing: Vec<u8>,
}

/// The rows of a dataset and where the file holds them. Restoring an earlier state removes later rows, as long as no
/// commit wrote them.
#[derive(Clone)]
pub(super) struct TableState {
    rows: u64,
    tree: Tree,
    /// Rows of the incomplete chunk.
    open: Vec<u8>,
    /// Number of bytes of `open` that the file contains.
    stored: usize,
    /// Addresses of previous versions of incomplete chunks, which may be overwritten.
    free: Vec<u64>,
    /// Addresses that may be overwritten after the next commit.
    free_after_commit: Vec<u64>,
}

impl TableWriter {
    pub fn new(table: Table) -> Self {
        let tree = Tree::new(&table);
        let state = TableState { rows: 0, tree, open: vec![], stored: 0, free: vec![], free_after_commit: vec![] };
        Self { table, state, encoded: vec![], writing: vec![] }
    }

    /// Continues a dataset after its first `rows` rows.
    ///
    /// # Errors
    /// If the dataset is damaged.
    pub fn load(table: Table, source: &Source, rows: u64) -> Result<Self, String> {
        let tree = Tree::load(&table, source, rows)?;
        let mut writer = Self::new(table);
        (writer.state.rows, writer.state.tree) = (rows, tree);
        if let Some(last) = writer.state.tree.last()
            && last.row + writer.table.chunk_rows as u64 > rows
        {
            writer.state.open = read_chunk(&writer.table, source, &last)?;
            writer.state.open.truncate((rows - last.row) as usize * writer.table.spec.row_bytes());
            writer.state.stored = writer.state.open.len();
        }
        Ok(writer)
    }

    /// Appends rows. Complete chunks are written immediately.
    pub fn append(&mut self, file: &File, space: &mut Space, rows: &[u8]) -> io::Result<()> {
        self.state.rows += (rows.len() / self.table.spec.row_bytes()) as u64;
        if self.table.compressed {
            return self.append_compressed(file, space, rows);
        }
        let mut rest = rows;
        while !rest.is_empty() {
            let (now, later) = rest.split_at(rest.len().min(self.table.chunk_bytes() - self.state.open.len()));
            self.state.open.extend(now);
            rest = later;
            if self.state.open.len() == self.table.chunk_bytes() {
                self.store_open(file, space)?;
                self.state.open.clear();
                self.state.stored = 0;
            }
        }
        Ok(())
    }

    fn append_compressed(&mut self, file: &File, space: &mut Space, rows: &[u8]) -> io::Result<()> {
        let size = self.table.spec.row_bytes();
        let count = rows.len() / size;
        if self.encoded.len() < count {
            self.encoded.resize_with(count, Vec::new);
        }
        let smaller: Vec<bool> = rows
            .par_chunks_exact(size)
            .zip(&mut self.encoded)
            .with_max_len(1)
            .map(|(row, out)| {
                out.clear();
                let smaller = ENCODER.with_borrow_mut(|encoder| encoder.encode(row, out));
                if !smaller {
                    out.extend(row);
                }
                out.extend(fletcher32::sum(out).to_le_bytes());
                smaller
            })
            .collect();
        let total: usize = self.encoded[..count].iter().map(Vec::len).sum();
        let mut address = space.take(total);
        self.writing.clear();
        self.encoded[..count].iter().for_each(|chunk| self.writing.extend(chunk));
        file.write_all_at(&self.writing, address)?;
        let first = self.state.rows - count as u64;
        for ((chunk, smaller), row) in self.encoded.iter().zip(smaller).zip(first..) {
            let filter_mask = if smaller { 0 } else { NOT_COMPRESSED };
            let entry = Entry { size: chunk.len() as u32, filter_mask, row, address };
            self.state.tree.push(entry, &mut |size| space.take_node(size));
            address += chunk.len() as u64;
        }
        Ok(())
    }

    /// Writes the incomplete chunk to a free address or to the end of the file.
    fn store_open(&mut self, file: &File, space: &mut Space) -> io::Result<()> {
        let size = stored_chunk_bytes(&self.table);
        let address = self.state.free.pop().unwrap_or_else(|| space.take(size));
        self.writing.clear();
        self.writing.extend(&self.state.open);
        self.writing.resize(self.table.chunk_bytes(), 0);
        self.writing.extend(fletcher32::sum(&self.writing).to_le_bytes());
        file.write_all_at(&self.writing, address)?;
        if self.state.stored > 0 {
            self.state.free_after_commit.extend(self.state.tree.move_last(address));
        } else {
            let row = self.state.tree.last().map_or(0, |last| last.row + self.table.chunk_rows as u64);
            let entry = Entry { size: size as u32, filter_mask: 0, row, address };
            self.state.tree.push(entry, &mut |size| space.take_node(size));
        }
        self.state.stored = self.state.open.len();
        Ok(())
    }

    /// Writes the incomplete chunk and the new nodes of the B-tree, which the file does not refer to yet.
    pub fn write_new(&mut self, file: &File, space: &mut Space) -> io::Result<()> {
        if self.state.open.len() > self.state.stored {
            self.store_open(file, space)?;
        }
        self.state.tree.write_new(file)
    }

    /// Updates the B-tree in the file.
    pub fn write_changes(&mut self, file: &File) -> io::Result<()> {
        self.state.tree.write_changes(file)
    }

    /// Updates the number of rows in the file.
    pub fn write_rows(&mut self, file: &File) -> io::Result<()> {
        file.write_all_at(&self.state.rows.to_le_bytes(), self.table.rows_at)?;
        self.state.free.append(&mut self.state.free_after_commit);
        Ok(())
    }
}

/// Reads all rows of an uncompressed dataset that [`TableWriter`] wrote.
///
/// # Errors
/// If the dataset is damaged.
pub(super) fn read_all(table: &Table, source: &Source) -> Result<Vec<u8>, String> {
    let rows = read_u64(source, table.rows_at)?;
    let size = table.spec.row_bytes();
    let mut all = vec![];
    for entry in Tree::chunks(table, source)? {
        if entry.row != (all.len() / size) as u64 {
            return Err(format!("a chunk starts at row {} instead of {}", entry.row, all.len() / size));
        }
        all.extend(read_chunk(table, source, &entry)?);
    }
    let expected = usize::try_from(rows).ok().and_then(|rows| rows.checked_mul(size));
    let Some(expected) = expected.filter(|&expected| expected <= all.len()) else {
        return Err(format!("it has {rows} rows, but its chunks hold {}", all.len() / size));
    };
    all.truncate(expected);
    Ok(all)
}

fn read_chunk(table: &Table, source: &Source, entry: &Entry) -> Result<Vec<u8>, String> {
    if entry.size as usize != stored_chunk_bytes(table) || entry.filter_mask != 0 {
        return Err(format!("a chunk has {} bytes instead of {}", entry.size, stored_chunk_bytes(table)));
    }
    let mut bytes = vec![0; entry.size as usize];
    source.read(entry.address, &mut bytes).map_err(|e| e.to_string())?;
    let summed = fletcher32::check(&bytes)?;
    bytes.truncate(summed);
    Ok(bytes)
}
