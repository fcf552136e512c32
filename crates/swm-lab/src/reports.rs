//! Results, studies, autopsies and leaderboards: folders with a `results.json`, a `study.json`, an `autopsy.json` or the file of a built
//! leaderboard, and the pages of each.
//!
//! A page is shown in a frame of its own, whose policy permits no script, no connection, and no access to the lab.

use crate::folders::Folders;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};
use swm_core::{Error, Result, files};

/// How deep reports are looked for.
const DEPTH: usize = 3;
/// The largest number of reports in a list.
const MOST: usize = 500;
/// The largest stored page, in bytes.
const MOST_BYTES: u64 = 64 << 20;
/// The folder of the pages of entries in a leaderboard.
const ENTRIES: &str = "entries";
/// Folders that hold no reports, and may hold many files.
const SKIPPED: [&str; 1] = ["datasets"];

/// What a folder holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// A `results.json`.
    Results,
    /// A `study.json`.
    Study,
    /// An `autopsy.json`.
    Autopsy,
    /// The pages of a leaderboard, with the file that `swm leaderboard build` leaves.
    Leaderboard,
}

impl Kind {
    /// The file that a folder of this kind has.
    pub fn file(self) -> &'static str {
        match self {
            Self::Results => "results.json",
            Self::Study => "study.json",
            Self::Autopsy => "autopsy.json",
            Self::Leaderboard => "last-build",
        }
    }

    /// What a folder holds; `None` for any other folder, and for one whose file is a link.
    fn of(path: &Path) -> Option<Self> {
        [Self::Autopsy, Self::Study, Self::Results, Self::Leaderboard]
            .into_iter()
            .find(|kind| path.join(kind.file()).symlink_metadata().is_ok_and(|metadata| metadata.is_file()))
    }
}

/// What a list shows of results or of a study.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Summary {
    /// The title.
    pub title: String,
    /// What was found, a line each.
    pub lines: Vec<String>,
}

/// What the program makes of results and studies.
pub trait Reports: Send + Sync {
    /// Summarises what a folder holds.
    ///
    /// # Errors
    /// When it is damaged.
    fn summary(&self, kind: Kind, folder: &Path) -> Result<Summary>;

    /// Makes the page of what a folder holds: HTML in one file, without scripts.
    ///
    /// # Errors
    /// When it is damaged.
    fn page(&self, kind: Kind, folder: &Path) -> Result<String>;
}

/// A report of a list.
#[derive(Debug, Serialize)]
pub struct Listed {
    /// The index of its folder.
    folder: usize,
    /// Its path in the folder.
    name: String,
    kind: Kind,
    /// When it was written last, in seconds since 1970.
    modified: u64,
    #[serde(flatten)]
    summary: Summary,
    /// Its further pages.
    pages: Vec<String>,
    /// Why it cannot be shown.
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// A summary, or why there is none.
type Read = (Summary, Option<String>);

/// Summaries that were read, by path and time of change.
#[derive(Default)]
pub struct Known(Mutex<BTreeMap<(PathBuf, SystemTime), Read>>);

impl Known {
    /// The reports of the folders, sorted by name.
    pub fn list(&self, reports: &dyn Reports, folders: &Folders) -> Vec<Listed> {
        let found = folders.list(DEPTH, |path| Kind::of(path).is_some() || is_skipped(path));
        let found = found.into_iter().filter_map(|found| Some((Kind::of(&found.path)?, found))).take(MOST);
        let listed = found.filter_map(|(kind, found)| {
            let modified = found.path.join(kind.file()).metadata().and_then(|metadata| metadata.modified()).ok()?;
            let path = found.path.clone();
            let (summary, error) = self.summary(reports, kind, found.path, modified);
            let since = modified.duration_since(UNIX_EPOCH).map_or(0, |since| since.as_secs());
            let pages = if kind == Kind::Leaderboard { entries(&path) } else { vec![] };
            Some(Listed { folder: found.folder, name: found.name, kind, modified: since, summary, pages, error })
        });
        listed.collect()
    }

    fn summary(&self, reports: &dyn Reports, kind: Kind, path: PathBuf, modified: SystemTime) -> Read {
        let key = (path, modified);
        // A study fills in without a change of its first file.
        if kind == Kind::Results
            && let Some(known) = self.0.lock().unwrap_or_else(PoisonError::into_inner).get(&key)
        {
            return known.clone();
        }
        if kind == Kind::Leaderboard {
            let title = format!("{} entries", entries(&key.0).len());
            return (Summary { title, lines: vec![] }, None);
        }
        let found = match reports.summary(kind, &key.0) {
            Ok(summary) => (summary, None),
            Err(error) => (Summary::default(), Some(error.to_string())),
        };
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() > 2 * MOST {
            known.clear();
        }
        known.insert(key, found.clone());
        found
    }
}

fn is_skipped(path: &Path) -> bool {
    path.file_name().is_some_and(|name| SKIPPED.iter().any(|skipped| name == *skipped))
}

/// The pages of the entries of a leaderboard, without those that are links; none if their folder is a link.
fn entries(leaderboard: &Path) -> Vec<String> {
    let folder = leaderboard.join(ENTRIES);
    let found =
        (!folder.is_symlink()).then(|| std::fs::read_dir(folder)).into_iter().flatten().flatten().flatten().take(MOST);
    let names = found.filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_file()));
    let mut names: Vec<String> = names.filter_map(|entry| entry.file_name().into_string().ok()).collect();
    names.retain(|name| name.ends_with(".html"));
    names.sort();
    names
}

/// Reads a page of a leaderboard: that of the tables, or of an entry.
fn stored(leaderboard: &Path, entry: &str) -> Result<String> {
    let page = match entries(leaderboard).into_iter().find(|name| name == entry) {
        _ if entry.is_empty() => leaderboard.join("index.html"),
        Some(name) => leaderboard.join(ENTRIES).join(name),
        None => {
            return Err(Error::config(entry, "the leaderboard has no such entry", "reload the page, which lists them"));
        }
    };
    if page.symlink_metadata().is_ok_and(|metadata| metadata.is_symlink()) {
        return Err(Error::config(page.display().to_string(), "it is a symbolic link", "build the leaderboard again"));
    }
    let damaged = |error| Error::corrupt(&page, format!("is no text ({error})"), "build the leaderboard again");
    let text = String::from_utf8(files::read(&page, MOST_BYTES)?).map_err(damaged)?;
    // The lab refuses what a page in a frame of another origin asks for: a link would lead to an error.
    Ok(text.replace(" href=\"entries/", " data-entry=\"").replace(" href=\"../index.html", " data-entry=\""))
}

/// Makes the page of a report; `entry` is one of the further pages of a leaderboard, or empty.
///
/// # Errors
/// When there is no such report, or it is damaged.
pub fn page(reports: &dyn Reports, folders: &Folders, folder: usize, name: &str, entry: &str) -> Result<String> {
    let path = folders.find(folder, name, DEPTH, |path| Kind::of(path).is_some() || is_skipped(path))?;
    let kind = Kind::of(&path)
        .ok_or_else(|| Error::config(name, "it holds no results and no study", "reload the page, which lists them"))?;
    if kind == Kind::Leaderboard { stored(&path, entry) } else { reports.page(kind, &path) }
}
