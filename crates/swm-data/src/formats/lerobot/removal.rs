//! Deletes a dataset that this project wrote, and nothing else in its folder; and the names of its files.

use super::info::{DATA_PATH, EPISODES_PATH, Info, VIDEO_PATH, fill};
use crate::formats::replacing::check_no_links;
use crate::formats::set_aside::{self, DatasetFiles, Places};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use swm_core::files::{self, Lock};
use swm_core::{Error, Result};

/// The file that declares the features and the number of episodes.
pub(super) const INFO: &str = set_aside::LEROBOT.metadata;
/// The table of tasks.
pub(super) const TASKS: &str = "meta/tasks.parquet";
/// The statistics of the features.
pub(super) const STATS: &str = "meta/stats.json";

/// An empty file that exists while a writer is active, or after a writer was killed or failed.
pub(super) const WRITING: &str = "meta/writing.tmp";

/// Deletes the dataset in a folder.
///
/// The names are those of the features in `meta/info.json` and of the files that `meta/episodes` has, whose indices count
/// up from 0. The last index is deleted first, and of an index the list of episodes last; `meta/info.json` is deleted
/// at the end. So after a kill at any time the remaining files still have the metadata that names them, and the next removal
/// deletes the rest.
///
/// # Errors
/// If the metadata cannot be read, another program wrote the dataset, or a file is a symbolic link; then nothing is
/// deleted. Also if a file cannot be deleted, or another process writes to the dataset.
pub(super) fn remove(root: &Path) -> Result<()> {
    let _lock = Lock::folder(root)?;
    set_aside::recover(root, Files)?;
    files::delete_named(root, &Files.names(root)?)
}

/// What replacing needs to know of the format.
#[derive(Clone, Copy)]
pub(super) struct Files;

impl DatasetFiles for Files {
    const PLACES: Places = set_aside::LEROBOT;

    fn names(self, root: &Path) -> Result<Vec<PathBuf>> {
        let mut names = stored_files(root)?;
        names.push(INFO.into());
        Ok(names)
    }

    fn committed(self, root: &Path) -> Result<usize> {
        Ok(Info::read(root)?.total_episodes)
    }

    fn unfinished(self) -> Vec<PathBuf> {
        vec![temporary(INFO)]
    }

    fn remove_empty_folders(self, _: &Path) -> Result<()> {
        Ok(())
    }
}

/// Checks that the dataset in a folder can be replaced.
///
/// # Errors
/// As [`remove`].
pub(super) fn check_replaceable(root: &Path) -> Result<()> {
    check_no_links(root, &stored_files(root)?)
}

/// The files apart from `meta/info.json`, in the order of deletion.
fn stored_files(root: &Path) -> Result<Vec<PathBuf>> {
    let refused = |problem: String| {
        let problem = format!("the names of its files are unknown: {problem}");
        Error::corrupt(root, problem, "delete the dataset by hand, or choose another path")
    };
    let info = Info::read(root).map_err(|error| refused(error.to_string()))?;
    if info.stable_worldmodel.is_none() || !info.is_v3() {
        return Err(refused("another program wrote it".to_owned()));
    }
    let has_episodes = |index: &usize| root.join(fill(EPISODES_PATH, "", &indices(&info, *index))).is_file();
    // Every file has at least one episode. A killed commit may have left the files of one more index.
    let killed = root.join(WRITING).exists();
    let files = (0..=info.total_episodes).take_while(has_episodes).count() + usize::from(killed);
    let mut names: Vec<PathBuf> = (0..files).rev().flat_map(|index| files_of_index(&info, index)).collect();
    names.extend([TASKS, STATS].into_iter().flat_map(with_temporary));
    names.extend([temporary(INFO), WRITING.into()]);
    Ok(names)
}

/// Whether a folder holds only what a writer leaves that was killed before its first `meta/info.json`: the beginning of that file.
pub fn is_unfinished(root: &Path) -> bool {
    let names =
        |folder: &Path| -> Option<Vec<_>> { folder.read_dir().ok()?.map(|entry| Some(entry.ok()?.path())).collect() };
    let meta = root.join("meta");
    let is_start = |path: &PathBuf| {
        *path == root.join(temporary(INFO))
            && files::open(path).is_ok_and(|file| {
                let mut start = vec![];
                file.take(1).read_to_end(&mut start).is_ok() && b"{".starts_with(&start)
            })
    };
    names(root).is_some_and(|found| found == [meta.clone()])
        && files::check_no_link(&meta).is_ok()
        && names(&meta).is_some_and(|found| found.iter().all(is_start))
}

/// The files of one commit, and their temporary files: videos, rows, and the list of episodes.
pub(super) fn files_of_index(info: &Info, index: usize) -> Vec<PathBuf> {
    let indices = indices(info, index);
    let videos = info.video_keys().into_iter().map(|key| fill(VIDEO_PATH, key, &indices));
    let tables = [DATA_PATH, EPISODES_PATH].map(|template| fill(template, "", &indices));
    videos.chain(tables).flat_map(|name| with_temporary(&name)).collect()
}

/// Index of the chunk, and index of the file in it.
pub(super) fn indices(info: &Info, index: usize) -> [(&'static str, usize); 2] {
    [("chunk_index", index / info.chunks_size), ("file_index", index % info.chunks_size)]
}

fn with_temporary(name: &str) -> [PathBuf; 2] {
    [name.into(), temporary(name)]
}

/// The temporary file that replaces a file.
fn temporary(name: &str) -> PathBuf {
    format!("{name}.tmp").into()
}
