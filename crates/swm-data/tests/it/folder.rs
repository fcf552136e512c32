//! The format `folder`. Run the long tests with:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored folder::
//! ```

use crate::{format_suite, fuzz, sample};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_core::{Batch, Schema};
use swm_data::{StepRange, WriteMode, WriteOptions, create, open};

#[test]
fn passes_the_format_suite() {
    format_suite::all("d.folder");
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.folder", 4);
}

#[test]
#[ignore = "takes a minute"]
fn writer_killed_50_times_keeps_committed_episodes() {
    format_suite::killed("d.folder", 50);
}

/// Writes a column file with an array of zeros.
fn write_zeros(path: &Path, descr: &str, shape: &str, bytes: usize) {
    let text = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
    let length = (text.len() as u16).to_le_bytes();
    let array = [b"\x93NUMPY\x01\x00", &length[..], text.as_bytes(), &vec![0; bytes]].concat();
    let mut file = zip::ZipWriter::new(std::fs::File::create(path).expect("creating the file"));
    file.start_file("arr_0.npy", zip::write::SimpleFileOptions::default()).expect("starting a member");
    std::io::Write::write_all(&mut file, &array).expect("writing a member");
    file.finish().expect("finishing the file");
}

#[test]
fn recorded_columns_without_numbers_are_refused() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for format in ["folder", "video"] {
        let path = folder.path().join(format!("d.{format}"));
        sample::write(&path, WriteMode::Create, 3, 0..6);
        let rows = (5..11).sum::<usize>();
        let column = path.join("state.npz");
        let given = [("'<c8'", format!("({rows}, 3)"), rows * 24), ("'<f4'", format!("({rows}, 0)"), 0)];
        for (descr, shape, bytes) in given {
            write_zeros(&column, descr, &shape, bytes);
            let error = open(&path).err().expect("a column that the dataset records").to_string();
            assert!(error.contains("state.npz") && error.contains("contradicts the recorded schema"), "{error}");
        }
        // A file that the dataset does not record is left out, and named.
        std::fs::rename(&column, path.join("other.npz")).expect("renaming a file");
        sample::write(&folder.path().join(format!("again.{format}")), WriteMode::Create, 3, 0..6);
        std::fs::copy(folder.path().join(format!("again.{format}/state.npz")), &column).expect("copying a file");
        sample::check(&*open(&path).expect("opening the dataset"), 0);
    }
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.folder");
    format_suite::write(&path, WriteMode::Create, 0..3);
    let report = fuzz::dataset("folder", &path, cases, fuzz::read_everything);
    // The format does not detect exchanged image files.
    let changed: Vec<&String> = report.changed.iter().filter(|change| !change.contains("replaced by")).collect();
    assert!(changed.is_empty(), "{changed:?}");
    assert!(report.refused as u64 > cases / 2, "{report:?}");
}

#[test]
fn rejects_damaged_folders() {
    damaged(400);
}

#[test]
#[ignore = "takes minutes"]
fn rejects_folders_damaged_in_10000_ways() {
    damaged(10_000);
}

#[test]
fn rejects_damaged_journals() {
    // The unfinished writer leaves a journal, and column files without rows.
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.folder");
    let mut writer = format_suite::writer(&path, WriteMode::Create).expect("creating the dataset");
    (0..4).for_each(|e| writer.write_episode(&sample::episode(e)).expect("writing an episode"));
    let journal = std::fs::read(path.join("ep_len.journal")).expect("reading the journal");
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 4);
    let copy = folder.path().join("copy.folder");
    fuzz::copy_all(&path, &copy);
    let read = |bytes: &[u8]| {
        std::fs::write(copy.join("ep_len.journal"), bytes).expect("writing a file");
        open(&copy)?;
        fuzz::read_everything(&copy)
    };
    let report = fuzz::bytes("journal", &journal, 300, read);
    assert!(report.refused > 30, "{report:?}");
    for length in (0..journal.len()).step_by(journal.len() / 40) {
        std::fs::write(copy.join("ep_len.journal"), &journal[..length]).expect("writing a file");
        let reader = open(&copy).expect("opening the dataset with its complete records");
        assert!(reader.episodes().len() < 4);
        format_suite::check(&*reader, 0);
    }
}

fn interop(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop").join(name)
}

