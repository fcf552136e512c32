//! The layout of files that this module writes. It uses the oldest structures of HDF5 (superblock 0, object headers 1,
//! B-trees 1), which every version of the library reads. These structures have no checksums, so a commit can change a
//! single integer in place, and the file is valid at any time, even if the writer is killed.
//!
//! ```text
//! superblock                               end of the file
//! root group                               attribute: a reference to the record
//! B-tree, heap, and symbol table of the root group
//! headers of the record, of ep_len, of ep_offset, of the columns
//!                                          number of rows; address of the B-tree of chunks
//! chunks and nodes of B-trees, in order of writing
//! ```
//!
//! Constants and names follow the "HDF5 File Format Specification", version 3.0.

use super::filters::{fletcher32, id};
use super::source::Source;
use super::tree::read_u64;
use swm_core::{ColumnSpec, DType, Error, Result};

/// The address that stands for a missing object in HDF5.
pub(super) const UNDEFINED: u64 = u64::MAX;
/// The signature of HDF5 files.
pub(super) const SIGNATURE: [u8; 8] = *b"\x89HDF\r\n\x1a\n";
/// The bytes after the signature: versions, then the sizes of addresses and of lengths.
pub(super) const VERSIONS: [u8; 8] = [0, 0, 0, 0, 0, 8, 8, 0];
/// Offset of the end-of-file address in the superblock.
pub(super) const END_AT: u64 = 40;
/// Offset of the address of the root's B-tree in the superblock.
const ROOT_TREE_AT: u64 = 80;
/// Offset of the root group's header.
pub(super) const ROOT: u64 = 96;
/// Name of the root group's attribute that refers to the record.
const ATTRIBUTE: &str = "stable_worldmodel.record";
/// Spare bytes in the root's header, so that programs that add attributes do not move [`ATTRIBUTE`].
const SPARE_BYTES: usize = 64;
/// Minimum number of entries in a node of a group's B-tree; the library's default.
const GROUP_K: u16 = 16;

/// Chunk size in bytes for small rows.
const CHUNK_BYTES: usize = 8192;
/// Rows of at least this size in bytes are single chunks and are compressed.
const LARGE_ROW: usize = 1024;

/// Name of the dataset of episode lengths.
pub(super) const LENGTHS: &str = "ep_len";
/// Name of the dataset of the first rows of episodes.
pub(super) const OFFSETS: &str = "ep_offset";

/// Types of header messages.
mod message {
    pub const NOTHING: u16 = 0;
    pub const DATASPACE: u16 = 1;
    pub const DATATYPE: u16 = 3;
    pub const FILL_VALUE: u16 = 5;
    pub const LAYOUT: u16 = 8;
    pub const FILTERS: u16 = 11;
    pub const ATTRIBUTE: u16 = 12;
    pub const SYMBOL_TABLE: u16 = 17;
}

/// The header of an HDF5 dataset.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Table {
    pub spec: ColumnSpec,
    /// Rows per chunk.
    pub chunk_rows: usize,
    /// Whether chunks are compressed and hold one row each. All chunks have a checksum.
    pub compressed: bool,
    /// Offset in the file of the number of rows.
    pub rows_at: u64,
    /// Offset in the file of the address of the B-tree.
    pub tree_at: u64,
}

impl Table {
    fn new(spec: ColumnSpec) -> Self {
        let row = spec.row_bytes();
        let compressed = row >= LARGE_ROW;
        let chunk_rows = if compressed { 1 } else { 1 << (CHUNK_BYTES / row).ilog2() };
        Self { spec, chunk_rows, compressed, rows_at: 0, tree_at: 0 }
    }

    /// Sets the offsets for a dataset header at offset `at` of the file.
    fn set_header_offset(&mut self, at: u64) {
        let before: usize = messages(self)[..3].iter().map(|(_, data)| 8 + data.len()).sum();
        self.rows_at = at + 16 + 8 + 8;
        self.tree_at = at + 16 + before as u64 + 8 + 3;
    }

    /// Chunk size in bytes before compression and checksum.
    pub fn chunk_bytes(&self) -> usize {
        self.chunk_rows * self.spec.row_bytes()
    }

    /// Number of offsets in a B-tree key: one per axis of a chunk, and one within an element.
    pub fn sides(&self) -> usize {
        self.spec.shape.len() + 2
    }
}

