//! The record: metadata that is stored beside the columns (original schema, manifest, constants of episodes). It is an
//! unnamed byte dataset, so no program treats it as a column; the attribute `stable_worldmodel.record` of the root
//! group refers to it.
//!
//! The record consists of JSON lines; writers only append lines. The bytes of a constant follow the constant's line.

use crate::dataset::Constants;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::ops::Range;
use swm_core::{Error, Manifest, Result, Schema};

/// A line of the record.
#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Line {
    /// The columns of the file.
    Schema(Schema),
    /// The manifest; the last line of this kind is valid.
    Manifest(Box<Manifest>),
    /// The size of a constant in bytes; these bytes follow the line. Constants are numbered from 0 in stored order.
    Constant(usize),
    /// The number of episodes when a writer finished.
    Closed(usize),
    /// The position of an episode, and the number of each of its constants by name.
    Episode { number: usize, constants: BTreeMap<String, usize> },
}

/// A parsed record.
#[derive(Default)]
pub(super) struct Record {
    pub schema: Option<Schema>,
    pub manifest: Option<Manifest>,
    bytes: Vec<u8>,
    /// Byte ranges of the constants.
    constants: Vec<Range<usize>>,
    episodes: HashMap<usize, BTreeMap<String, usize>>,
    /// Length in bytes of the part that belongs to committed episodes.
    pub committed: usize,
}

impl Record {
    /// Parses the record of a file with `episodes` episodes. Lines of later episodes were never committed and are
    /// ignored.
    ///
    /// # Errors
    /// If the record is damaged.
    pub fn parse(bytes: Vec<u8>, episodes: usize) -> Result<Self, String> {
        let mut record = Self::default();
        let mut at = 0;
        while let Some(length) = bytes[at..].iter().position(|&byte| byte == b'\n') {
            let line =
                serde_json::from_slice(&bytes[at..at + length]).map_err(|e| format!("a line cannot be parsed: {e}"))?;
            at += length + 1;
            match line {
                Line::Schema(schema) => record.schema = Some(schema),
                Line::Manifest(manifest) => record.manifest = Some(*manifest),
                Line::Closed(count) if count > episodes => {
                    return Err(format!("it has {episodes} episodes instead of {count}"));
                }
                Line::Closed(_) => {}
                Line::Constant(size) => {
                    let end = at.checked_add(size).filter(|&end| end <= bytes.len());
                    let end = end.ok_or("its record is truncated in a constant")?;
                    record.constants.push(at..end);
                    at = end;
                }
                Line::Episode { number, .. } if number >= episodes => break,
                Line::Episode { number, constants } => {
                    if constants.values().any(|&index| index >= record.constants.len()) {
                        return Err(format!("its record lacks constants of episode {number}"));
                    }
                    record.episodes.insert(number, constants);
                }
            }
            record.committed = at;
        }
        if record.committed == at && at < bytes.len() {
            return Err("its record is truncated".to_owned());
        }
        record.bytes = bytes;
        Ok(record)
    }

    /// Whether writers have appended to `old`, a record of this format's writer, or left it as it is.
    pub fn continues(&self, old: &Self) -> bool {
        old.schema.is_some() && self.bytes.starts_with(&old.bytes[..old.committed])
    }

    /// The constants of an episode.
    pub fn constants(&self, episode: usize) -> Constants {
        let named = self.episodes.get(&episode).into_iter().flatten();
        named.map(|(name, &index)| (name.clone(), self.bytes[self.constants[index].clone()].to_vec())).collect()
    }
}

/// Produces the lines of a record.
#[derive(Default)]
pub(super) struct RecordWriter {
    /// Number of each stored constant, by its BLAKE3 hash.
    number_by_hash: HashMap<blake3::Hash, usize>,
    /// Number of stored constants.
    count: usize,
}

impl RecordWriter {
    /// Continues after the committed part of a record.
    pub fn resume(record: &Record) -> Self {
        let committed = record.constants.iter().take_while(|range| range.end <= record.committed);
        let hashes: Vec<blake3::Hash> = committed.map(|range| blake3::hash(&record.bytes[range.clone()])).collect();
        Self { count: hashes.len(), number_by_hash: hashes.into_iter().zip(0..).collect() }
    }

    /// The line that stores the columns.
    pub fn schema(schema: &Schema) -> Result<Vec<u8>> {
        line(&Line::Schema(schema.clone()))
    }

    /// The line that stores a manifest.
    pub fn manifest(manifest: &Manifest) -> Result<Vec<u8>> {
        line(&Line::Manifest(Box::new(manifest.clone())))
    }

    /// The line that marks the end of a writer.
    pub fn closed(episodes: usize) -> Result<Vec<u8>> {
        line(&Line::Closed(episodes))
    }

    /// The lines of an episode. Constants that are stored already are not stored again.
    pub fn episode(&mut self, number: usize, constants: &Constants) -> Result<Vec<u8>> {
        if constants.is_empty() {
            return Ok(vec![]);
        }
        let mut out = vec![];
        let mut named = BTreeMap::new();
        for (name, bytes) in constants {
            let index = *self.number_by_hash.entry(blake3::hash(bytes)).or_insert(self.count);
            if index == self.count {
                self.count += 1;
                out.extend(line(&Line::Constant(bytes.len()))?);
                out.extend(bytes);
            }
            named.insert(name.clone(), index);
        }
        out.extend(line(&Line::Episode { number, constants: named })?);
        Ok(out)
    }
}

fn line(line: &Line) -> Result<Vec<u8>> {
    let mut bytes = serde_json::to_vec(line).map_err(|e| Error::external("describing the dataset", e))?;
    bytes.push(b'\n');
    Ok(bytes)
}
