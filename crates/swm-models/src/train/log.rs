//! The log of a training run: JSON lines (`train.jsonl`) and a TensorBoard event file.

use prost::Message;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};
use swm_core::{Error, Result, files};

/// Named values of one step.
pub type Scalars<'a> = &'a [(&'a str, f64)];

/// Writes scalars to `train.jsonl` and to an event file.
pub struct Log {
    lines: Writer,
    events: Writer,
}

struct Writer {
    path: PathBuf,
    file: File,
}

impl Writer {
    fn open(path: PathBuf, append: bool) -> Result<Self> {
        let file = files::open_to_write(&path, append)?;
        Ok(Self { path, file })
    }

    fn write(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(|error| Error::io(&self.path, "writing a log", error))
    }
}

impl Log {
    /// Opens the log of a folder; `resume` appends to the lines of an earlier run. Each run writes a new event
    /// file, as TensorBoard expects.
    ///
    /// # Errors
    /// When the folder cannot be written, or a new run would replace files that no run wrote.
    pub fn new(folder: &Path, resume: bool) -> Result<Self> {
        if !resume {
            super::resume::check_new_run(folder)?;
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let name = format!("events.out.tfevents.{}.{:09}.swm", now.as_secs(), now.subsec_nanos());
        let mut log = Self {
            lines: Writer::open(folder.join("train.jsonl"), resume)?,
            events: Writer::open(folder.join(name), false)?,
        };
        log.event(Event {
            wall_time: now.as_secs_f64(),
            file_version: Some("brain.Event:2".to_owned()),
            ..Event::default()
        })?;
        Ok(log)
    }

    /// Writes the scalars of a step.
    ///
    /// # Errors
    /// When writing fails.
    pub fn write(&mut self, step: usize, scalars: Scalars<'_>) -> Result<()> {
        let mut object = serde_json::Map::new();
        object.insert("step".to_owned(), step.into());
        for (name, value) in scalars {
            object.insert((*name).to_owned(), (*value).into());
        }
        let mut line = serde_json::Value::Object(object).to_string();
        line.push('\n');
        self.lines.write(line.as_bytes())?;
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let value =
            |(name, value): &(&str, f64)| Value { tag: format!("train/{name}"), simple_value: Some(*value as f32) };
        self.event(Event {
            wall_time: now.as_secs_f64(),
            step: step as i64,
            file_version: None,
            summary: Some(Summary { value: scalars.iter().map(value).collect() }),
        })
    }

    fn event(&mut self, event: Event) -> Result<()> {
        self.events.write(&record(&event.encode_to_vec()))
    }
}

/// The fields of TensorFlow's `event.proto` that scalars need.
#[derive(Clone, PartialEq, Message)]
struct Event {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Value>,
}

#[derive(Clone, PartialEq, Message)]
struct Value {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
}

/// A record of a TFRecord file: the length, the checksum of the length, the data, the checksum of the data.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut out = length.to_vec();
    out.extend(masked_crc(&length).to_le_bytes());
    out.extend(data);
    out.extend(masked_crc(data).to_le_bytes());
    out
}

/// The checksum of TFRecord files: CRC-32C, rotated by 15 bits, plus a constant.
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_round_trip_with_valid_checksums() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let mut log = Log::new(folder.path(), false).expect("creating the log");
        log.write(7, &[("loss", 0.5), ("lr", 1e-3)]).expect("writing scalars");
        let line = std::fs::read_to_string(folder.path().join("train.jsonl")).expect("reading train.jsonl");
        assert_eq!(line, "{\"loss\":0.5,\"lr\":0.001,\"step\":7}\n");
        let events = std::fs::read(&log.events.path).expect("reading the event file");
        let mut unread = &events[..];
        let mut found = vec![];
        while !unread.is_empty() {
            let word = |at: usize| u32::from_le_bytes(unread[at..at + 4].try_into().expect("4 bytes"));
            let length = u64::from_le_bytes(unread[..8].try_into().expect("8 bytes")) as usize;
            assert_eq!(word(8), masked_crc(&unread[..8]));
            assert_eq!(word(12 + length), masked_crc(&unread[12..12 + length]));
            found.push(Event::decode(&unread[12..12 + length]).expect("decoding the event"));
            unread = &unread[16 + length..];
        }
        assert_eq!(found[0].file_version.as_deref(), Some("brain.Event:2"));
        assert_eq!(found[1].step, 7);
        let values = &found[1].summary.as_ref().expect("a summary").value;
        assert_eq!((values[0].tag.as_str(), values[0].simple_value), ("train/loss", Some(0.5)));
    }

    #[test]
    fn checksum_matches_tensorflow() {
        // The first twelve bytes of every event file that TensorFlow writes: a length of 24, then the checksum of the
        // length.
        assert_eq!(masked_crc(&24u64.to_le_bytes()), 0x224b_7fa3);
    }
}
