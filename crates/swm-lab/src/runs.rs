//! Training runs: folders with a `train.jsonl`, and the lines of these files from an offset on, so that a page follows a run by
//! reading what is new.

use crate::folders::Folders;
use serde::Serialize;
use serde_json::{Map, Value};
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};
use swm_core::{Error, Result, files};

/// The log of a training.
const LOG: &str = "train.jsonl";
/// How deep runs are looked for: in the folders, and in their folders.
const DEPTH: usize = 2;
/// The largest part of a log that one answer holds.
const CHUNK: u64 = 1 << 20;

/// A run of a list.
#[derive(Debug, Serialize)]
pub struct Run {
    /// The index of its folder.
    pub folder: usize,
    /// Its path in the folder.
    pub name: String,
    /// The size of its log in bytes.
    pub bytes: u64,
    /// When the log was written last, in seconds since 1970.
    pub modified: u64,
    /// The newest line of the log.
    pub last: Map<String, Value>,
}

/// Some lines of a log.
#[derive(Debug, Serialize)]
pub struct Lines {
    /// The offset of the first byte that was not read.
    pub offset: u64,
    /// Whether there is more to read.
    pub more: bool,
    /// The finite values of each line.
    pub lines: Vec<Map<String, Value>>,
}

/// Whether a folder has a log, which is no link.
fn is_run(path: &Path) -> bool {
    path.join(LOG).symlink_metadata().is_ok_and(|metadata| metadata.is_file())
}

/// The runs of the folders, sorted by name.
pub fn list(folders: &Folders) -> Vec<Run> {
    let runs = folders.list(DEPTH, is_run).into_iter();
    runs.filter_map(|found| {
        let log = found.path.join(LOG);
        let metadata = log.metadata().ok()?;
        let since = metadata.modified().ok().and_then(|time: SystemTime| time.duration_since(UNIX_EPOCH).ok());
        let start = metadata.len().saturating_sub(1 << 14);
        let tail = read(&log, start).ok()?;
        Some(Run {
            folder: found.folder,
            name: found.name,
            bytes: metadata.len(),
            modified: since.map_or(0, |since| since.as_secs()),
            last: tail.lines.into_iter().next_back().unwrap_or_default(),
        })
    })
    .collect()
}

/// Reads the lines of a run from an offset on. Incomplete last lines stay unread.
///
/// # Errors
/// When there is no such run, or its log cannot be read.
pub fn lines(folders: &Folders, folder: usize, name: &str, offset: u64) -> Result<Lines> {
    read(&folders.find(folder, name, DEPTH, is_run)?.join(LOG), offset)
}

fn read(log: &Path, offset: u64) -> Result<Lines> {
    let io = |error| Error::io(log, "reading the training log", error);
    let mut file = files::open(log)?;
    let length = file.metadata().map_err(io)?.len();
    // A log that became shorter was begun again.
    let offset = if offset > length { 0 } else { offset };
    file.seek(SeekFrom::Start(offset)).map_err(io)?;
    let mut bytes = vec![];
    file.take(CHUNK).read_to_end(&mut bytes).map_err(io)?;
    let mut complete = bytes.iter().rposition(|&byte| byte == b'\n').map_or(0, |end| end + 1);
    if complete == 0 && bytes.len() as u64 == CHUNK {
        // No training writes such a line.
        complete = bytes.len();
    }
    let parsed = bytes[..complete].split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok());
    let lines =
        parsed.map(|line: Map<String, Value>| line.into_iter().filter(|(_, value)| value.is_number()).collect());
    let end = offset + complete as u64;
    Ok(Lines { offset: end, more: complete > 0 && end < length, lines: lines.collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_page_follows_a_log_that_grows() {
        let root = tempfile::tempdir().expect("a folder");
        let run = root.path().join("study/lewm");
        fs::create_dir_all(&run).expect("a folder");
        let log = run.join(LOG);
        fs::write(&log, "{\"step\": 1, \"loss\": 2.5, \"note\": \"x\"}\nnot JSON\n{\"step\": 2, \"lo").expect("a log");
        let folders = Folders::new(vec![root.path().to_owned()]);
        let first = lines(&folders, 0, "study/lewm", 0).expect("lines");
        assert_eq!((first.lines.len(), first.more), (1, true));
        assert_eq!(first.lines[0].keys().map(String::as_str).collect::<Vec<_>>(), ["loss", "step"]);
        fs::write(&log, "{\"step\": 1, \"loss\": 2.5, \"note\": \"x\"}\nnot JSON\n{\"step\": 2, \"loss\": 1.5}\n")
            .expect("a log");
        let next = lines(&folders, 0, "study/lewm", first.offset).expect("lines");
        assert_eq!((next.lines.len(), next.more, next.lines[0]["loss"].as_f64()), (1, false, Some(1.5)));
        let all = list(&folders);
        assert_eq!((all.len(), all[0].name.as_str(), all[0].last["step"].as_u64()), (1, "study/lewm", Some(2)));
        // A log that was begun again is read from its start.
        fs::write(&log, "{\"step\": 1}\n").expect("a log");
        assert_eq!(lines(&folders, 0, "study/lewm", next.offset).expect("lines").lines.len(), 1);
        assert!(lines(&folders, 0, "../lewm", 0).is_err());
        // A log that is a link is none.
        fs::rename(&log, root.path().join("elsewhere")).expect("a log");
        std::os::unix::fs::symlink(root.path().join("elsewhere"), &log).expect("a link");
        assert!(lines(&folders, 0, "study/lewm", 0).is_err());
        assert!(list(&folders).is_empty());
    }
}
