//! The log of a training run: JSON lines (`train.jsonl`) and a TensorBoard event file.

use prost::Message;
use serde::Deserialize;
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
    /// Opens the log of a folder. A run that continues after step `done` appends to the lines of the earlier run, without
    /// those of later steps, which are trained again; 0 is a new run. Each run writes a new event file, as TensorBoard
    /// expects.
    ///
    /// # Errors
    /// When the folder cannot be written, or a new run would replace files that no run wrote.
    pub fn new(folder: &Path, done: usize) -> Result<Self> {
        let (lines, resume) = (folder.join("train.jsonl"), done > 0);
        if resume {
            remove_later_steps(folder, done)?;
        } else {
            super::resume::check_new_run(folder)?;
        }
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let name = format!("events.out.tfevents.{}.{:09}.swm", now.as_secs(), now.subsec_nanos());
        let mut log = Self { lines: Writer::open(lines, resume)?, events: Writer::open(folder.join(name), false)? };
        log.event(Event {
            wall_time: now.as_secs_f64(),
            file_version: Some("brain.Event:2".to_owned()),
            ..Event::default()
        })?;
        if resume {
            // TensorBoard leaves out what earlier files of the run say of this step and later ones.
            let session_log = Some(SessionLog { status: SessionLog::START });
            let step = done as i64 + 1;
            log.event(Event { wall_time: now.as_secs_f64(), step, session_log, ..Event::default() })?;
        }
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
            summary: Some(Summary { value: scalars.iter().map(value).collect() }),
            ..Event::default()
        })
    }

    fn event(&mut self, event: Event) -> Result<()> {
        self.events.write(&record(&event.encode_to_vec()))
    }
}

/// Removes the lines of steps after `done` from the log in a folder, and a last line that a kill cut off.
///
/// # Errors
/// When the log is no regular file, or cannot be read or replaced. A missing log is created.
pub(super) fn remove_later_steps(folder: &Path, done: usize) -> Result<()> {
    #[derive(Deserialize)]
    struct Line {
        step: u64,
    }
    let path = folder.join("train.jsonl");
    // Refuses a link, which replacing would remove.
    files::open_to_write(&path, true)?;
    let text = files::read(&path, u64::MAX)?;
    let is_kept = |line: &&[u8]| match serde_json::from_slice::<Line>(line) {
        Ok(Line { step }) => step <= done as u64,
        // A line of other text is not of this program; one without an end was cut off.
        Err(_) => line.ends_with(b"\n"),
    };
    let kept: Vec<u8> = text.split_inclusive(|&byte| byte == b'\n').filter(is_kept).flatten().copied().collect();
    if kept.len() < text.len() { files::write(&path, &kept) } else { Ok(()) }
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
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    #[prost(int32, tag = "1")]
    status: i32,
}

impl SessionLog {
    /// A run begins or continues at the step of the event.
    const START: i32 = 1;
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
        let mut log = Log::new(folder.path(), 0).expect("creating the log");
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
    fn continued_log_has_each_step_once() {
        let folder = tempfile::tempdir().expect("creating a temporary folder");
        let path = folder.path().join("train.jsonl");
        let mut log = Log::new(folder.path(), 0).expect("creating the log");
        for step in 1..=3 {
            log.write(step, &[("loss", 0.5)]).expect("writing scalars");
        }
        drop(log);
        // A kill cut off the last line; the last checkpoint is that of step 2.
        let text = std::fs::read_to_string(&path).expect("reading train.jsonl");
        std::fs::write(&path, format!("{text}{{\"loss\":0.")).expect("writing train.jsonl");
        let mut log = Log::new(folder.path(), 2).expect("continuing the log");
        log.write(3, &[("loss", 0.25)]).expect("writing scalars");
        let text = std::fs::read_to_string(&path).expect("reading train.jsonl");
        let lines = ["{\"loss\":0.5,\"step\":1}", "{\"loss\":0.5,\"step\":2}", "{\"loss\":0.25,\"step\":3}"];
        assert_eq!(text.lines().collect::<Vec<_>>(), lines);
        let events = std::fs::read(&log.events.path).expect("reading the event file");
        let length = |at: usize| u64::from_le_bytes(events[at..at + 8].try_into().expect("8 bytes")) as usize;
        let second = 16 + length(0);
        let event = Event::decode(&events[second + 12..second + 12 + length(second)]).expect("decoding the event");
        assert_eq!((event.step, event.session_log), (3, Some(SessionLog { status: SessionLog::START })));
    }

    #[test]
    fn checksum_matches_tensorflow() {
        // The first twelve bytes of every event file that TensorFlow writes: a length of 24, then the checksum of the
        // length.
        assert_eq!(masked_crc(&24u64.to_le_bytes()), 0x224b_7fa3);
    }
}
