//! Helpers of the fuzzers: the seeds, and reading what an input holds. `make nightly` runs the fuzzers, and
//! `docs/nightly.md` records their results.
//!
//! A reader must return data or an error. A panic, an abort, a memory error, a run above the time limit and an
//! allocation above the memory limit are findings.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use swm::leaderboard::Entry;
use swm_core::results::{Comparison, Run};

/// The largest image that the fuzzers decode, in bytes of its pixels. A dataset states the size of its images, so an
/// image of another size is refused before it is decoded.
const MAX_PIXELS: usize = 4 << 20;

/// Decodes an encoded image of any format and checks that other sizes are refused.
pub fn decode_image(bytes: &[u8]) {
    let Ok((height, width)) = swm_image::image_size(bytes) else { return };
    let Some(length) = height.checked_mul(width).and_then(|n| n.checked_mul(3)).filter(|&n| n <= MAX_PIXELS) else {
        return;
    };
    let mut out = vec![0; length];
    // The result may be an error; the decoder must only return.
    let _ = swm_image::decode(bytes, height, width, &mut out);
    // A size that the header does not state is refused.
    assert!(swm_image::decode(bytes, height + 1, width, &mut out).is_err());
}

/// Returns a folder in memory, which belongs to this process.
pub fn scratch() -> PathBuf {
    let root = if Path::new("/dev/shm").is_dir() { PathBuf::from("/dev/shm") } else { std::env::temp_dir() };
    let path = root.join(format!("swm-fuzz-{}", std::process::id()));
    std::fs::create_dir_all(&path).expect("a folder in memory");
    path
}

/// Writes `bytes` to the file `name` of [`scratch`].
pub fn file(name: &str, bytes: &[u8]) -> PathBuf {
    let path = scratch().join(name);
    std::fs::write(&path, bytes).expect("a file in memory");
    path
}

/// Writes a seed to the folder of the corpus, which is the first folder among the arguments of the fuzzer.
pub fn seed(name: &str, bytes: &[u8]) {
    let corpus = std::env::args_os().skip(1).map(PathBuf::from).find(|argument| argument.is_dir());
    if let Some(corpus) = corpus {
        std::fs::write(corpus.join(format!("seed-{name}")), bytes).expect("a seed");
    }
}

/// Makes a seed of every file below a folder of the repository whose name ends in `suffix`.
pub fn seed_files(folder: &str, suffix: &str) {
    for path in files(&repository(folder)) {
        let name = path.to_string_lossy().replace(['/', '\\'], "-");
        if name.ends_with(suffix) {
            seed(&name, &std::fs::read(&path).expect("a file of the repository"));
        }
    }
}

fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// The files below a folder, or the file itself, sorted.
fn files(path: &Path) -> Vec<PathBuf> {
    if path.is_file() {
        return vec![path.to_owned()];
    }
    let entries = std::fs::read_dir(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let mut found: Vec<PathBuf> = entries.flat_map(|entry| files(&entry.expect("an entry").path())).collect();
    found.sort();
    found
}

/// Returns an entry of a leaderboard with three episodes of the floor and of a policy.
pub fn entry() -> Entry {
    let mut entry = Entry::read(&repository("leaderboard/two-room-lewm.json")).expect("an entry");
    let results = &mut entry.results;
    results.manifest.config["episodes"] = 3.into();
    results.manifest.config["policies"].as_array_mut().expect("policies").truncate(2);
    results.runs.truncate(2);
    for run in &mut results.runs {
        let episodes = run.episodes[..3].to_vec();
        *run = Run::new(&run.condition, &run.policy, results.counting, episodes, run.timing.clone());
    }
    results.comparisons = Comparison::all(&results.runs, results.counting);
    entry.sealed().expect("an entry")
}

/// Copies of datasets or checkpoints in memory. The input replaces one file of one of them: its first byte is the index
/// of the file, the rest is the content.
#[derive(Default)]
pub struct Originals {
    /// Each file, and the folder or file that is opened.
    files: Vec<(PathBuf, PathBuf)>,
}

impl Originals {
    /// Copies fixtures of the repository and makes a seed of every file.
    pub fn of(fixtures: &[&str]) -> Self {
        let mut originals = Self::default();
        for fixture in fixtures {
            let from = repository(fixture);
            let to = scratch().join(from.file_name().expect("a name"));
            for file in files(&from) {
                let inner = file.strip_prefix(&from).expect("a file of the fixture");
                let target = if inner.as_os_str().is_empty() { to.clone() } else { to.join(inner) };
                std::fs::create_dir_all(target.parent().expect("a folder")).expect("a folder in memory");
                std::fs::copy(&file, &target).expect("a copy of the fixture");
            }
            originals.add(&to);
        }
        originals
    }

    /// Adds a dataset or a checkpoint that is in memory, and makes a seed of each of its files.
    pub fn add(&mut self, path: &Path) {
        for file in files(path) {
            let index = u8::try_from(self.files.len()).expect("at most 256 files");
            let content = std::fs::read(&file).expect("a file in memory");
            seed(&format!("{index:03}"), &[&[index][..], &content].concat());
            self.files.push((file, path.to_owned()));
        }
    }

    /// Calls `read` on the copy whose file the input replaces.
    pub fn with(&self, input: &[u8], read: impl FnOnce(&Path)) {
        let Some((&index, bytes)) = input.split_first() else { return };
        let Some((file, path)) = self.files.get(usize::from(index)) else { return };
        let intact = std::fs::read(file).expect("a file in memory");
        std::fs::write(file, bytes).expect("a file in memory");
        read(path);
        std::fs::write(file, intact).expect("a file in memory");
    }
}

/// The text of the last panic.
static LAST: Mutex<String> = Mutex::new(String::new());

/// Lets the program catch panics of libraries, as it does for HDF5 and Parquet: by default, a fuzzer aborts at every
/// panic. A panic that escapes from `read` in [`contained`] still aborts.
pub fn catch_library_panics() {
    std::panic::set_hook(Box::new(|panic| {
        *LAST.lock().unwrap_or_else(PoisonError::into_inner) = panic.to_string();
    }));
}

/// Calls `read` and aborts if a panic escapes from it.
#[allow(clippy::print_stderr, reason = "the log of the fuzzer")]
pub fn contained(read: impl FnOnce()) {
    if catch_unwind(AssertUnwindSafe(read)).is_err() {
        eprintln!("{}", LAST.lock().unwrap_or_else(PoisonError::into_inner));
        std::process::abort();
    }
}

/// Returns a value as JSON.
pub fn json(value: &impl serde::Serialize) -> Vec<u8> {
    serde_json::to_vec(value).expect("JSON")
}

/// Opens a dataset and reads everything in it.
pub fn read_dataset(path: &Path) {
    let _ = try_read(path);
}

fn try_read(path: &Path) -> swm_core::Result<()> {
    use swm_data::StepRange;
    /// Rows of a dataset that the fuzzers read.
    const ROWS: usize = 4096;
    let reader = swm_data::open(path)?;
    let columns: Vec<&str> = reader.schema().columns().iter().map(|column| column.name.as_str()).collect();
    let row: usize = reader.schema().columns().iter().map(|column| column.row_bytes()).sum();
    let mut left = ROWS.min((64 << 20) / row.max(1));
    for (at, episode) in reader.episodes().iter().enumerate() {
        if episode.length > left {
            break;
        }
        left -= episode.length;
        reader.read(&columns, &[StepRange::new(at, 0, episode.length)])?;
        reader.constants(at)?;
    }
    reader.irregularities()?;
    reader.footprint()?;
    reader.content_hash()?;
    Ok(())
}
