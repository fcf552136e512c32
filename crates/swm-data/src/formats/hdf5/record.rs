//! What we record beside the columns: types and shapes as they were, where the data come from, what is constant in an
//! episode. It is a dataset of bytes without a name, so no program takes it for a column; the root's attribute
//! `stable_worldmodel.record` refers to it.
//!
//! Lines of JSON, one after another, which only grows. A constant's line is followed by its bytes.

use crate::dataset::Constants;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::ops::Range;
use swm_core::{Error, Manifest, Result, Schema};

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Line {
    /// The columns.
    Schema(Schema),
    /// The last one counts.
    Manifest(Box<Manifest>),
    /// A constant of this many bytes, which follow; they are numbered.
    Constant(usize),
    /// A writer ended properly, after so many episodes.
    Closed(usize),
    /// The constants of an episode, by their numbers.
    Episode { number: usize, constants: BTreeMap<String, usize> },
}

/// A record, read.
#[derive(Default)]
pub(super) struct Record {
    pub schema: Option<Schema>,
    pub manifest: Option<Manifest>,
    bytes: Vec<u8>,
    /// Where the constants are.
    constants: Vec<Range<usize>>,
    episodes: HashMap<usize, BTreeMap<String, usize>>,
    /// How much of it belongs to episodes that are there.
    pub committed: usize,
}

impl Record {
    /// Reads a record of a file with so many episodes; what it says of others was never committed.
    ///
    /// # Errors
    /// When it makes no sense.
    pub fn parse(bytes: Vec<u8>, episodes: usize) -> Result<Self, String> {
        let mut record = Self::default();
        let mut at = 0;
        while let Some(length) = bytes[at..].iter().position(|&byte| byte == b'\n') {
            let line = serde_json::from_slice(&bytes[at..at + length]).map_err(|e| format!("its record: {e}"))?;
            at += length + 1;
            match line {
                Line::Schema(schema) => record.schema = Some(schema),
                Line::Manifest(manifest) => record.manifest = Some(*manifest),
                Line::Closed(count) if count > episodes => {
                    return Err(format!("it has {episodes} episodes; {count} were written"));
                }
                Line::Closed(_) => {}
                Line::Constant(size) => {
                    let end = at.checked_add(size).filter(|&end| end <= bytes.len());
                    let end = end.ok_or("its record is cut off in a constant")?;
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
            return Err("its record is cut off".to_owned());
        }
        record.bytes = bytes;
        Ok(record)
    }

    /// The constants of an episode.
    pub fn constants(&self, episode: usize) -> Constants {
        let named = self.episodes.get(&episode).into_iter().flatten();
        named.map(|(name, &index)| (name.clone(), self.bytes[self.constants[index].clone()].to_vec())).collect()
    }
}

/// Makes the lines of a record.
#[derive(Default)]
pub(super) struct RecordWriter {
    known: HashMap<blake3::Hash, usize>,
    count: usize,
}

impl RecordWriter {
    /// Continues a record, as far as it is committed.
    pub fn continued(record: &Record) -> Self {
        let committed = record.constants.iter().take_while(|place| place.end <= record.committed);
        let hashes: Vec<blake3::Hash> = committed.map(|place| blake3::hash(&record.bytes[place.clone()])).collect();
        Self { count: hashes.len(), known: hashes.into_iter().zip(0..).collect() }
    }

    /// The line of the columns.
    pub fn schema(schema: &Schema) -> Result<Vec<u8>> {
        line(&Line::Schema(schema.clone()))
    }

    /// The line of a manifest.
    pub fn manifest(manifest: &Manifest) -> Result<Vec<u8>> {
        line(&Line::Manifest(Box::new(manifest.clone())))
    }

    /// The line at the end.
    pub fn closed(episodes: usize) -> Result<Vec<u8>> {
        line(&Line::Closed(episodes))
    }

    /// The lines of an episode; constants that are there are not stored again.
    pub fn episode(&mut self, number: usize, constants: &Constants) -> Result<Vec<u8>> {
        if constants.is_empty() {
            return Ok(vec![]);
        }
        let mut out = vec![];
        let mut named = BTreeMap::new();
        for (name, bytes) in constants {
            let index = *self.known.entry(blake3::hash(bytes)).or_insert(self.count);
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