/// The start of a file, before the chunks; its size is constant.
pub(super) struct Layout {
    /// The bytes of a file without episodes.
    pub bytes: Vec<u8>,
    /// The record, lengths and first rows of the episodes, then the columns.
    pub tables: Vec<Table>,
}

impl Layout {
    /// The layout for `columns`.
    ///
    /// # Errors
    /// If a name or a shape cannot be stored.
    pub fn new(columns: &[ColumnSpec]) -> Result<Self> {
        for column in columns {
            let problem = match &*column.name {
                "" | "." => "is not a valid name in an HDF5 file",
                LENGTHS | OFFSETS => "is reserved by the format",
                name if name.contains(['/', '\0']) => "contains characters that HDF5 names must not contain",
                _ if column.is_empty() => "has no elements",
                _ if column.row_bytes() > 64 << 20 || column.shape.len() > 30 => "has rows that are too large",
                _ => continue,
            };
            let problem = format!("the column '{}' {problem}", column.name);
            return Err(Error::config("schema", problem, "rename it, or leave it out"));
        }
        let counters = [(LENGTHS, DType::Int32), (OFFSETS, DType::Int64)];
        let tables: Vec<Table> = std::iter::once(ColumnSpec::new("", DType::U8, []))
            .chain(counters.map(|(name, dtype)| ColumnSpec::new(name, dtype, [])))
            .chain(columns.iter().cloned())
            .map(Table::new)
            .collect();
        Ok(Self::of(tables))
    }

    fn of(mut tables: Vec<Table>) -> Self {
        // The heap holds the names, each at a multiple of eight bytes; the first name is empty.
        let mut heap = vec![0; 8];
        let mut names: Vec<(&str, u64, usize)> = vec![];
        for (i, table) in tables.iter().enumerate().skip(1) {
            names.push((&table.spec.name, heap.len() as u64, i));
            heap.extend(table.spec.name.as_bytes());
            heap.resize((heap.len() + 1).next_multiple_of(8), 0);
        }
        names.sort_by_key(|(name, ..)| name.as_bytes());
        let last = names.last().map_or(0, |&(_, at, _)| at);
        let entries: Vec<(u64, usize)> = names.iter().map(|&(_, at, table)| (at, table)).collect();

        let leaf_k = entries.len().div_ceil(2).max(4);
        let root_size = 16 + header_size(&root_messages(0, 0, 0));
        let tree = ROOT + root_size as u64;
        let tree_size = 24 + 8 * (4 * u64::from(GROUP_K) + 1);
        let heap_at = tree + tree_size;
        let heap_data = heap_at + 32;
        let symbols = heap_data + heap.len() as u64;
        let mut at = symbols + 8 + 40 * 2 * leaf_k as u64;
        let mut headers = vec![];
        for table in &mut tables {
            // A header must not cross a 512-byte boundary, because commits change integers in the header in place.
            let bytes = header(&messages(table));
            if at % 512 + bytes.len() as u64 > 512 {
                at = at.next_multiple_of(512);
            }
            table.set_header_offset(at);
            headers.push((at, bytes));
            at += headers[headers.len() - 1].1.len() as u64;
        }

        let mut out = superblock(leaf_k as u16, at, tree, heap_at);
        out.extend(header(&root_messages(tree, heap_at, headers[0].0)));
        // The B-tree of the root group has one child.
        out.extend(b"TREE\0\0");
        out.extend(1_u16.to_le_bytes());
        for value in [UNDEFINED, UNDEFINED, 0, symbols, last] {
            out.extend(value.to_le_bytes());
        }
        out.resize(heap_at as usize, 0);
        out.extend(b"HEAP\0\0\0\0");
        // The value 1 means that there is no free list.
        for value in [heap.len() as u64, 1, heap_data] {
            out.extend(value.to_le_bytes());
        }
        out.extend(&heap);
        out.extend(b"SNOD\x01\0");
        out.extend((entries.len() as u16).to_le_bytes());
        for (name, table) in entries {
            out.extend(name.to_le_bytes());
            out.extend(headers[table].0.to_le_bytes());
            out.extend([0; 24]);
        }
        for (at, bytes) in headers {
            out.resize(at as usize, 0);
            out.extend(bytes);
        }
        Self { bytes: out, tables }
    }

