//! The B-tree (version 1) of a dataset's chunks. It only grows at its right edge.
//!
//! A node has room for 64 children. Each child is preceded by the key of its first chunk (size, skipped filters, offset
//! along every side); a key beyond all chunks follows the last child. A commit first writes new nodes, to which the
//! file does not refer yet. It then appends children to existing nodes, and finally updates child counts and the root.

use super::layout::{Table, UNDEFINED};
use super::source::Source;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt as _;

/// Maximum number of children of a node: `2 K`, with the HDF5 library's default `K` of 32.
const MAX_CHILDREN: usize = 64;

/// An entry of a node: a chunk, or a node one level below, identified by its first chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Entry {
    /// Stored size of the (first) chunk in bytes.
    pub size: u32,
    /// Bits of the filters that were skipped for the (first) chunk.
    pub filter_mask: u32,
    /// First row of the (first) chunk.
    pub row: u64,
    /// Offset of the chunk or node in the file, in bytes.
    pub address: u64,
}

/// A node on the right edge, or a node that was completed since the last commit.
#[derive(Clone)]
struct Node {
    address: u64,
    /// 0 for a leaf.
    level: u8,
    /// Address of the left sibling.
    left: u64,
    /// Address of the right sibling.
    right: u64,
    entries: Vec<Entry>,
    /// The first row after the chunks of the node.
    end: u64,
    /// Number of entries in the file; `None` if the node is not written yet.
    written: Option<usize>,
    /// Whether the address of the last written entry changed.
    moved: bool,
}

/// The B-tree of a dataset's chunks.
#[derive(Clone)]
pub(super) struct Tree {
    /// See [`Table::sides`].
    sides: usize,
    chunk_rows: u64,
    /// Offset in the file of the root's address.
    root_at: u64,
    /// Stored address of the root.
    root: u64,
    /// Nodes of the right edge, leaf first.
    edge: Vec<Node>,
    /// Nodes that were completed since the last commit.
    full: Vec<Node>,
}

impl Tree {
    /// The tree of a dataset without chunks.
    pub fn new(table: &Table) -> Self {
        let chunk_rows = table.chunk_rows as u64;
        Self { sides: table.sides(), chunk_rows, root_at: table.tree_at, root: UNDEFINED, edge: vec![], full: vec![] }
    }

    /// Loads the right edge of a tree, up to the chunks before row `rows`.
    ///
    /// # Errors
    /// If the tree is damaged.
    pub fn load(table: &Table, source: &Source, rows: u64) -> Result<Self, String> {
        let mut tree = Self::new(table);
        tree.root = read_u64(source, tree.root_at)?;
        let mut next = tree.root;
        while next != UNDEFINED {
            let mut node = tree.read(source, next)?;
            if tree.edge.last().is_some_and(|above| above.level != node.level + 1) {
                return Err(format!("a node of level {} does not match the level of its parent", node.level));
            }
            let before = node.entries.iter().take_while(|entry| entry.row < rows).count();
            // Inner nodes always have a child.
            node.entries.truncate(if node.level > 0 { before.max(1) } else { before });
            node.written = Some(node.entries.len());
            node.right = UNDEFINED;
            next = if node.level > 0 { node.entries[node.entries.len() - 1].address } else { UNDEFINED };
            tree.edge.push(node);
        }
        tree.edge.reverse();
        let end = tree.last().map_or(0, |last| last.row + tree.chunk_rows);
        if end < rows || end.saturating_sub(rows) >= tree.chunk_rows {
            return Err(format!("its chunks end before row {end} instead of row {rows}"));
        }
        tree.edge.iter_mut().for_each(|node| node.end = end);
        Ok(tree)
    }

    /// The last chunk.
    pub fn last(&self) -> Option<Entry> {
        self.edge.first()?.entries.last().copied()
    }

    /// Appends a chunk. `allocate` returns addresses for new nodes.
    pub fn push(&mut self, entry: Entry, allocate: &mut impl FnMut(usize) -> u64) {
        self.insert(0, entry, allocate);
        let end = entry.row + self.chunk_rows;
        self.edge.iter_mut().for_each(|node| node.end = end);
    }

    fn insert(&mut self, level: usize, entry: Entry, allocate: &mut impl FnMut(usize) -> u64) {
        let size = self.node_bytes();
        let fresh = |left: u64, address: u64| Node {
            address,
            level: level as u8,
            left,
            right: UNDEFINED,
            entries: vec![],
            end: 0,
            written: None,
            moved: false,
        };
        if level == self.edge.len() {
            self.edge.push(fresh(UNDEFINED, allocate(size)));
        }
        if self.edge[level].entries.len() == MAX_CHILDREN {
            let (left, first) = (self.edge[level].address, self.edge[level].entries[0]);
            if level + 1 == self.edge.len() {
                self.insert(level + 1, Entry { address: left, ..first }, allocate);
            }
            let address = allocate(size);
            let mut node = std::mem::replace(&mut self.edge[level], fresh(left, address));
            (node.right, node.end) = (address, entry.row);
            self.full.push(node);
            self.insert(level + 1, Entry { address, ..entry }, allocate);
        }
        self.edge[level].entries.push(entry);
    }

    /// Changes the address of the last chunk, and returns the previous address.
    pub fn move_last(&mut self, address: u64) -> Option<u64> {
        let node = self.edge.first_mut()?;
        let last = node.entries.len().checked_sub(1)?;
        node.moved |= node.written.is_some_and(|written| last < written);
        Some(std::mem::replace(&mut node.entries[last].address, address))
    }

