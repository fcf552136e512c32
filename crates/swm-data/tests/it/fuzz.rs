//! Fuzzing with damaged inputs, for the tests of every format. A valid dataset is damaged in keyed random ways; reading
//! each copy must return data or a useful error, without a panic, a hang, or an excessive allocation.
//!
//! ```ignore
//! let report = fuzz::dataset("lance", &path, 300, fuzz::read_everything);
//! assert!(report.changed.is_empty(), "{:?}", report.changed);   // where the format has checksums
//! assert!(report.refused > 200, "{report:?}");
//! ```
//!
//! The suite of a format runs a few hundred cases; tests with `#[ignore]` run 10,000 or more, with the command in the
//! documentation of their module. A failure names its case; the environment variable `SWM_FUZZ_CASE` repeats that case.

use rand::Rng as _;
use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt::Debug;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;
use swm_core::{Key, Result, Rng};
use swm_data::{StepRange, open};

/// Maximum size of an allocation in bytes. A larger allocation means that the reader trusts a damaged length.
const MAX_ALLOCATION: usize = 256 << 20;

/// Time limit per case; a longer run counts as a hang.
const TIME_LIMIT: Duration = Duration::from_secs(60);

/// Results of reading the damaged copies.
#[derive(Debug, Default)]
pub struct Report {
    /// Number of rejected copies.
    pub refused: usize,
    /// Number of copies that gave the same data as the original.
    pub same: usize,
    /// Descriptions of the copies that gave other data.
    pub changed: Vec<String>,
}

/// The case that the environment variable `SWM_FUZZ_CASE` selects, if set.
fn selected_case() -> Option<u64> {
    std::env::var("SWM_FUZZ_CASE").ok().map(|case| case.parse().expect("SWM_FUZZ_CASE is the number of a case"))
}

/// Damages one file of a copy of a dataset (a file or a folder) per case. Every kind of file (by folder and suffix)
/// gets an equal number of cases. `read` opens a dataset and returns the content, as [`read_everything`] does.
pub fn dataset<T: PartialEq>(name: &str, intact: &Path, cases: u64, read: impl Fn(&Path) -> Result<T>) -> Report {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let copy = folder.path().join(intact.file_name().expect("a name"));
    copy_all(intact, &copy);
    let kinds = kinds(&copy);
    let all: Vec<&PathBuf> = kinds.iter().flatten().collect();
    let expected = read(&copy).expect("reading the intact dataset");
    run(name, cases, &expected, |case, rng| {
        let kind = &kinds[case as usize % kinds.len()];
        let file = &kind[rng.random_range(0..kind.len())];
        let bytes = std::fs::read(file).expect("reading a file");
        let other = all[rng.random_range(0..all.len())];
        let change = match rng.random_range(0..16) {
            0 => {
                std::fs::remove_file(file).expect("removing a file");
                "removed".to_owned()
            }
            1 if other != file => {
                std::fs::copy(other, file).expect("copying a file");
                format!("replaced by {}", other.display())
            }
            _ => {
                let (damaged, change) = damage(rng, &bytes);
                std::fs::write(file, damaged).expect("writing a file");
                change
            }
        };
        let change = format!("{} {change}", file.strip_prefix(folder.path()).unwrap_or(file).display());
        let restore = move || std::fs::write(file, &bytes).expect("writing a file");
        (change, || read(&copy), restore)
    })
}

/// Damages copies of a byte string, such as an encoded image.
pub fn bytes<T: PartialEq>(name: &str, intact: &[u8], cases: u64, read: impl Fn(&[u8]) -> Result<T>) -> Report {
    let expected = read(intact).expect("reading the intact bytes");
    run(name, cases, &expected, |_, rng| {
        let (damaged, change) = damage(rng, intact);
        let read = &read;
        (change, move || read(&damaged), || {})
    })
}