    /// Whether `file` is the start of a file with this layout, apart from integers that change.
    pub fn matches_start(&self, file: &[u8]) -> bool {
        if file.len() != self.bytes.len() {
            return false;
        }
        let mut changing = vec![(END_AT, 8), (ROOT, 16), (ROOT + ROOT_BYTES, 8 + SPARE_BYTES as u64)];
        changing.extend(self.tables.iter().flat_map(|table| [(table.rows_at, 8), (table.tree_at, 8)]));
        changing.sort_unstable();
        let mut at = 0;
        changing.push((file.len() as u64, 0));
        changing.into_iter().all(|(begin, size)| {
            let same = file[at..begin as usize] == self.bytes[at..begin as usize];
            at = (begin + size) as usize;
            same
        })
    }
}

/// Size of the root's header without spare bytes.
const ROOT_BYTES: u64 = 16 + 8 + 16 + 8 + 8 + 32 + 8 + 8 + 8;

/// The record of a file that this module wrote; `None` for a third-party file.
///
/// # Errors
/// If the file is truncated.
pub(super) fn record(source: &Source) -> Result<Option<Table>, String> {
    let mut root = [0; ROOT_BYTES as usize];
    if source.size() < ROOT + ROOT_BYTES {
        return Ok(None);
    }
    source.read(ROOT, &mut root).map_err(|e| e.to_string())?;
    let read = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| root[at + i]));
    let (tree, heap, record) = (read(24), read(32), read(root.len() - 8));
    let expected = header(&root_messages(tree, heap, record));
    if root[16..] != expected[16..root.len()] {
        // No other program puts the root's B-tree at this address, which the superblock also contains.
        let address = ROOT + ROOT_BYTES + 8 + SPARE_BYTES as u64;
        if tree == address || read_u64(source, ROOT_TREE_AT)? == address {
            return Err("the header of its root is damaged, or another program changed it".to_owned());
        }
        return Ok(None);
    }
    let mut table = Table::new(ColumnSpec::new("", DType::U8, []));
    table.set_header_offset(record);
    Ok(Some(table))
}

fn superblock(leaf_k: u16, end: u64, tree: u64, heap: u64) -> Vec<u8> {
    let mut out = SIGNATURE.to_vec();
    out.extend(VERSIONS);
    out.extend(leaf_k.to_le_bytes());
    out.extend(GROUP_K.to_le_bytes());
    out.extend(0_u32.to_le_bytes());
    // Addresses of base, free space, end of file and drivers; then name and header of the root group.
    for value in [0, UNDEFINED, end, UNDEFINED, 0, ROOT, 1, tree, heap] {
        out.extend(value.to_le_bytes());
    }
    out
}

type Message = (u16, Vec<u8>);

fn header_size(messages: &[Message]) -> usize {
    messages.iter().map(|(_, data)| 8 + data.len()).sum()
}

/// An object header, version 1.
fn header(messages: &[Message]) -> Vec<u8> {
    let mut out = vec![1, 0];
    out.extend((messages.len() as u16).to_le_bytes());
    out.extend(1_u32.to_le_bytes());
    out.extend((header_size(messages) as u32).to_le_bytes());
    out.extend([0; 4]);
    for (kind, data) in messages {
        out.extend(kind.to_le_bytes());
        out.extend((data.len() as u16).to_le_bytes());
        // The flags declare type messages as constant.
        out.extend([u8::from(*kind == message::DATATYPE), 0, 0, 0]);
        out.extend(data);
    }
    out
}

fn root_messages(tree: u64, heap: u64, record: u64) -> Vec<Message> {
    let group = [tree, heap].iter().flat_map(|value| value.to_le_bytes()).collect();
    // The attribute is an object reference.
    let reference = [0x17, 0, 0, 0, 8, 0, 0, 0];
    let mut attribute = vec![1, 0];
    for size in [ATTRIBUTE.len() + 1, reference.len(), 8] {
        attribute.extend((size as u16).to_le_bytes());
    }
    attribute.extend(ATTRIBUTE.as_bytes());
    attribute.resize((attribute.len() + 1).next_multiple_of(8), 0);
    attribute.extend(reference);
    attribute.extend([1, 0, 0, 0, 0, 0, 0, 0]);
    attribute.extend(record.to_le_bytes());
    vec![(message::SYMBOL_TABLE, group), (message::ATTRIBUTE, attribute), (message::NOTHING, vec![0; SPARE_BYTES])]
}

