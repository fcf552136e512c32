//! Column files: the numeric columns of the formats `folder` and `video`, in the layout of the reference's datasets.
//! A folder holds one file for each numeric column, and one subfolder for each image column. The format defines the
//! content of the subfolders.
//!
//! ```text
//! NAME/
//!   ep_len.npz, ep_offset.npz    length and first row of every episode
//!   COLUMN.npz                   [rows, shape…], all episodes one after another
//!   COLUMN/                      images
//!   ep_len.journal               only while a writer is active, or after a writer was killed
//! ```
//!
//! The reference treats every file as a column unless its name starts with `ep_len` or `ep_offset`. Therefore schema,
//! manifest and constants are additional members of `ep_len.npz`, which the reference ignores, and the names of the
//! journal and of temporary files start with `ep_len`.
//!
//! **Commits.** Arrays in archives cannot grow in place. Finished episodes are therefore appended to the journal, each
//! as a record with a checksum. A merge copies the journal into the column files: each column file is written to a
//! temporary file and renamed, `ep_len.npz` last. Readers use only as many rows of a column file as `ep_len.npz`
//! declares. The journal is merged when it is half as large as the column files, and when the writer finishes, so the
//! total amount written is a small multiple of the data.
//!
//! **Replacing** moves the old dataset's own files to `ep_len.replaced/`, its metadata last, until the new dataset has a
//! committed episode. Other files in the folder are neither deleted nor moved nor overwritten.

mod images;
mod journal;
mod npz;
mod reader;
mod removal;
mod writer;

pub(crate) use images::{ImageFiles, SUFFIXES, image_path, video_path};
pub(crate) use reader::{ColumnFiles, check_unchanged, contains_videos, state_of};
pub(crate) use removal::remove;
pub(crate) use writer::ColumnFilesWriter;

use crate::formats::opened;
use npz::Npz;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use swm_core::{Error, Manifest, Result, Schema, files};

/// Name of the file with the lengths of the episodes. Replacing this file commits a merge.
const LENGTHS: &str = "ep_len";
/// Name of the file with the first rows of the episodes.
const OFFSETS: &str = "ep_offset";
/// The member of `ep_len.npz` that holds [`Metadata`].
const METADATA: &str = "stable_worldmodel.json";

/// Name of the temporary file that replaces a column file. The reference ignores names that start with `ep_len`.
const TEMPORARY: &str = "ep_len.tmp";
/// The first bytes of a ZIP archive, which an `.npz` is.
const ZIP: &[u8] = b"PK\x03\x04";

/// Metadata of the dataset, stored in `ep_len.npz`.
#[derive(Default, Serialize, Deserialize)]
struct Metadata {
    /// All columns, including images.
    schema: Option<Schema>,
    manifest: Option<Manifest>,
    /// For each episode, the names of its constants and the indices of the members ([`constant_member`]) that hold
    /// them. Episodes may share members.
    constants: Vec<BTreeMap<String, usize>>,
    /// How often the dataset was replaced by another one at its path.
    #[serde(default, skip_serializing_if = "opened::is_zero")]
    replaced: u64,
}

/// Name of the member of `ep_len.npz` that holds the constant with an index.
fn constant_member(index: usize) -> String {
    format!("constants/{index}")
}

/// Returns whether a folder contains `ep_len.npz`.
pub(crate) fn exists(folder: &Path) -> bool {
    column_path(folder, LENGTHS).is_file()
}

/// Checks that a folder contains `ep_len.npz`.
///
/// # Errors
/// If it does not, or may not be read.
pub(super) fn check_exists(folder: &Path) -> Result<()> {
    if files::exists(&column_path(folder, LENGTHS))? {
        return Ok(());
    }
    let problem = if files::exists(folder)? { "it holds no ep_len.npz" } else { "there is no such dataset" };
    Err(Error::corrupt(folder, problem, "check the path; `swm datasets` lists the stored datasets"))
}

/// Returns whether a folder is empty, or contains only the first files of a writer that was killed, or whose disk was full, before its
/// first commit: a part of an archive, and the first rows of no episodes.
pub(super) fn has_no_dataset(folder: &Path) -> bool {
    let Ok(mut entries) = folder.read_dir() else { return false };
    let is_left = |path: &Path| {
        path.ends_with(TEMPORARY)
            && files::open(path).is_ok_and(|file| {
                let mut start = vec![];
                file.take(ZIP.len() as u64).read_to_end(&mut start).is_ok() && ZIP.starts_with(&start)
            })
    };
    let has_no_rows = |path: &Path| {
        *path == column_path(folder, OFFSETS)
            && Npz::open(path).and_then(|mut file| file.header()).is_ok_and(|header| header.rows() == 0)
    };
    entries.all(|entry| entry.is_ok_and(|entry| is_left(&entry.path()) || has_no_rows(&entry.path())))
}

/// Path of the file of a column.
fn column_path(folder: &Path, column: &str) -> PathBuf {
    folder.join(format!("{column}.npz"))
}

/// Checks that a column's name is a valid file name.
fn check_name(name: &str) -> Result<()> {
    let problem = match name {
        "" | "." | ".." => "is not a file name",
        _ if name.contains(['/', '\\', '\0']) => "contains characters that file names must not contain",
        _ if name.split('.').next().is_some_and(|stem| stem == LENGTHS || stem == OFFSETS) => {
            "is reserved by the format"
        }
        _ => return Ok(()),
    };
    Err(Error::config("schema", format!("the column name '{name}' {problem}"), "rename the column"))
}
