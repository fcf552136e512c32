//! What the root group of a file holds. Soft links and links to other files are no datasets, and are never followed: a file from a
//! stranger reads nothing but itself.
//!
//! The crate `hdf5-pure` passes over links in the newer kind of group, and fails at those in the oldest kind, a symbol table, which
//! h5py writes by default. This module reads that table itself. Links to other files exist in the newer kind only.

use super::source::Source;
use super::structure::catch_panic;
use super::tree::read_u64;
use hdf5_pure::{Error as Hdf5Error, File};
use swm_core::check_column_count;

/// The size of the root's entry before its cached addresses; their kind is 8 bytes before them.
const CACHE_AT: u64 = 24;
/// The kind of cached addresses: those of a symbol table.
const SYMBOL_TABLE: u32 = 1;
/// The kind of an entry that is a soft link.
const SOFT_LINK: u32 = 2;
/// The size of an entry of a symbol table.
const ENTRY_BYTES: usize = 40;
/// The most nodes of a symbol table, and the most bytes of its names.
const MOST_NODES: usize = 1 << 14;
const MOST_NAME_BYTES: u64 = 16 << 20;
/// The most bytes of a name.
const LONGEST_NAME: usize = 4096;

/// The names of the objects in the root group.
pub(super) struct Contents {
    pub datasets: Vec<String>,
    /// Names that are soft links, as far as they are known.
    pub links: Vec<String>,
    /// Names of groups, if there are soft links.
    groups: Vec<String>,
}

impl Contents {
    /// Lists the root group.
    ///
    /// # Errors
    /// If the group or the header of an object in it is damaged.
    pub fn read(file: &File, source: &Source) -> Result<Self, String> {
        let problem = match catch_panic("listing its datasets", || file.root().datasets()) {
            Ok(datasets) => return Ok(Self { datasets, links: vec![], groups: vec![] }),
            Err(problem) => problem,
        };
        let names = match symbol_table(source) {
            Ok(Some(names)) if !names.links.is_empty() => names,
            _ => return Err(problem),
        };
        let mut contents = Self { datasets: vec![], links: names.links, groups: vec![] };
        for name in names.objects {
            match catch_panic("reading a header", || Ok::<_, String>(file.dataset(&name)))? {
                Ok(_) => contents.datasets.push(name),
                // A group, or a type that has a name.
                Err(Hdf5Error::NotADataset(_)) => {
                    if catch_panic("reading a header", || file.group(&name)).is_ok() {
                        contents.groups.push(name);
                    }
                }
                Err(error) => return Err(format!("listing its datasets: '{name}': {error}")),
            }
        }
        Ok(contents)
    }

    /// Names of the groups in the root group.
    ///
    /// # Errors
    /// If the header of an object in it is damaged.
    pub fn groups(&self, file: &File) -> Result<Vec<String>, String> {
        if !self.links.is_empty() {
            return Ok(self.groups.clone());
        }
        catch_panic("listing its groups", || file.root().groups())
    }

    /// What is wrong if the name of a list that locates the episodes is that of no list of integers.
    pub fn lacks(&self, name: &str) -> String {
        let none =
            || format!("it has no list of integers '{name}', which locates the episodes; links are not followed");
        self.link(name).unwrap_or_else(none)
    }

    /// What is wrong with a name that is a soft link; `None` if it is not known to be one.
    pub fn link(&self, name: &str) -> Option<String> {
        self.links
            .iter()
            .any(|link| link == name)
            .then(|| format!("'{name}' is a soft link, which is not followed: the dataset itself must have this name"))
    }
}

/// The names in a root group: of objects, and of soft links.
#[derive(Default)]
struct Names {
    objects: Vec<String>,
    links: Vec<String>,
}