    /// Writes new nodes, to which the file does not refer yet.
    pub fn write_new(&self, file: &File) -> io::Result<()> {
        for node in self.full.iter().chain(&self.edge).filter(|node| node.written.is_none()) {
            let mut bytes = node.head();
            bytes.extend(self.tail(node, 0));
            bytes.resize(self.node_bytes(), 0);
            file.write_all_at(&bytes, node.address)?;
        }
        Ok(())
    }

    /// Updates nodes in the file and the root. The tree in the file is valid after each write.
    pub fn write_changes(&mut self, file: &File) -> io::Result<()> {
        for node in self.full.iter().chain(&self.edge) {
            let Some(written) = node.written else { continue };
            file.write_all_at(&self.tail(node, written), node.address + self.key_at(written))?;
            if node.moved {
                let entry = node.entries[written - 1];
                let at = node.address + self.key_at(written - 1) + self.key_bytes();
                file.write_all_at(&entry.address.to_le_bytes(), at)?;
            }
            // Writes the child count and the sibling addresses, which lie within the first 24 bytes.
            file.write_all_at(&node.head()[6..], node.address + 6)?;
        }
        if let Some(root) = self.edge.last()
            && root.address != self.root
        {
            file.write_all_at(&root.address.to_le_bytes(), self.root_at)?;
            self.root = root.address;
        }
        self.full.clear();
        for node in &mut self.edge {
            (node.written, node.moved) = (Some(node.entries.len()), false);
        }
        Ok(())
    }

    /// All chunks of a tree in a file.
    ///
    /// # Errors
    /// If the tree is damaged.
    pub fn chunks(table: &Table, source: &Source) -> Result<Vec<Entry>, String> {
        let tree = Self::new(table);
        let root = read_u64(source, tree.root_at)?;
        let mut chunks = vec![];
        let mut pending = if root == UNDEFINED { vec![] } else { vec![(root, u8::MAX)] };
        while let Some((address, above)) = pending.pop() {
            let node = tree.read(source, address)?;
            if node.level >= above {
                return Err("its nodes form a cycle".to_owned());
            }
            if node.level == 0 {
                chunks.extend(node.entries);
            } else {
                pending.extend(node.entries.iter().rev().map(|entry| (entry.address, node.level)));
            }
        }
        Ok(chunks)
    }

    const fn key_bytes(&self) -> u64 {
        8 + 8 * self.sides as u64
    }

    /// Offset of a key within a node.
    const fn key_at(&self, index: usize) -> u64 {
        24 + index as u64 * (self.key_bytes() + 8)
    }

    fn node_bytes(&self) -> usize {
        (self.key_at(MAX_CHILDREN) + self.key_bytes()) as usize
    }

    /// The bytes of a node, from the key of entry `from` to the final key.
    fn tail(&self, node: &Node, from: usize) -> Vec<u8> {
        let mut out = vec![];
        let key = |out: &mut Vec<u8>, size: u32, filter_mask: u32, row: u64| {
            out.extend(size.to_le_bytes());
            out.extend(filter_mask.to_le_bytes());
            out.extend(row.to_le_bytes());
            out.resize(out.len() + 8 * (self.sides - 1), 0);
        };
        for entry in &node.entries[from..] {
            key(&mut out, entry.size, entry.filter_mask, entry.row);
            out.extend(entry.address.to_le_bytes());
        }
        key(&mut out, 0, 0, node.end);
        out
    }

    fn read(&self, source: &Source, address: u64) -> Result<Node, String> {
        let mut bytes = vec![0; self.node_bytes()];
        source.read(address, &mut bytes).map_err(|e| e.to_string())?;
        let (kind, level) = (bytes[4], bytes[5]);
        let count = usize::from(u16::from_le_bytes([bytes[6], bytes[7]]));
        let u64_at = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        let u32_at = |at: usize| u32::from_le_bytes(std::array::from_fn(|i| bytes[at + i]));
        if bytes[..4] != *b"TREE" || kind != 1 || count > MAX_CHILDREN || (level > 0 && count == 0) {
            return Err(format!("there is no B-tree node at byte {address}"));
        }
        let entry = |i: usize| {
            let at = self.key_at(i) as usize;
            let address = u64_at(at + self.key_bytes() as usize);
            Entry { size: u32_at(at), filter_mask: u32_at(at + 4), row: u64_at(at + 8), address }
        };
        Ok(Node {
            address,
            level,
            left: u64_at(8),
            right: u64_at(16),
            entries: (0..count).map(entry).collect(),
            end: 0,
            written: Some(count),
            moved: false,
        })
    }
}

impl Node {
    fn head(&self) -> Vec<u8> {
        let mut out = b"TREE\x01".to_vec();
        out.push(self.level);
        out.extend((self.entries.len() as u16).to_le_bytes());
        out.extend(self.left.to_le_bytes());
        out.extend(self.right.to_le_bytes());
        out
    }
}

/// Reads a 64-bit integer at an offset of a file.
pub(super) fn read_u64(source: &Source, at: u64) -> Result<u64, String> {
    let mut bytes = [0; 8];
    source.read(at, &mut bytes).map_err(|e| e.to_string())?;
    Ok(u64::from_le_bytes(bytes))
}