#[test]
fn reads_but_does_not_append_to_a_folder_of_the_reference() {
    let path = interop("folder-reference");
    let reader = open(&path).expect("opening the dataset");
    let lengths: Vec<usize> = reader.episodes().iter().map(|episode| episode.length).collect();
    assert_eq!(lengths, [2, 3]);
    let names: Vec<&str> = reader.schema().columns()[2..].iter().map(|column| &*column.name).collect();
    assert_eq!(names, ["action", "pixels", "reward", "small", "variation.agent"], "text columns are skipped");
    let all = [StepRange::new(0, 0, 2), StepRange::new(1, 0, 3)];
    let read = reader.read(&names, &all).expect("reading rows");
    for t in 0..5 {
        let row = read.row(t);
        let values = |name: &str| row.to_f64(name).expect("reading the values");
        let last = t == 1 || t == 4;
        assert!(if last { values("action")[0].is_nan() } else { values("action") == [t as f64 / 4.0, -(t as f64)] });
        assert_eq!(values("reward"), [t as f64 * 0.5]);
        assert_eq!(values("small"), [t as f64 - 3.0]);
        assert_eq!(values("variation.agent"), [t as f64; 3]);
        let mut off = 0.0;
        for (i, rgb) in row.get::<u8>("pixels").expect("reading the images").chunks(3).enumerate() {
            let expected = [(8 * (i / 24) + t) as u8, (4 * (i % 24) + 7 * t) as u8, 90];
            off += rgb.iter().zip(expected).map(|(&a, b)| f64::from(a.abs_diff(b))).sum::<f64>();
        }
        // The first image is a PNG.
        assert!(if t == 0 { off == 0.0 } else { off / 1152.0 < 6.0 }, "row {t}: {off}");
    }
    assert!(reader.manifest().is_none() && reader.constants(1).expect("reading constants").is_empty());

    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let copy = folder.path().join("copy.folder");
    fuzz::copy_all(&path, &copy);
    let schema = Schema::new(reader.schema().columns()[2..].to_vec()).expect("creating the schema");
    let options = || WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() };
    let error = create(&copy, &schema, options()).err().expect("a text column must be an error").to_string();
    assert!(error.contains("'task'"), "{error}");
    std::fs::remove_file(copy.join("task.npz")).expect("removing a file");
    let mut writer = create(&copy, &schema, options()).expect("continuing the dataset");
    let mut episode = reader.read(&names, &[StepRange::new(1, 0, 3)]).expect("reading rows");
    episode = {
        let mut batch = Batch::zeros(&schema, 3);
        (0..names.len()).for_each(|at| batch.bytes_mut(at).copy_from_slice(episode.bytes(at)));
        batch
    };
    writer.write_episode(&episode).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let continued = open(&copy).expect("opening the dataset");
    assert_eq!(continued.episodes().len(), 3);
    let read = continued.read(&names, &[StepRange::new(2, 0, 3), StepRange::new(0, 0, 2)]).expect("reading rows");
    let before = reader.read(&names, &[StepRange::new(1, 0, 3), StepRange::new(0, 0, 2)]).expect("reading rows");
    (0..names.len()).for_each(|at| assert!(read.bytes(at) == before.bytes(at), "{}", names[at]));
}

#[test]
fn reference_reads_folders_written_here() {
    let Some(python) = std::env::var_os("SWM_REFERENCE_PYTHON") else {
        println!("SKIPPED: set SWM_REFERENCE_PYTHON to a Python with stable-worldmodel");
        return;
    };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("ours.folder");
    format_suite::write(&path, WriteMode::Create, 0..5);
    format_suite::write(&path, WriteMode::Append, 5..8);
    let output =
        Command::new(python).arg("-B").arg(interop("folder_check.py")).arg(&path).output().expect("running Python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let seen: Value = serde_json::from_slice(&output.stdout).expect("parsing the JSON");
    assert_eq!(seen["lengths"], serde_json::json!((0..8).map(sample::rows).collect::<Vec<_>>()));
    assert_eq!(seen["clips"], (0..8).map(|e| sample::rows(e) - 3).sum::<usize>());
    let mut names: Vec<String> = sample::schema().columns().iter().map(|column| column.name.clone()).collect();
    names.sort();
    assert_eq!(seen["columns"], serde_json::json!(names));
    // The last clip consists of rows of the last episode.
    let first = sample::rows(7) - 4;
    assert_eq!(seen["state"], serde_json::json!([[7.0, first as f64, -0.5], [7.0, first as f64 + 2.0, -0.5]]));
    let last = sample::episode(7);
    for step in 0..2 {
        let frame = last.row(first + 2 * step).get::<u8>("pixels").expect("reading the images");
        let mean = frame.iter().map(|&value| f64::from(value)).sum::<f64>() / frame.len() as f64;
        let reference_mean = seen["pixels"][step].as_f64().expect("a mean");
        assert!((mean - reference_mean).abs() < 1e-9, "lossless: {mean} {reference_mean}");
    }
}
