//! Damaged files: an error or other numbers, never a panic, never a hang.

use crate::sample::write;
use rand::Rng as _;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use swm_core::Key;
use swm_data::{StepRange, WriteMode, open};

/// All files below a folder, by name.
fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.push(path);
        }
    }
    found.sort();
    found
}

/// Opens and reads everything; whether that worked.
fn read_all(path: &Path) -> bool {
    let read = || -> swm_core::Result<()> {
        let reader = open(path)?;
        let all: Vec<StepRange> =
            reader.episodes().iter().enumerate().map(|(p, e)| StepRange::new(p, 0, e.length)).collect();
        let columns: Vec<&str> = reader.schema().columns().iter().map(|c| c.name.as_str()).collect();
        reader.read(&columns, &all)?;
        reader.content_hash()?;
        reader.footprint()?;
        Ok(())
    };
    match catch_unwind(AssertUnwindSafe(read)) {
        Ok(Ok(())) => true,
        Ok(Err(error)) => {
            assert!(error.to_string().len() > 30, "says little: {error}");
            false
        }
        Err(_) => panic!("a damaged file made the reader panic"),
    }
}

#[test]
fn damaged_files_are_errors() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lance");
    write(&path, WriteMode::Create, 2, 0..4);
    assert!(read_all(&path));
    let mut rng = Key::new(7).rng();
    let mut noticed = 0;
    for file in files(&path) {
        let sound = std::fs::read(&file).expect("reads");
        // What only older versions need may be damaged freely.
        let needed = file.components().any(|c| c.as_os_str() == "data");
        for case in 0..40 {
            let mut bytes = sound.clone();
            if case % 2 == 0 {
                bytes.truncate(rng.random_range(0..sound.len()));
            } else {
                for _ in 0..rng.random_range(1..4) {
                    let at = rng.random_range(0..bytes.len());
                    bytes[at] ^= 1 << rng.random_range(0..8);
                }
            }
            std::fs::write(&file, &bytes).expect("writes");
            let fine = read_all(&path);
            noticed += usize::from(!fine);
            assert!(!(fine && needed && case % 2 == 0), "{} cut to {} bytes", file.display(), bytes.len());
        }
        std::fs::write(&file, &sound).expect("writes");
    }
    assert!(noticed > 60, "{noticed}");
    assert!(read_all(&path));
    for file in files(&path.join("data")) {
        std::fs::remove_file(file).expect("removes");
    }
    let reader = open(&path);
    assert!(reader.is_err_and(|e| e.to_string().contains("damaged or missing")));
}