/// Opens a dataset and returns a hash of all its content.
pub fn read_everything(path: &Path) -> Result<String> {
    let reader = open(path)?;
    let ranges: Vec<StepRange> =
        reader.episodes().iter().enumerate().map(|(at, e)| StepRange::new(at, 0, e.length)).collect();
    let columns: Vec<&str> = reader.schema().columns().iter().map(|column| column.name.as_str()).collect();
    let batch = reader.read(&columns, &ranges)?;
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{:?} {:?}", reader.schema(), reader.episodes()).as_bytes());
    for column in 0..columns.len() {
        hasher.update(batch.bytes(column));
    }
    for at in 0..ranges.len() {
        hasher.update(format!("{:?}", reader.constants(at)?).as_bytes());
    }
    reader.content_hash()?;
    reader.footprint()?;
    Ok(hasher.finalize().to_hex().to_string())
}

/// Returns a damaged copy and a description of the damage. The start and the end, where formats store their structure,
/// are damaged more often.
pub fn damage(rng: &mut Rng, intact: &[u8]) -> (Vec<u8>, String) {
    let mut bytes = intact.to_vec();
    if bytes.is_empty() {
        return (b"not empty".to_vec(), "filled".to_owned());
    }
    let at = random_offset(rng, bytes.len());
    let end = (at + rng.random_range(1..=64)).min(bytes.len());
    let change = match rng.random_range(0..9) {
        0 => {
            bytes.truncate(at);
            format!("cut to {at} of {} bytes", intact.len())
        }
        1 => {
            bytes.extend((0..rng.random_range(1..64)).map(|_| rng.random::<u8>()));
            format!("{} bytes longer", bytes.len() - intact.len())
        }
        2..=3 => {
            let flips: Vec<usize> = (0..rng.random_range(1..4)).map(|_| random_offset(rng, bytes.len())).collect();
            flips.iter().for_each(|&at| bytes[at] ^= 1 << rng.random_range(0..8));
            format!("bits flipped in {flips:?}")
        }
        4..=5 => {
            // Replaces a length, a count, an offset or a version.
            let value =
                [0, 1, u64::MAX, i64::MAX as u64, u32::MAX.into(), i32::MAX as u64, intact.len() as u64 + 1, 1 << 40]
                    [rng.random_range(0..8)];
            let width = [1, 2, 4, 8][rng.random_range(0..4)].min(bytes.len() - at);
            let (little, big) = (value.to_le_bytes(), value.to_be_bytes());
            let written = if rng.random() { &little[..width] } else { &big[8 - width..] };
            bytes[at..at + width].copy_from_slice(written);
            format!("{written:02x?} written at {at}")
        }
        6 => {
            let value = [0, 0xff, rng.random()][rng.random_range(0..3)];
            bytes[at..end].fill(value);
            format!("{value:#x} written to {at}..{end}")
        }
        7 => {
            bytes.drain(at..end);
            format!("{at}..{end} taken out")
        }
        _ => {
            let from = rng.random_range(0..=bytes.len() - (end - at));
            bytes.copy_within(from..from + (end - at), at);
            format!("{from}.. copied to {at}..{end}")
        }
    };
    (bytes, change)
}

fn random_offset(rng: &mut Rng, len: usize) -> usize {
    match rng.random_range(0..4) {
        0 => rng.random_range(0..len.min(128)),
        1 => len - 1 - rng.random_range(0..len.min(128)),
        _ => rng.random_range(0..len),
    }
}

/// Runs the cases that `prepare` returns: a description, a function that reads the damaged copy, and a function that
/// restores the copy.
fn run<T: PartialEq, R: FnOnce() -> Result<T>, C: FnOnce()>(
    name: &str,
    cases: u64,
    expected: &T,
    prepare: impl Fn(u64, &mut Rng) -> (String, R, C),
) -> Report {
    // Only one fuzz test runs at a time, because allocations are recorded for all threads.
    static LOCK: Mutex<()> = Mutex::new(());
    let _lock = LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let mut report = Report::default();
    let (progress, watched) = channel();
    let watchdog = std::thread::spawn(move || watch(&watched));
    for case in selected_case().map_or(0..cases, |case| case..case + 1) {
        let (change, read, restore) = prepare(case, &mut Key::new(0).with(name).at(case).rng());
        let change = format!("{name}, SWM_FUZZ_CASE={case}: {change}");
        progress.send(change.clone()).expect("a running watchdog");
        LARGEST.store(0, Ordering::Relaxed);
        let result = catch_unwind(AssertUnwindSafe(read));
        let largest = LARGEST.load(Ordering::Relaxed);
        assert!(largest < MAX_ALLOCATION, "{change}: allocated {largest} bytes at once");
        match result.unwrap_or_else(|_| panic!("{change}: panicked")) {
            Ok(found) if found == *expected => report.same += 1,
            Ok(_) => report.changed.push(change),
            Err(error) => {
                assert!(error.to_string().len() > 30, "{change}: the message is too short: {error}");
                report.refused += 1;
            }
        }
        restore();
    }
    drop(progress);
    watchdog.join().expect("joining the watchdog");
    report
}

