//! What a data file records of its episodes beside their rows: a hash of their content, and what is the same in all of
//! their steps. It lies in the file's global buffers, which foreign readers leave alone.

use super::convert::{blob, convert};
use super::schema::{self, Kind, StoredColumn};
use crate::dataset::Constants;
use arrow_array::{Array as _, ArrayRef};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Read as _;
use swm_core::{Error, Result};

/// Keys in the file's metadata: the numbers of the global buffers.
pub const EPISODES_KEY: &str = "stable_worldmodel.episodes";
/// See [`EPISODES_KEY`].
pub const CONSTANTS_KEY: &str = "stable_worldmodel.constants";

/// The episodes of a data file, in stored order.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Record {
    pub episodes: Vec<RecordedEpisode>,
    /// Bytes of each constant's value. Equal values of several episodes are stored once.
    sizes: Vec<u64>,
    /// The values, one after another.
    #[serde(skip)]
    values: Vec<u8>,
    #[serde(skip)]
    known: BTreeMap<[u8; 32], usize>,
}

/// One episode of a data file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedEpisode {
    /// Its rows.
    pub rows: u64,
    /// See [`content_hash`].
    pub hash: String,
    /// The name of each constant, and which value it has.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub constants: BTreeMap<String, usize>,
}

impl Record {
    /// Adds an episode.
    pub fn push(&mut self, rows: u64, hash: String, constants: &Constants) {
        let mut names = BTreeMap::new();
        for (name, value) in constants {
            let next = self.sizes.len();
            let place = *self.known.entry(*blake3::hash(value).as_bytes()).or_insert(next);
            if place == next {
                self.sizes.push(value.len() as u64);
                self.values.extend_from_slice(value);
            }
            names.insert(name.clone(), place);
        }
        self.episodes.push(RecordedEpisode { rows, hash, constants: names });
    }

    /// What is stored: the record, and the values of the constants, if there are any.
    ///
    /// # Errors
    /// When it cannot be compressed.
    pub fn encode(&self) -> Result<(Bytes, Option<Bytes>)> {
        let record = schema::json(self)?.into_bytes().into();
        let pack = || zstd::bulk::compress(&self.values, 3).map_err(|e| Error::external("storing constants", e));
        let values = (!self.sizes.is_empty()).then(pack).transpose()?;
        Ok((record, values.map(Bytes::from)))
    }

    /// A stored record.
    pub fn decode(stored: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(stored).map_err(|e| format!("the record of its episodes is unreadable: {e}"))
    }

    /// The constants of the episode in this position of the file, out of the stored values.
    pub fn constants(&self, position: usize, stored: &[u8]) -> Result<Constants, String> {
        let Some(episode) = self.episodes.get(position) else {
            return Err(format!("episode {position} has no record"));
        };
        let unreadable = |e: std::io::Error| format!("its constants are unreadable: {e}");
        // What is asked for grows with what is there, not with what a damaged size says.
        let total = self.sizes.iter().fold(0_u64, |sum, &size| sum.saturating_add(size));
        let mut values = vec![];
        let reader = zstd::stream::read::Decoder::new(stored).map_err(unreadable)?;
        reader.take(total.saturating_add(1)).read_to_end(&mut values).map_err(unreadable)?;
        if values.len() as u64 != total {
            return Err(format!("its constants have {} bytes instead of {total}", values.len()));
        }
        let value = |&place: &usize| {
            let start = self.sizes[..place.min(self.sizes.len())].iter().sum::<u64>() as usize;
            let end = start + *self.sizes.get(place)? as usize;
            Some(values[start..end].to_vec())
        };
        let constants = episode.constants.iter();
        let found: Option<Constants> = constants.map(|(name, place)| Some((name.clone(), value(place)?))).collect();
        found.ok_or_else(|| "a constant has no value".to_owned())
    }
}

/// A BLAKE3 hash of an episode's values as they are stored, column after column, and of its constants: what
/// [`crate::Reader::content_hash`] is made of. Neither its number nor the file's layout is part of it.
pub struct ContentHash(blake3::Hasher);

impl ContentHash {
    /// Of no values yet.
    pub fn new() -> Self {
        Self(blake3::Hasher::new())
    }

    /// Adds some rows of a column.
    ///
    /// # Errors
    /// When the values are not what the column says.
    pub fn add(&mut self, column: &StoredColumn, values: &ArrayRef) -> Result<(), String> {
        match column.kind {
            Kind::Image => {
                for row in 0..values.len() {
                    self.bytes(blob(values, row).map_err(|e| e.to_string())?);
                }
            }
            Kind::Numbers(_) => {
                let mut bytes = vec![0; column.spec.row_bytes() * values.len()];
                convert(values, column.spec.len(), column.spec.dtype, &mut bytes)?;
                // All rows have one length, so they need none between them.
                self.0.update(&bytes);
            }
        }
        Ok(())
    }

    /// The hash in hexadecimal, after all columns.
    pub fn finish(mut self, constants: &Constants) -> String {
        for (name, value) in constants {
            self.bytes(name.as_bytes());
            self.bytes(value);
        }
        self.0.finalize().to_hex().to_string()
    }

    fn bytes(&mut self, bytes: &[u8]) {
        self.0.update(&(bytes.len() as u64).to_le_bytes());
        self.0.update(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constants_come_back_and_equal_ones_are_stored_once() {
        let constants = |text: &str| Constants::from([("scene.xml".to_owned(), text.as_bytes().to_vec())]);
        let scene = "<body/>".repeat(1000);
        let mut record = Record::default();
        for (e, text) in [&scene, "other", &scene].into_iter().enumerate() {
            record.push(7, format!("{e}"), &constants(text));
        }
        record.push(3, "none".to_owned(), &Constants::new());
        assert_eq!(record.sizes, [7000, 5]);
        let (stored, values) = record.encode().expect("encodes");
        let values = values.expect("some");
        let back = Record::decode(&stored).expect("decodes");
        assert_eq!(back.episodes, record.episodes);
        assert_eq!(back.constants(0, &values), Ok(constants(&scene)));
        assert_eq!(back.constants(1, &values), Ok(constants("other")));
        assert_eq!(back.constants(3, &values), Ok(Constants::new()));
        assert!(back.constants(4, &values).is_err());
        assert!(back.constants(0, &values[..values.len() / 2]).is_err());
        let absurd = Record { sizes: vec![u64::MAX, 5], ..back };
        assert!(absurd.constants(0, &values).is_err());
    }
}