/// The messages of a dataset; the layout is the fourth.
fn messages(table: &Table) -> Vec<Message> {
    let shape = &table.spec.shape;
    let rank = shape.len() as u8 + 1;
    let sides = |first: u64| std::iter::once(first).chain(shape.iter().map(|&side| side as u64));
    let mut dataspace = vec![1, rank, 1, 0, 0, 0, 0, 0];
    dataspace.extend(sides(0).chain(sides(UNDEFINED)).flat_map(u64::to_le_bytes));

    // The layout message has version 3 and declares chunks.
    let mut layout = vec![3, 2, rank + 1];
    layout.extend(UNDEFINED.to_le_bytes());
    let chunk = std::iter::once(table.chunk_rows).chain(shape.iter().copied()).chain([table.spec.dtype.size()]);
    layout.extend(chunk.flat_map(|side| (side as u32).to_le_bytes()));
    layout.resize(layout.len().next_multiple_of(8), 0);

    let mut filters = vec![1, 1 + u8::from(table.compressed), 0, 0, 0, 0, 0, 0];
    if table.compressed {
        // LZF is an optional filter: chunks that do not become smaller are stored uncompressed. The settings of LZF are
        // two versions and the chunk size.
        filter(&mut filters, id::LZF, b"lzf\0\0\0\0\0", 1, &[4, 0x105, table.chunk_bytes() as u32]);
    }
    filter(&mut filters, id::FLETCHER32, b"fletcher32\0\0\0\0\0\0", 0, &[]);
    vec![
        (message::DATASPACE, dataspace),
        (message::DATATYPE, datatype(table.spec.dtype)),
        // Space is allocated with each chunk; unwritten values read as 0.
        (message::FILL_VALUE, vec![2, 3, 2, 1, 0, 0, 0, 0]),
        (message::LAYOUT, layout),
        (message::FILTERS, filters),
    ]
}

fn filter(out: &mut Vec<u8>, id: u16, name: &[u8], flags: u16, settings: &[u32]) {
    for value in [id, name.len() as u16, flags, settings.len() as u16] {
        out.extend(value.to_le_bytes());
    }
    out.extend(name);
    settings.iter().for_each(|value| out.extend(value.to_le_bytes()));
    out.resize(out.len().next_multiple_of(8), 0);
}

/// The header message that declares a numeric type.
fn datatype(dtype: DType) -> Vec<u8> {
    let integer = |signed: u8, size: u8| vec![0x10, signed << 3, 0, 0, size, 0, 0, 0, 0, 0, size * 8, 0, 0, 0, 0, 0];
    let float = |size: u8, sign: u8, [exponent, exponent_bits, fraction_bits]: [u8; 3], bias: u32| {
        let mut out =
            vec![0x11, 0x20, sign, 0, size, 0, 0, 0, 0, 0, size * 8, 0, exponent, exponent_bits, 0, fraction_bits];
        out.extend(bias.to_le_bytes());
        out.extend([0; 4]);
        out
    };
    match dtype {
        DType::Bool => {
            // An enumeration of FALSE and TRUE over a signed byte, as h5py stores booleans.
            let mut out = vec![0x18, 2, 0, 0, 1, 0, 0, 0, 0x10, 8, 0, 0, 1, 0, 0, 0, 0, 0, 8, 0];
            out.extend(b"FALSE\0\0\0TRUE\0\0\0\0\0\x01");
            out.resize(out.len().next_multiple_of(8), 0);
            out
        }
        DType::U8 => integer(0, 1),
        DType::Int32 => integer(1, 4),
        DType::Int64 => integer(1, 8),
        DType::Float32 => float(4, 31, [23, 8, 23], 127),
        DType::Float64 => float(8, 63, [52, 11, 52], 1023),
    }
}

/// Stored size of an uncompressed chunk in bytes, including the checksum.
pub(super) fn stored_chunk_bytes(table: &Table) -> usize {
    table.chunk_bytes() + fletcher32::SIZE
}
