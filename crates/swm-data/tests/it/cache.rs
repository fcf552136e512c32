//! Caches of decoded rows: cached reads return the same bytes with fewer decodes, and never rows of another dataset.

use crate::sample::write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use swm_core::{Manifest, Result, Schema};
use swm_data::{CacheConfig, Episode, Reader, StepRange, WriteMode, open};

/// A reader that counts the image rows it decodes.
struct Counting {
    inner: Arc<dyn Reader>,
    rows: AtomicUsize,
}

impl Counting {
    fn open(path: &Path) -> Arc<Self> {
        Arc::new(Self { inner: open(path).expect("opening the dataset"), rows: AtomicUsize::new(0) })
    }

    fn decoded(&self) -> usize {
        self.rows.swap(0, Ordering::Relaxed)
    }
}

impl Reader for Counting {
    fn schema(&self) -> &Schema {
        self.inner.schema()
    }

    fn episodes(&self) -> &[Episode] {
        self.inner.episodes()
    }

    fn read_column(&self, column: &str, ranges: &[StepRange], out: &mut [u8]) -> Result<()> {
        if column == "pixels" {
            self.rows.fetch_add(ranges.iter().map(|range| range.length).sum(), Ordering::Relaxed);
        }
        self.inner.read_column(column, ranges, out)
    }

    fn manifest(&self) -> Option<Manifest> {
        self.inner.manifest()
    }

    fn footprint(&self) -> Result<Vec<(String, u64)>> {
        self.inner.footprint()
    }

    fn content_hash(&self) -> Result<String> {
        self.inner.content_hash()
    }
}

const IMAGE: usize = 16 * 24 * 3;

fn with_cache(reader: &Arc<Counting>, cache: &CacheConfig) -> Arc<dyn Reader> {
    cache.over(Arc::clone(reader) as Arc<dyn Reader>, &["pixels", "state"]).expect("a cache")
}

/// Reads every image and state row by row, the last episode first, and then three rows of episode 2 again.
fn read_all(reader: &dyn Reader) -> (Vec<u8>, Vec<u8>) {
    let rows = |e: usize| (0..reader.episodes()[e].length).map(move |t| StepRange::new(e, t, 1));
    let mut ranges: Vec<StepRange> = (0..reader.episodes().len()).rev().flat_map(rows).collect();
    ranges.push(StepRange::new(2, 1, 3));
    let batch = reader.read(&["pixels", "state"], &ranges).expect("reading rows");
    (batch.bytes(0).to_vec(), batch.bytes(1).to_vec())
}

fn dataset(folder: &Path) -> (PathBuf, usize) {
    let path = folder.join("d.lance");
    write(&path, WriteMode::Create, 3, 0..6);
    (path, (5..11).sum::<usize>())
}

#[test]
fn cached_rows_are_decoded_once_within_the_byte_limit() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, rows) = dataset(folder.path());
    let reader = Counting::open(&path);
    let expected = read_all(&*reader);
    reader.decoded();
    let states = rows * 24;
    for (limit, cached_rows) in [(0, 0), (10, 10), (1000, rows)] {
        for cache in [
            CacheConfig::Memory { bytes: states + limit * IMAGE },
            CacheConfig::Disk { folder: folder.path().join(format!("cache-{limit}")), bytes: states + limit * IMAGE },
        ] {
            let cached = with_cache(&reader, &cache);
            assert!(read_all(&*cached) == expected, "{cache:?}");
            assert_eq!(reader.decoded(), rows + 3, "first read with {cache:?}");
            assert!(read_all(&*cached) == expected, "{cache:?}");
            // A cached row saves two decodes if it is one of the three rows that are read twice.
            let decoded = reader.decoded();
            let again = if cached_rows == rows { 0..=0 } else { rows - cached_rows..=rows + 3 - cached_rows };
            assert!(again.contains(&decoded), "{decoded} of {rows} with {cache:?}");
            let wrong =
                cached.read(&["pixels"], &[StepRange::new(0, 3, 4)]).expect_err("rows beyond the episode").to_string();
            assert!(wrong.contains("rows below 5"), "{wrong}");
            reader.decoded();
        }
    }
}

#[test]
fn disk_cache_serves_later_and_concurrent_readers_of_the_same_content() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, _) = dataset(folder.path());
    let cache = CacheConfig::Disk { folder: folder.path().join("cache"), bytes: 1 << 30 };
    let reader = Counting::open(&path);
    let expected = read_all(&*with_cache(&reader, &cache));
    reader.decoded();
    let first = with_cache(&reader, &cache);
    assert!(read_all(&*first) == expected && reader.decoded() == 0, "a new run reads the cached rows");
    // A second cache does not get the lock while the first cache exists, but reads the existing rows.
    let second = with_cache(&reader, &cache);
    assert!(read_all(&*second) == expected && reader.decoded() == 0);
    drop((first, second));

    // A dataset with other content at the same path does not use the old cache.
    write(&path, WriteMode::Overwrite, 3, 1..7);
    let changed = Counting::open(&path);
    let fresh = read_all(&*changed);
    changed.decoded();
    assert!(read_all(&*with_cache(&changed, &cache)) == fresh && changed.decoded() > 0);
}

