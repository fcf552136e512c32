//! The record of a data file: the content hash and the constants of each of its episodes. It is stored in the file's
//! global buffers, which other readers ignore.

use super::convert::{convert, image_bytes};
use super::schema::{self, Kind, StoredColumn};
use crate::dataset::Constants;
use arrow_array::{Array as _, ArrayRef};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Read as _;
use swm_core::{Error, Result};

/// Key of a data file's metadata: the index of the global buffer that holds the [`Record`].
pub const EPISODES_KEY: &str = "stable_worldmodel.episodes";
/// Key of a data file's metadata: the index of the global buffer that holds the compressed values of the constants.
pub const CONSTANTS_KEY: &str = "stable_worldmodel.constants";

/// The record of a data file, with episodes in stored order.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Record {
    pub episodes: Vec<RecordedEpisode>,
    /// Size in bytes of each constant's value. Equal values of several episodes are stored once.
    sizes: Vec<u64>,
    /// The concatenated values of the constants.
    #[serde(skip)]
    values: Vec<u8>,
    /// Index of each value, by its BLAKE3 hash.
    #[serde(skip)]
    index_by_hash: BTreeMap<[u8; 32], usize>,
}

/// The record of one episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RecordedEpisode {
    /// Number of rows.
    pub rows: u64,
    /// Hash of the values and the constants; see [`ContentHash`].
    pub hash: String,
    /// The name of each constant and the index of its value.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub constants: BTreeMap<String, usize>,
}

impl Record {
    /// Adds an episode.
    pub fn push(&mut self, rows: u64, hash: String, constants: &Constants) {
        let mut names = BTreeMap::new();
        for (name, value) in constants {
            let next = self.sizes.len();
            let index = *self.index_by_hash.entry(*blake3::hash(value).as_bytes()).or_insert(next);
            if index == next {
                self.sizes.push(value.len() as u64);
                self.values.extend_from_slice(value);
            }
            names.insert(name.clone(), index);
        }
        self.episodes.push(RecordedEpisode { rows, hash, constants: names });
    }

    /// The serialised record, and the compressed values of the constants if there are any.
    ///
    /// # Errors
    /// If compression fails.
    pub fn encode(&self) -> Result<(Bytes, Option<Bytes>)> {
        let record = schema::json(self)?.into_bytes().into();
        let pack = || zstd::bulk::compress(&self.values, 3).map_err(|e| Error::external("storing constants", e));
        let values = (!self.sizes.is_empty()).then(pack).transpose()?;
        Ok((record, values.map(Bytes::from)))
    }

    /// Parses a stored record.
    pub fn decode(stored: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(stored).map_err(|e| format!("the record of a data file is unreadable: {e}"))
    }

    /// Extracts the constants of an episode from the stored values. `position` is the episode's position in the file.
    pub fn constants(&self, position: usize, stored: &[u8]) -> Result<Constants, String> {
        let Some(episode) = self.episodes.get(position) else {
            return Err(format!("episode {position} has no record"));
        };
        let unreadable = |e: std::io::Error| format!("the constants are unreadable: {e}");
        // Limits the output to the recorded size, so that a damaged file cannot expand without bound.
        let total = self.sizes.iter().fold(0_u64, |sum, &size| sum.saturating_add(size));
        let mut values = vec![];
        let reader = zstd::stream::read::Decoder::new(stored).map_err(unreadable)?;
        reader.take(total.saturating_add(1)).read_to_end(&mut values).map_err(unreadable)?;
        if values.len() as u64 != total {
            return Err(format!("the constants have {} bytes instead of {total}", values.len()));
        }
        let value = |&index: &usize| {
            let start = self.sizes[..index.min(self.sizes.len())].iter().sum::<u64>() as usize;
            let end = start + *self.sizes.get(index)? as usize;
            Some(values[start..end].to_vec())
        };
        let constants = episode.constants.iter();
        let found: Option<Constants> = constants.map(|(name, index)| Some((name.clone(), value(index)?))).collect();
        found.ok_or_else(|| "a constant has no value".to_owned())
    }
}

/// A BLAKE3 hash of the stored values of an episode, column by column, and of its constants.
/// [`crate::Reader::content_hash`] combines these hashes. The hashes do not depend on `episode_idx` or on
/// the layout of the file.
pub struct ContentHash(blake3::Hasher);

impl ContentHash {
    /// Starts a hash, without values.
    pub fn new() -> Self {
        Self(blake3::Hasher::new())
    }

    /// Adds rows of a column.
    ///
    /// # Errors
    /// If the values do not match the column.
    pub fn add(&mut self, column: &StoredColumn, values: &ArrayRef) -> Result<(), String> {
        match column.kind {
            Kind::Image => {
                for row in 0..values.len() {
                    self.bytes(image_bytes(values, row).map_err(|e| e.to_string())?);
                }
            }
            Kind::Values(_) => {
                let mut bytes = vec![0; column.spec.row_bytes() * values.len()];
                convert(values, column.spec.len(), column.spec.dtype, &mut bytes)?;
                // All rows have the same length, so no length prefix is needed.
                self.0.update(&bytes);
            }
        }
        Ok(())
    }

    /// Adds the constants and returns the hash in hexadecimal.
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
    fn constants_round_trip_and_equal_constants_are_stored_once() {
        let constants = |text: &str| Constants::from([("scene.xml".to_owned(), text.as_bytes().to_vec())]);
        let scene = "<body/>".repeat(1000);
        let mut record = Record::default();
        for (e, text) in [&scene, "other", &scene].into_iter().enumerate() {
            record.push(7, format!("{e}"), &constants(text));
        }
        record.push(3, "none".to_owned(), &Constants::new());
        assert_eq!(record.sizes, [7000, 5]);
        let (stored, values) = record.encode().expect("encoding the record");
        let values = values.expect("the values of constants");
        let back = Record::decode(&stored).expect("decoding the record");
        assert_eq!(back.episodes, record.episodes);
        assert_eq!(back.constants(0, &values), Ok(constants(&scene)));
        assert_eq!(back.constants(1, &values), Ok(constants("other")));
        assert_eq!(back.constants(3, &values), Ok(Constants::new()));
        assert!(back.constants(4, &values).is_err());
        assert!(back.constants(0, &values[..values.len() / 2]).is_err());
        let oversized = Record { sizes: vec![u64::MAX, 5], ..back };
        assert!(oversized.constants(0, &values).is_err());
    }
}
