//! The journal: episodes that are committed but not yet in the column files.

use crate::dataset::Constants;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use swm_core::{ColumnSpec, Error, Result, files};

/// The tag that starts every record. The lengths of the record's head and body, and their BLAKE3 hash, follow.
const MAGIC: &[u8; 8] = b"swm-ep-1";
/// Size in bytes of the tag, the lengths and the hash, which precede the head of a record.
const LEAD: usize = 8 + 8 + 8 + 32;

/// An episode in the journal that is not yet in the column files.
pub(super) struct PendingEpisode {
    pub rows: usize,
    /// The bytes of each numeric column.
    pub columns: Vec<Vec<u8>>,
    pub constants: Constants,
}

/// The head of a record. The body holds the numeric columns, one after another, then the constants in order of their
/// names.
#[derive(Serialize, Deserialize)]
struct Head {
    episode: usize,
    rows: usize,
    /// Size in bytes of each constant.
    constants: BTreeMap<String, usize>,
}

/// Name of the journal.
pub(super) const NAME: &str = "ep_len.journal";

/// The path of a folder's journal.
pub(super) fn path(folder: &Path) -> PathBuf {
    folder.join(NAME)
}

/// The record of an episode.
///
/// # Errors
/// If its head cannot be serialised as JSON.
pub(super) fn record(episode: usize, pending: &PendingEpisode) -> Result<Vec<u8>> {
    let constants = pending.constants.iter().map(|(name, bytes)| (name.clone(), bytes.len())).collect();
    let head = serde_json::to_vec(&Head { episode, rows: pending.rows, constants })
        .map_err(|e| Error::external("describing an episode", e))?;
    let mut out = vec![0; LEAD];
    out.extend(&head);
    pending.columns.iter().chain(pending.constants.values()).for_each(|bytes| out.extend(bytes));
    let body = out.len() - LEAD - head.len();
    let hash = blake3::hash(&out[LEAD..]);
    let lead = &mut out[..LEAD];
    lead[..8].copy_from_slice(MAGIC);
    lead[8..16].copy_from_slice(&(head.len() as u64).to_le_bytes());
    lead[16..24].copy_from_slice(&(body as u64).to_le_bytes());
    lead[24..].copy_from_slice(hash.as_bytes());
    Ok(out)
}

/// Parses the episodes of a journal, from episode index `from` on. An incomplete record at the end was never committed
/// and is ignored.
///
/// # Errors
/// If a record is damaged or missing.
pub(super) fn replay(
    path: &Path,
    mut bytes: &[u8],
    columns: &[&ColumnSpec],
    from: usize,
) -> Result<Vec<PendingEpisode>> {
    let damaged =
        |problem: String| Error::corrupt(path, problem, "restore it from a copy, or remove it with its episodes");
    let mut episodes = vec![];
    while let Some((lead, rest)) = bytes.split_at_checked(LEAD) {
        let length = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| lead[at + i]));
        let sizes = usize::try_from(length(8)).ok().zip(usize::try_from(length(16)).ok());
        let complete = sizes.and_then(|(head, body)| Some((head, rest.split_at_checked(head.checked_add(body)?)?)));
        let Some((head, (record, rest))) = complete.filter(|_| lead.starts_with(MAGIC)) else { break };
        if *blake3::hash(record).as_bytes() != lead[24..] {
            if rest.is_empty() {
                break;
            }
            return Err(damaged(format!("the record after episode {} is damaged", from + episodes.len())));
        }
        bytes = rest;
        let (head, mut body) = record.split_at(head);
        let head: Head = serde_json::from_slice(head).map_err(|e| damaged(e.to_string()))?;
        if head.episode < from {
            continue;
        }
        if head.episode != from + episodes.len() {
            let expected = from + episodes.len();
            return Err(damaged(format!("found episode {} instead of {expected}", head.episode)));
        }
        let mut take = |size: Option<usize>| {
            let (bytes, rest) = size.and_then(|size| body.split_at_checked(size))?;
            body = rest;
            Some(bytes.to_vec())
        };
        let data: Option<Vec<Vec<u8>>> =
            columns.iter().map(|column| take(head.rows.checked_mul(column.row_bytes()))).collect();
        let constants: Option<Constants> =
            head.constants.into_iter().map(|(name, size)| Some((name, take(Some(size))?))).collect();
        let (Some(columns), Some(constants)) = (data, constants) else {
            return Err(damaged(format!("episode {} does not have the dataset's columns", head.episode)));
        };
        episodes.push(PendingEpisode { rows: head.rows, columns, constants });
    }
    Ok(episodes)
}

/// A journal opened for appending.
pub(super) struct Journal {
    path: PathBuf,
    file: File,
    length: u64,
}

impl Journal {
    /// Creates an empty journal.
    ///
    /// # Errors
    /// If writing fails.
    pub fn create(folder: &Path) -> Result<Self> {
        let path = path(folder);
        let file = files::open_to_write(&path, false)?;
        Ok(Self { path, file, length: 0 })
    }

    /// Appends records and syncs them to disk. If writing fails, truncates the journal to its previous length.
    ///
    /// # Errors
    /// If writing fails.
    pub fn append(&mut self, records: &[Vec<u8>]) -> Result<()> {
        let written = records.iter().try_for_each(|record| self.file.write_all(record));
        let written = written.and_then(|()| self.file.sync_data());
        if let Err(error) = written {
            // A partial record would make all later records unreadable.
            self.truncate(self.length)?;
            return Err(Error::io(&self.path, "writing the journal", error));
        }
        self.length += records.iter().map(Vec::len).sum::<usize>() as u64;
        Ok(())
    }

    /// Removes all records.
    ///
    /// # Errors
    /// If writing fails.
    pub fn clear(&mut self) -> Result<()> {
        self.truncate(0)?;
        self.length = 0;
        Ok(())
    }

    fn truncate(&mut self, length: u64) -> Result<()> {
        use std::io::Seek as _;
        let seek = std::io::SeekFrom::Start(length);
        let truncated = self.file.set_len(length).and_then(|()| self.file.seek(seek));
        truncated.map(drop).map_err(|e| Error::io(&self.path, "truncating the journal", e))
    }

    /// Deletes the journal.
    ///
    /// # Errors
    /// If deleting fails.
    pub fn remove(self) -> Result<()> {
        files::delete_file(&self.path)
    }
}
