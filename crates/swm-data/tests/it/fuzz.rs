//! Damaged inputs, for the tests of every format: a sound dataset is damaged in ways that a key decides, and reading
//! each copy must end in an error that says something or in data, never in a panic, a hang, or a request for absurd
//! memory.
//!
//! ```ignore
//! let report = fuzz::dataset("lance", &path, 300, fuzz::read_everything);
//! assert!(report.changed.is_empty(), "{:?}", report.changed);   // where the format has checksums
//! assert!(report.refused > 200, "{report:?}");
//! ```
//!
//! A format's suite runs a few hundred cases; a test with `#[ignore]` runs 10,000 or more and says in its module's
//! documentation how. A failure names its case, and [`only`] repeats that one.

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

/// Nothing here needs a piece of memory of this size: who asks for it trusts a damaged length.
const ABSURD_MEMORY: usize = 256 << 20;

/// What reading one case takes at most; more is a hang.
const PATIENCE: Duration = Duration::from_secs(60);

/// What became of the damaged copies.
#[derive(Debug, Default)]
pub struct Report {
    /// How many were refused.
    pub refused: usize,
    /// How many gave what the sound one gives.
    pub same: usize,
    /// Those that gave something else, in words.
    pub changed: Vec<String>,
}

/// The one case to run, where `SWM_FUZZ_CASE` names it.
fn only() -> Option<u64> {
    std::env::var("SWM_FUZZ_CASE").ok().map(|case| case.parse().expect("SWM_FUZZ_CASE is the number of a case"))
}

/// Damages copies of a dataset, a file or a folder: in each case one of its files. Every kind of file (by folder and
/// suffix) gets its share. `read` opens a dataset and gives what it holds, such as [`read_everything`].
pub fn dataset<T: PartialEq>(name: &str, sound: &Path, cases: u64, read: impl Fn(&Path) -> Result<T>) -> Report {
    let folder = tempfile::tempdir().expect("a folder");
    let copy = folder.path().join(sound.file_name().expect("a name"));
    copy_all(sound, &copy);
    let kinds = kinds(&copy);
    let all: Vec<&PathBuf> = kinds.iter().flatten().collect();
    let expected = read(&copy).expect("the sound dataset is read");
    run(name, cases, &expected, |case, rng| {
        let kind = &kinds[case as usize % kinds.len()];
        let file = &kind[rng.random_range(0..kind.len())];
        let bytes = std::fs::read(file).expect("reads");
        let other = all[rng.random_range(0..all.len())];
        let change = match rng.random_range(0..16) {
            0 => {
                std::fs::remove_file(file).expect("removes");
                "removed".to_owned()
            }
            1 if other != file => {
                std::fs::copy(other, file).expect("copies");
                format!("replaced by {}", other.display())
            }
            _ => {
                let (damaged, change) = damage(rng, &bytes);
                std::fs::write(file, damaged).expect("writes");
                change
            }
        };
        let words = format!("{} {change}", file.strip_prefix(folder.path()).unwrap_or(file).display());
        let restore = move || std::fs::write(file, &bytes).expect("writes");
        (words, || read(&copy), restore)
    })
}

/// Damages copies of some bytes, such as an encoded picture.
pub fn bytes<T: PartialEq>(name: &str, sound: &[u8], cases: u64, read: impl Fn(&[u8]) -> Result<T>) -> Report {
    let expected = read(sound).expect("the sound bytes are read");
    run(name, cases, &expected, |_, rng| {
        let (damaged, change) = damage(rng, sound);
        let read = &read;
        (change, move || read(&damaged), || {})
    })
}

/// Opens a dataset and reads all there is: a hash of everything.
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