/// The names in a root group of the oldest kind; `None` if it is of another kind.
fn symbol_table(source: &Source) -> Result<Option<Names>, String> {
    let mut head = [0; 28];
    read(source, 0, &mut head)?;
    // Superblocks of version 1 have one integer more. The addresses and lengths in the file have 8 bytes.
    let (version, begin) = (head[8], 24 + 4 * u64::from(head[8]));
    if version > 1 || head[13..15] != [8, 8] || read_u64(source, begin)? != 0 {
        return Ok(None);
    }
    // Four addresses, then the entry of the root.
    let cache = begin + 32 + CACHE_AT;
    let mut kind = [0; 4];
    read(source, cache - 8, &mut kind)?;
    if u32::from_le_bytes(kind) != SYMBOL_TABLE {
        return Ok(None);
    }
    let heap = heap(source, read_u64(source, cache + 8)?)?;
    let mut names = Names::default();
    for node in leaves(source, read_u64(source, cache)?)? {
        for (name, kind) in entries(source, node)? {
            let name = usize::try_from(name).ok().and_then(|at| heap.get(at..)).unwrap_or_default();
            let end = name.iter().take(LONGEST_NAME + 1).position(|&byte| byte == 0);
            let end = end.ok_or_else(|| format!("a name of its root group has more than {LONGEST_NAME} bytes"))?;
            let name = String::from_utf8_lossy(&name[..end]).into_owned();
            if kind == SOFT_LINK { names.links.push(name) } else { names.objects.push(name) }
        }
        check_column_count(names.objects.len().max(names.links.len())).map_err(|error| error.to_string())?;
    }
    Ok(Some(names))
}

/// The names in the heap of a group.
fn heap(source: &Source, address: u64) -> Result<Vec<u8>, String> {
    let mut head = [0; 4];
    read(source, address, &mut head)?;
    let (size, data) = (read_u64(source, address.saturating_add(8))?, read_u64(source, address.saturating_add(24))?);
    if head != *b"HEAP" || size > MOST_NAME_BYTES || !source.reaches(data.saturating_add(size)) {
        return Err("the names of its root group are damaged".to_owned());
    }
    let mut bytes = vec![0; size as usize];
    read(source, data, &mut bytes)?;
    Ok(bytes)
}

/// The addresses of the lists of entries below a node of a B-tree.
fn leaves(source: &Source, root: u64) -> Result<Vec<u64>, String> {
    let mut leaves = vec![];
    let mut pending = vec![(root, u8::MAX)];
    // Two parents may have the same child, so that a short file has any number of paths.
    let mut nodes = 0;
    while let Some((address, above)) = pending.pop() {
        let mut head = [0; 8];
        read(source, address, &mut head)?;
        let (level, count) = (head[5], usize::from(u16::from_le_bytes([head[6], head[7]])));
        if head[..4] != *b"TREE" || head[4] != 0 || level >= above {
            return Err(format!("there is no node of a group at byte {address}"));
        }
        nodes += 1 + count;
        if nodes > MOST_NODES {
            return Err(format!("its root group has more than {MOST_NODES} nodes"));
        }
        // After two neighbours, a key precedes each child.
        let mut children = vec![0; 16 * count];
        read(source, address.saturating_add(24), &mut children)?;
        let children = children.as_chunks().0.iter().skip(1).step_by(2).map(|&child| u64::from_le_bytes(child));
        if level == 0 { leaves.extend(children) } else { pending.extend(children.rev().map(|child| (child, level))) }
    }
    Ok(leaves)
}

/// The entries in a list: where the name of each is in the heap, and its kind.
fn entries(source: &Source, address: u64) -> Result<Vec<(u64, u32)>, String> {
    let mut head = [0; 8];
    read(source, address, &mut head)?;
    if head[..5] != *b"SNOD\x01" {
        return Err(format!("there is no list of names at byte {address}"));
    }
    let count = usize::from(u16::from_le_bytes([head[6], head[7]]));
    check_column_count(count).map_err(|error| error.to_string())?;
    let mut bytes = vec![0; ENTRY_BYTES * count];
    read(source, address.saturating_add(8), &mut bytes)?;
    let entries = bytes.as_chunks::<ENTRY_BYTES>().0.iter();
    Ok(entries
        .map(|entry| {
            let name = u64::from_le_bytes(std::array::from_fn(|i| entry[i]));
            (name, u32::from_le_bytes(std::array::from_fn(|i| entry[16 + i])))
        })
        .collect())
}

fn read(source: &Source, at: u64, out: &mut [u8]) -> Result<(), String> {
    source.read(at, out).map_err(|error| error.to_string())
}
