//! [`LanceReader`]: the state of an open table, and the caches that the modules of the reader share.

use crate::dataset::Episode;
use crate::dataset::objects::{BlockCache, REPLACED};
use crate::formats::lance::image_locations::ImageLocations;
use crate::formats::lance::schema::StoredColumn;
use crate::formats::lance::store::Store;
use crate::formats::opened::replaced;
use lance_file::reader::FileReader;
use lance_table::format::Manifest as Table;
use std::collections::{HashMap, HashSet, VecDeque};
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use swm_core::{Error, Schema};

/// Maximum number of open local data files. Each file takes up to two file descriptors; a process may usually open
/// 1024.
const OPEN_FILES: usize = 32;

/// Maximum number of open data files in an object store, which only take memory.
const OPEN_OBJECTS: usize = 1024;

/// An open table of episodes.
pub struct LanceReader {
    pub(super) store: Store,
    pub(super) table: Arc<Table>,
    pub(super) schema: Schema,
    pub(super) columns: Vec<StoredColumn>,
    pub(super) episodes: Vec<Episode>,
    /// First row of each episode, counted over the table.
    pub(super) first_rows: Vec<u64>,
    /// First row of each fragment, followed by the number of rows of the table.
    pub(super) fragment_rows: Vec<u64>,
    pub(super) files: Mutex<RecentFiles<FileReader>>,
    /// Local data files, opened for reading at offsets.
    pub(super) handles: Mutex<RecentFiles<File>>,
    /// Locations of images that were looked up before.
    pub(super) image_locations: Mutex<ImageLocationCache>,
    pub(super) value_cache: Mutex<ValueCache>,
    /// Cached blocks of an object store.
    pub(super) blocks: Arc<BlockCache>,
    /// Data files whose content was verified.
    pub(super) verified: Mutex<HashSet<String>>,
}

impl LanceReader {
    /// The folder or address of the table, for error messages.
    pub(super) fn folder(&self) -> &Path {
        &self.store.label
    }

    /// The error of a read, or that the files were replaced: then the store says so, or the newest version of the table
    /// lacks a data file of this one.
    pub(super) fn explained(&self, error: Error) -> Error {
        if self.store.remote && error.to_string().contains(REPLACED) {
            let problem =
                "its files were replaced since the dataset was opened, or several servers answer with other tags";
            return Error::corrupt(self.folder(), problem, "open the dataset again, from one server");
        }
        let files = |table: &Table| -> HashSet<String> {
            table.fragments.iter().flat_map(|fragment| &fragment.files).map(|file| file.path.clone()).collect()
        };
        match self.store.latest() {
            Ok(Some(newest)) if !files(&self.table).is_subset(&files(&newest.manifest)) => replaced(self.folder()),
            _ => error,
        }
    }

    /// The number of rows of the table.
    pub(super) fn rows(&self) -> u64 {
        self.fragment_rows[self.fragment_rows.len() - 1]
    }

    /// The fragment that contains a row.
    pub(super) fn fragment_of(&self, row: u64) -> usize {
        self.fragment_rows.partition_point(|&first| first <= row) - 1
    }
}

/// The most recently opened files by path, up to `limit`.
pub(super) struct RecentFiles<T> {
    by_path: HashMap<String, Arc<T>>,
    /// Paths, oldest first.
    order: VecDeque<String>,
    limit: usize,
}

impl<T> RecentFiles<T> {
    pub(super) fn new(store: &Store) -> Self {
        Self { by_path: HashMap::new(), order: VecDeque::new(), limit: max_open_files(store) }
    }

    pub(super) fn get(&self, path: &str) -> Option<Arc<T>> {
        self.by_path.get(path).map(Arc::clone)
    }

    pub(super) fn insert(&mut self, path: &str, file: &Arc<T>) {
        if self.by_path.insert(path.to_owned(), Arc::clone(file)).is_some() {
            return;
        }
        self.order.push_back(path.to_owned());
        if self.order.len() > self.limit
            && let Some(oldest) = self.order.pop_front()
        {
            self.by_path.remove(&oldest);
        }
    }
}

/// Maximum number of data files open at a time.
pub(super) fn max_open_files(store: &Store) -> usize {
    if store.remote { OPEN_OBJECTS } else { OPEN_FILES }
}

/// Decoded values by fragment and column name.
#[derive(Default)]
pub(super) struct ValueCache {
    pub(super) columns: HashMap<(usize, String), Arc<Vec<u8>>>,
    pub(super) bytes: usize,
}

/// The images of one column in one data file.
pub(super) struct FileImages {
    /// Name of the data file.
    pub(super) path: String,
    /// Size of the file in bytes.
    pub(super) size: u64,
    pub(super) locations: ImageLocations,
}

/// Locations by fragment and column name; `None` if the column must be read with Lance's decoder.
type ImageLocationCache = HashMap<(usize, String), Option<Arc<FileImages>>>;

/// A row of the table, and the bytes of the output that receive the row.
pub(super) type RowSlot<'a> = (u64, &'a mut [u8]);

/// Locks a mutex, even if it is poisoned.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // The guarded data is valid after every statement, so poisoning is ignored.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Merges sorted rows into ranges.
pub(super) fn merged(requested: &[&mut RowSlot]) -> Vec<Range<u64>> {
    let mut merged: Vec<Range<u64>> = vec![];
    for &&mut (row, _) in requested {
        match merged.last_mut() {
            Some(range) if row < range.end => {}
            Some(range) if row == range.end => range.end += 1,
            _ => merged.push(row..row + 1),
        }
    }
    merged
}