/// A damaged copy, and what was done to it. The ends, where formats keep their structure, are hit more often.
pub fn damage(rng: &mut Rng, sound: &[u8]) -> (Vec<u8>, String) {
    let mut bytes = sound.to_vec();
    if bytes.is_empty() {
        return (b"not empty".to_vec(), "filled".to_owned());
    }
    let at = place(rng, bytes.len());
    let end = (at + rng.random_range(1..=64)).min(bytes.len());
    let change = match rng.random_range(0..9) {
        0 => {
            bytes.truncate(at);
            format!("cut to {at} of {} bytes", sound.len())
        }
        1 => {
            bytes.extend((0..rng.random_range(1..64)).map(|_| rng.random::<u8>()));
            format!("{} bytes longer", bytes.len() - sound.len())
        }
        2..=3 => {
            let flips: Vec<usize> = (0..rng.random_range(1..4)).map(|_| place(rng, bytes.len())).collect();
            flips.iter().for_each(|&at| bytes[at] ^= 1 << rng.random_range(0..8));
            format!("bits flipped in {flips:?}")
        }
        4..=5 => {
            // A length, a count, an offset or a version that is not what it should be.
            let value =
                [0, 1, u64::MAX, i64::MAX as u64, u32::MAX.into(), i32::MAX as u64, sound.len() as u64 + 1, 1 << 40]
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

fn place(rng: &mut Rng, len: usize) -> usize {
    match rng.random_range(0..4) {
        0 => rng.random_range(0..len.min(128)),
        1 => len - 1 - rng.random_range(0..len.min(128)),
        _ => rng.random_range(0..len),
    }
}

/// Runs the cases that `prepare` makes: what is wrong in words, how to read it, how to restore it.
fn run<T: PartialEq, R: FnOnce() -> Result<T>, C: FnOnce()>(
    name: &str,
    cases: u64,
    expected: &T,
    prepare: impl Fn(u64, &mut Rng) -> (String, R, C),
) -> Report {
    // One at a time: requests for memory are watched on all threads.
    static ONE: Mutex<()> = Mutex::new(());
    let _one = ONE.lock().unwrap_or_else(PoisonError::into_inner);
    let mut report = Report::default();
    let (progress, watched) = channel();
    let watchdog = std::thread::spawn(move || watch(&watched));
    for case in only().map_or(0..cases, |case| case..case + 1) {
        let (change, read, restore) = prepare(case, &mut Key::new(0).with(name).at(case).rng());
        let words = format!("{name}, SWM_FUZZ_CASE={case}: {change}");
        progress.send(words.clone()).expect("the watchdog listens");
        LARGEST.store(0, Ordering::Relaxed);
        let result = catch_unwind(AssertUnwindSafe(read));
        let largest = LARGEST.load(Ordering::Relaxed);
        assert!(largest < ABSURD_MEMORY, "{words}: asked for {largest} bytes at once");
        match result.unwrap_or_else(|_| panic!("{words}: panicked")) {
            Ok(found) if found == *expected => report.same += 1,
            Ok(_) => report.changed.push(words),
            Err(error) => {
                assert!(error.to_string().len() > 30, "{words}: says little: {error}");
                report.refused += 1;
            }
        }
        restore();
    }
    drop(progress);
    watchdog.join().expect("the watchdog ends");
    report
}

/// Ends the program, naming the case, when one takes too long: a hanging thread cannot be ended otherwise.
fn watch(cases: &Receiver<String>) {
    let mut current = String::new();
    loop {
        match cases.recv_timeout(PATIENCE) {
            Ok(case) => current = case,
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) => {
                println!("{current}: hangs");
                std::process::abort();
            }
        }
    }
}

/// The files of a dataset, those of one folder and suffix together.
fn kinds(path: &Path) -> Vec<Vec<PathBuf>> {
    let mut kinds = std::collections::BTreeMap::<_, Vec<PathBuf>>::new();
    for file in files(path) {
        let kind = (file.parent().map(Path::to_owned), file.extension().map(ToOwned::to_owned));
        kinds.entry(kind).or_default().push(file);
    }
    kinds.into_values().collect()
}

/// All files below a folder, or the file itself, by name.
pub fn files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).expect("a folder");
    let mut found: Vec<PathBuf> = entries.flat_map(|entry| files(&entry.expect("an entry").path())).collect();
    found.sort();
    found
}

/// Copies a file, or a folder with all that is in it.
pub fn copy_all(from: &Path, to: &Path) {
    for file in files(from) {
        let target = match file.strip_prefix(from) {
            Ok(rest) if !rest.as_os_str().is_empty() => to.join(rest),
            _ => to.to_owned(),
        };
        std::fs::create_dir_all(target.parent().expect("a folder")).expect("a folder");
        std::fs::copy(&file, &target).expect("copies");
    }
}

/// The largest piece of memory that was asked for since this was last 0, on any thread: readers have threads of their
/// own, and no other test of this program needs as much as is absurd here.
static LARGEST: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, which remembers the largest request.
struct Watching;

// Sound: every call goes to the system's allocator as it came; the number touches neither memory nor arguments.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for Watching {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        LARGEST.fetch_max(layout.size(), Ordering::Relaxed);
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        LARGEST.fetch_max(size, Ordering::Relaxed);
        unsafe { System.realloc(pointer, layout, size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Watching = Watching;

#[test]
fn damage_is_repeatable_and_does_damage() {
    let sound: Vec<u8> = (0..200).collect();
    let mut same = 0;
    for case in 0..500 {
        let key = Key::new(1).at(case);
        let (damaged, words) = damage(&mut key.rng(), &sound);
        assert_eq!((&damaged, &words), (&damage(&mut key.rng(), &sound).0, &damage(&mut key.rng(), &sound).1));
        same += usize::from(damaged == sound);
    }
    assert!(same < 25, "{same} of 500 do nothing");
}

#[test]
fn panics_and_absurd_requests_are_found() {
    let found = |read: fn(&[u8]) -> Result<usize>| {
        let run = || bytes("the harness", &[7; 100], 200, read);
        let panic = catch_unwind(run).expect_err("found");
        panic.downcast_ref::<String>().cloned().unwrap_or_default()
    };
    let trusting = |bytes: &[u8]| Ok(Vec::<u8>::with_capacity(usize::from(bytes.last() != Some(&7)) << 29).capacity());
    assert!(found(trusting).contains("at once"));
    assert!(found(|bytes| Ok(bytes[99].into())).contains("panicked"));
}