/// Aborts the process and names the case if the case takes too long, because a hanging thread cannot be stopped.
fn watch(cases: &Receiver<String>) {
    let mut current = String::new();
    loop {
        match cases.recv_timeout(TIME_LIMIT) {
            Ok(case) => current = case,
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {
                println!("{current}: hangs");
                std::process::abort();
            }
        }
    }
}

/// The files of a dataset, grouped by folder and suffix.
fn kinds(path: &Path) -> Vec<Vec<PathBuf>> {
    let mut kinds = std::collections::BTreeMap::<_, Vec<PathBuf>>::new();
    for file in files(path) {
        let kind = (file.parent().map(Path::to_owned), file.extension().map(ToOwned::to_owned));
        kinds.entry(kind).or_default().push(file);
    }
    kinds.into_values().collect()
}

/// All files below a folder, or the file itself, sorted by name.
pub fn files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).expect("listing a folder");
    let mut found: Vec<PathBuf> =
        entries.flat_map(|entry| files(&entry.expect("reading the folder entry").path())).collect();
    found.sort();
    found
}

/// Copies a file, or a folder with its content.
pub fn copy_all(from: &Path, to: &Path) {
    for file in files(from) {
        let target = match file.strip_prefix(from) {
            Ok(rest) if !rest.as_os_str().is_empty() => to.join(rest),
            _ => to.to_owned(),
        };
        std::fs::create_dir_all(target.parent().expect("the path has a parent folder")).expect("creating a folder");
        std::fs::copy(&file, &target).expect("copying a file");
    }
}

/// Size in bytes of the largest allocation since the last reset to 0, on any thread, because readers start threads. No
/// other test of this program allocates as much.
static LARGEST: AtomicUsize = AtomicUsize::new(0);

/// The system allocator, which records the largest allocation.
struct RecordingAllocator;

#[allow(unsafe_code, reason = "recording allocations")]
// SAFETY: every call is forwarded unchanged to the system allocator; recording a size accesses no allocated memory.
unsafe impl GlobalAlloc for RecordingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller upholds the contract of this function, which equals the contract of the system allocator.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller upholds the contract of this function, which equals the contract of the system allocator.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Ordering::Relaxed);
        // SAFETY: the caller upholds the contract of this function, which equals the contract of the system allocator.
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds the contract of this function, which equals the contract of the system allocator.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: RecordingAllocator = RecordingAllocator;

#[test]
fn damage_is_reproducible_and_changes_most_inputs() {
    let intact: Vec<u8> = (0..200).collect();
    let mut same = 0;
    for case in 0..500 {
        let key = Key::new(1).at(case);
        let (damaged, change) = damage(&mut key.rng(), &intact);
        assert_eq!((&damaged, &change), (&damage(&mut key.rng(), &intact).0, &damage(&mut key.rng(), &intact).1));
        same += usize::from(damaged == intact);
    }
    assert!(same < 25, "{same} of 500 changes have no effect");
}

#[test]
fn detects_panics_and_excessive_allocations() {
    let failure = |read: fn(&[u8]) -> Result<usize>| {
        let run = || bytes("the harness", &[7; 100], 200, read);
        let panic = catch_unwind(run).expect_err("reading must panic");
        panic.downcast_ref::<String>().cloned().unwrap_or_default()
    };
    let allocates = |bytes: &[u8]| Ok(Vec::<u8>::with_capacity(usize::from(bytes.last() != Some(&7)) << 29).capacity());
    assert!(failure(allocates).contains("at once"));
    assert!(failure(|bytes| Ok(bytes[99].into())).contains("panicked"));
}
