//! What the formats `folder` and `video` share, and the reference's datasets of these kinds with them: a folder with
//! the numbers of a column in one file each, and a subfolder for every column of pictures, which is the formats' own.
//!
//! ```text
//! NAME/
//!   ep_len.npz, ep_offset.npz    rows of every episode, and its first row
//!   COLUMN.npz                   [rows, shape…], all episodes one after another
//!   COLUMN/                      pictures
//!   ep_len.journal               only while a writer is at work, or after it was killed
//! ```
//!
//! The reference takes every file for a column unless its name begins with `ep_len` or `ep_offset`. So what it need not
//! know (schema, manifest, constants of the episodes) lies beside the lengths in `ep_len.npz`, where its reader does not
//! look, and our other files are called `ep_len` as well.
//!
//! **Commits.** Arrays in archives cannot grow in place. Finished episodes are appended to the journal, a record each
//! with a checksum; now and then, and at the end, they are folded into the column files: each is written anew beside the
//! old one and renamed, `ep_len.npz` last. Until then, columns that are already longer are read as far as `ep_len.npz`
//! says. Folding waits for the journal to be half as long as the columns, so that all of it writes a few times the size
//! of the data.

mod journal;
mod npz;
mod reader;
mod writer;

pub(crate) use reader::ColumnFiles;
pub(crate) use writer::{ColumnFilesWriter, lock, replace};

use crate::dataset::Constants;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::{Error, Manifest, Result, Schema};

/// Where the rows of episodes are recorded; the commit of everything.
const LENGTHS: &str = "ep_len";
/// See [`LENGTHS`].
const OFFSETS: &str = "ep_offset";
/// The member of `ep_len.npz` with what we record.
const RECORDED: &str = "stable_worldmodel.json";

/// What is recorded beside the lengths, for ourselves.
#[derive(Default, Serialize, Deserialize)]
struct Recorded {
    /// All columns, pictures included.
    schema: Option<Schema>,
    manifest: Option<Manifest>,
    /// Names of each episode's constants, and the members ([`constant_member`]) that hold them. Episodes often share.
    constants: Vec<BTreeMap<String, usize>>,
}

/// The member of `ep_len.npz` that holds a constant of some episodes.
fn constant_member(index: usize) -> String {
    format!("constants/{index}")
}

/// An episode that is in the journal only.
struct Pending {
    rows: usize,
    /// The bytes of each column of numbers.
    columns: Vec<Vec<u8>>,
    constants: Constants,
}

/// Whether a folder holds column files, complete or begun.
pub(crate) fn is_there(folder: &Path) -> bool {
    file(folder, LENGTHS).is_file()
}

/// Whether the subfolders of a folder hold videos rather than pictures.
pub(crate) fn holds_videos(folder: &Path) -> bool {
    let entries = |folder: &Path| folder.read_dir().into_iter().flatten().flatten();
    let is_video = |path: &Path| path.extension().is_some_and(|suffix| suffix.eq_ignore_ascii_case("mp4"));
    entries(folder).any(|entry| entries(&entry.path()).next().is_some_and(|first| is_video(&first.path())))
}

/// The archive of a column.
fn file(folder: &Path, column: &str) -> PathBuf {
    folder.join(format!("{column}.npz"))
}

/// Checks that a column's name can be a file's.
fn check_name(name: &str) -> Result<()> {
    let problem = match name {
        "" | "." | ".." => "is no name for a file",
        _ if name.contains(['/', '\\', '\0']) => "has letters that the name of a file must not have",
        _ if name.split('.').next().is_some_and(|stem| stem == LENGTHS || stem == OFFSETS) => "is used by the format",
        _ => return Ok(()),
    };
    Err(Error::config("schema", format!("the column name '{name}' {problem}"), "rename the column"))
}