#[test]
fn links_in_a_cache_are_not_written_through() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, _) = dataset(folder.path());
    let cache = CacheConfig::Disk { folder: folder.path().join("cache"), bytes: 1 << 30 };
    let reader = Counting::open(&path);
    read_all(&*with_cache(&reader, &cache));
    let mine = folder.path().join("mine");
    std::fs::write(&mine, b"mine").expect("writing a file");
    let entry = std::fs::read_dir(folder.path().join("cache")).expect("listing the cache").flatten().next();
    for file in std::fs::read_dir(entry.expect("a folder").path()).expect("listing a cache folder").flatten() {
        std::fs::remove_file(file.path()).expect("removing a file");
        std::os::unix::fs::symlink(&mine, file.path()).expect("a link");
    }
    let refused = cache.over(Arc::clone(&reader) as Arc<dyn Reader>, &["pixels"]).err().expect("a link");
    assert!(refused.to_string().contains("is a symbolic link"), "{refused}");
    assert_eq!(std::fs::read(&mine).expect("reading the file"), b"mine");
}

/// The files of a cache of one dataset.
fn files_of(cache: &Path) -> Vec<PathBuf> {
    let mut found = vec![];
    for dataset in std::fs::read_dir(cache).expect("listing the cache").flatten() {
        found.extend(
            std::fs::read_dir(dataset.path()).expect("listing a cache folder").flatten().map(|entry| entry.path()),
        );
    }
    found.sort();
    found
}

/// The file with the rows of a cache of one column of one dataset.
fn rows_file(cache: &Path) -> PathBuf {
    let is_rows = |file: &PathBuf| file.extension().is_some_and(|end| end == "rows");
    files_of(cache).into_iter().find(is_rows).expect("finding the rows file")
}

#[test]
fn a_cache_that_is_shortened_or_written_over_while_it_is_open_is_checked_again() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, rows) = dataset(folder.path());
    let cache = CacheConfig::Disk { folder: folder.path().join("cache"), bytes: 1 << 30 };
    let reader = Counting::open(&path);
    let cached = with_cache(&reader, &cache);
    let expected = read_all(&*cached);
    reader.decoded();
    let file = rows_file(&folder.path().join("cache"));
    let original = std::fs::read(&file).expect("reading the file");
    let write_later = |bytes: &[u8]| {
        std::fs::write(&file, bytes).expect("writing the file");
        let opened = std::fs::File::options().write(true).open(&file).expect("opening the file");
        let later = std::time::SystemTime::now() + std::time::Duration::from_secs(60);
        opened.set_modified(later).expect("setting the time of the file");
    };
    // The same content: nothing is decoded again.
    write_later(&original);
    assert!(read_all(&*cached) == expected && reader.decoded() == 0);
    write_later(&original.iter().map(|byte| !byte).collect::<Vec<u8>>());
    assert!(read_all(&*cached) == expected);
    assert_eq!(reader.decoded(), rows + 3);
    write_later(b"");
    assert!(read_all(&*cached) == expected);
    assert_eq!(reader.decoded(), rows + 3);
}

#[test]
fn rows_of_the_cache_of_another_dataset_are_decoded_again() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, rows) = dataset(folder.path());
    let other = folder.path().join("other.lance");
    write(&other, WriteMode::Create, 3, 1..7);
    let at = |name: &str| folder.path().join(name);
    for (from, name) in [(&path, "first"), (&other, "second")] {
        read_all(&*with_cache(&Counting::open(from), &CacheConfig::Disk { folder: at(name), bytes: 1 << 30 }));
    }
    let (first, second) = (files_of(&at("first")), files_of(&at("second")));
    for (to, from) in first.iter().zip(&second) {
        std::fs::copy(from, to).expect("copying a file");
    }
    let reader = Counting::open(&path);
    let expected = read_all(&*reader);
    reader.decoded();
    let cached = with_cache(&reader, &CacheConfig::Disk { folder: at("first"), bytes: 1 << 30 });
    assert!(read_all(&*cached) == expected);
    assert_eq!(reader.decoded(), rows + 3);
}

#[test]
fn damaged_cache_rows_are_decoded_again() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let (path, rows) = dataset(folder.path());
    let cache = CacheConfig::Disk { folder: folder.path().join("cache"), bytes: 1 << 30 };
    let reader = Counting::open(&path);
    let expected = read_all(&*with_cache(&reader, &cache));
    reader.decoded();
    let files = || files_of(&folder.path().join("cache"));
    let rows_file = rows_file(&folder.path().join("cache"));
    // Flips a bit of the third row.
    let mut bytes = std::fs::read(&rows_file).expect("reading a file");
    bytes[2 * IMAGE + 7] ^= 1;
    std::fs::write(&rows_file, &bytes).expect("writing a file");
    assert!(read_all(&*with_cache(&reader, &cache)) == expected);
    assert_eq!(reader.decoded(), 1);
    assert!(
        read_all(&*with_cache(&reader, &cache)) == expected && reader.decoded() == 0,
        "the damaged row is stored again"
    );
    // Empties both files.
    for file in files() {
        std::fs::write(&file, b"").expect("writing a file");
    }
    assert!(read_all(&*with_cache(&reader, &cache)) == expected);
    assert_eq!(reader.decoded(), rows + 3);
}
