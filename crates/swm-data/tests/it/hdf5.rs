//! The format `hdf5`. Run the long tests with:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored hdf5::
//! ```

use crate::{format_suite, fuzz};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::{CommitPolicy, Reader, StepRange, WriteMode, WriteOptions, create, open};

#[test]
fn passes_the_format_suite() {
    format_suite::all("d.h5");
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.h5", 4);
}

#[test]
#[ignore = "takes a minute"]
fn writer_killed_50_times_keeps_committed_episodes() {
    format_suite::killed("d.h5", 50);
}

fn damaged(cases: u64) {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.h5");
    format_suite::write(&path, WriteMode::Create, 0..3);
    let report = fuzz::dataset("hdf5", &path, cases, fuzz::read_everything);
    // Fletcher's checksum is modulo 65535, so it does not distinguish words 0xffff and 0x0000.
    let undetectable =
        |change: &&String| change.contains("[ff, ff] written") || change.contains("[ff, ff, ff, ff] written");
    let (undetected, changed): (Vec<&String>, Vec<&String>) = report.changed.iter().partition(undetectable);
    assert!(changed.is_empty() && undetected.len() as u64 <= 1 + cases / 2000, "{changed:#?} {undetected:#?}");
    assert!(report.refused as u64 > cases / 2, "{} refused, {} the same", report.refused, report.same);
}

#[test]
fn rejects_damaged_files() {
    damaged(400);
}

#[test]
#[ignore = "takes minutes"]
fn rejects_files_damaged_in_10000_ways() {
    damaged(10_000);
}

#[test]
fn datasets_with_b_trees_of_several_levels_round_trip() {
    // A leaf holds 64 chunks and a node of the second level 4096, so the tree has three levels. Each commit ends at
    // another position in the tree.
    let schema = Schema::new([ColumnSpec::new("large", DType::U8, [2048]), ColumnSpec::new("small", DType::Int64, [])]);
    let schema = schema.expect("creating the schema");
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("d.h5");
    let commit = CommitPolicy { episodes: 3, ..CommitPolicy::default() };
    let mut total = 0_usize;
    for part in 0..4 {
        let options = WriteOptions { mode: WriteMode::Append, commit, ..WriteOptions::default() };
        let mut writer = create(&path, &schema, options).expect("creating the dataset");
        for e in 0..60 {
            let rows = (e * 7 + part) % 40;
            let mut batch = Batch::zeros(&schema, rows + 1);
            for t in 0..=rows {
                batch.row_mut(t).at::<u8>(0).fill((total % 251) as u8);
                batch.row_mut(t).set(1, &[total as i64]);
                total += 1;
            }
            writer.write_episode(&batch).expect("writing an episode");
        }
        writer.finish().expect("finishing the dataset");
    }
    assert!(total > 4096 + 64);
    let reader = open(&path).expect("opening the dataset");
    let mut row = 0;
    for (position, episode) in reader.episodes().iter().enumerate() {
        let read =
            reader.read(&["large", "small"], &[StepRange::new(position, 0, episode.length)]).expect("reading rows");
        for t in 0..episode.length {
            assert_eq!(read.row(t).get::<i64>("small").expect("reading the value"), [row as i64]);
            assert!(
                read.row(t)
                    .get::<u8>("large")
                    .expect("reading the bytes")
                    .iter()
                    .all(|&byte| byte == (row % 251) as u8)
            );
            row += 1;
        }
    }
    assert_eq!(row, total);
}

fn interop(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop").join(name)
}

/// Lengths of the episodes in the files that `hdf5_export.py` writes.
const LENGTHS: [usize; 3] = [6, 7, 8];

/// The image in row `t` of the files that `hdf5_export.py` writes.
fn image(t: usize) -> Vec<u8> {
    let mut rgb = vec![];
    for y in 0..6 {
        for x in 0..8 {
            let blue = if (x + y) % 5 == 0 { 200 } else { 30 };
            rgb.extend([(10 * y + t) as u8, (4 * x + 7 * t) as u8, blue]);
        }
    }
    rgb
}

/// The numeric values in row `t` of the files that `hdf5_export.py` writes.
fn values(t: usize) -> [i64; 5] {
    std::array::from_fn(|k| (t * 100 + k * k) as i64)
}

/// Reads all rows of a column, and checks that reading single rows in reverse order gives the same values.
fn column(reader: &dyn Reader, name: &str) -> Batch {
    let all: Vec<StepRange> = LENGTHS.iter().enumerate().map(|(e, &length)| StepRange::new(e, 0, length)).collect();
    let all_rows = reader.read(&[name], &all).unwrap_or_else(|e| panic!("{name}: {e}"));
    let mut rows: Vec<StepRange> = (0..3).flat_map(|e| (0..LENGTHS[e]).map(move |t| StepRange::new(e, t, 1))).collect();
    rows.reverse();
    let single = reader.read(&[name], &rows).expect("reading rows");
    for t in 0..21 {
        let row =
            |batch: &Batch, t: usize| batch.bytes(0).chunks_exact(batch.bytes(0).len() / 21).nth(t).map(<[u8]>::to_vec);
        assert_eq!(row(&all_rows, t), row(&single, 20 - t), "{name}");
    }
    all_rows
}

fn has_images(reader: &dyn Reader, name: &str) {
    let read = column(reader, name);
    (0..21).for_each(|t| {
        assert_eq!(read.row(t).get::<u8>(name).expect("reading the images"), image(t), "{name}, row {t}")
    });
}

fn has_values(reader: &dyn Reader, name: &str) {
    let read = column(reader, name);
    for t in 0..21 {
        let expected = values(t).map(|value| value as f64);
        assert_eq!(read.row(t).to_f64(name).expect("reading the values"), expected, "{name}, row {t}");
    }
}

#[test]
fn reads_a_file_of_the_reference() {
    let reader = open(interop("hdf5-reference.h5")).expect("opening the dataset");
    assert_eq!(reader.episodes().iter().map(|episode| episode.length).collect::<Vec<_>>(), LENGTHS);
    has_images(&*reader, "pixels");
    let types =
        [("pixels", DType::U8), ("action", DType::Float32), ("reward", DType::Float64), ("step_idx", DType::Int64)];
    for (name, dtype) in types {
        assert_eq!(reader.schema().column(name).expect("finding the column").dtype, dtype);
    }
    let ends = [5, 12, 20];
    let (action, reward, step) = (column(&*reader, "action"), column(&*reader, "reward"), column(&*reader, "step_idx"));
    for t in 0..21 {
        let given = action.row(t).to_f64("action").expect("reading the values");
        if ends.contains(&t) {
            assert!(given.iter().all(|value| value.is_nan()));
        } else {
            assert_eq!(given, [values(t)[0] as f64, values(t)[1] as f64]);
        }
        assert_eq!(reward.row(t).to_f64("reward").expect("reading the value"), [values(t)[0] as f64]);
        let first = if t < 6 {
            0
        } else if t < 13 {
            6
        } else {
            13
        };
        assert_eq!(step.row(t).to_f64("step_idx").expect("reading the value"), [(t - first) as f64]);
    }
    for k in 0..5 {
        let name = format!("variation.{k}");
        let read = column(&*reader, &name);
        (0..21).for_each(|t| assert_eq!(read.row(t).get::<i64>(&name).expect("reading the value"), [values(t)[k]]));
    }
}

#[test]
fn decodes_every_filter_of_h5py_and_hdf5plugin() {
    let reader = open(interop("hdf5-filters.h5")).expect("opening the dataset");
    let names: Vec<String> = reader.schema().columns()[2..].iter().map(|column| column.name.clone()).collect();
    assert_eq!(names.len(), 2 * 26);
    for name in names {
        if name.starts_with("pictures") { has_images(&*reader, &name) } else { has_values(&*reader, &name) }
    }
}

#[test]
fn decodes_snappy_in_blosc() {
    let reader = open(interop("hdf5-snappy.h5")).expect("opening the dataset");
    for shuffle in 0..3 {
        has_values(&*reader, &format!("numbers {shuffle}"));
        has_images(&*reader, &format!("pictures {shuffle}"));
    }
}

#[test]
fn unsupported_filters_are_named() {
    let error = open(interop("hdf5-blosc2.h5")).err().expect("an error").to_string();
    assert!(error.contains("32026 (Blosc2)") && error.contains("h5repack -f GZIP=4"), "{error}");
}

#[test]
fn reads_every_hdf5_layout_and_element_type() {
    let reader = open(interop("hdf5-layouts.h5")).expect("opening the dataset");
    for name in ["contiguous", "one chunk", "fixed", "growing", "growing blocks"] {
        has_images(&*reader, name);
    }
    for dtype in ["u2", "i2", ">i4", "u4", "u8", ">f8"] {
        has_values(&*reader, &format!("numbers {dtype}"));
    }
    let read = column(&*reader, "numbers i1");
    (0..21).for_each(|t| {
        assert_eq!(read.row(t).get::<i32>("numbers i1").expect("reading the values")[3], values(t)[3] as i32 % 100)
    });
    let read = column(&*reader, "numbers f2");
    // Half precision represents integers up to 2048 exactly.
    (0..20).for_each(|t| {
        assert_eq!(read.row(t).get::<f32>("numbers f2").expect("reading the values")[0], (t * 100) as f32)
    });
    let read = column(&*reader, "truth");
    (0..21)
        .for_each(|t| assert_eq!(read.row(t).get::<u8>("truth").expect("reading the boolean"), [u8::from(t % 3 == 0)]));
    assert!(reader.schema().column("text").is_err(), "text columns are skipped");
    assert!(reader.unread().contains(&"text".to_owned()), "and named: {:?}", reader.unread());

    let reader = open(interop("hdf5-trees.h5")).expect("opening the dataset");
    has_images(&*reader, "growing");
    has_images(&*reader, "blocks");
    let read = column(&*reader, "partly written");
    for t in 0..21 {
        let expected = if t < 16 { values(t).map(|value| value as f64) } else { [0.0; 5] };
        assert_eq!(read.row(t).to_f64("partly written").expect("reading the values"), expected, "row {t}");
    }
}

#[test]
fn rejects_or_reads_damaged_third_party_files() {
    // These files have no checksums, so some changes are not detected; no change may cause a panic or a hang.
    for name in ["hdf5-reference.h5", "hdf5-filters.h5", "hdf5-layouts.h5", "hdf5-trees.h5"] {
        let report = fuzz::dataset(name, &interop(name), 150, fuzz::read_everything);
        assert!(report.refused > 20, "{name}: {report:?}");
    }
}

#[test]
#[ignore = "takes minutes"]
fn rejects_or_reads_third_party_files_damaged_in_10000_ways() {
    for name in ["hdf5-reference.h5", "hdf5-filters.h5", "hdf5-layouts.h5", "hdf5-trees.h5"] {
        let report = fuzz::dataset(name, &interop(name), 2500, fuzz::read_everything);
        println!("{name}: {} refused, {} same, {} changed", report.refused, report.same, report.changed.len());
        assert!(report.refused > 200, "{name}: {report:?}");
    }
}

/// The second episode of `hdf5-reference.h5`.
fn reference_episode() -> Batch {
    let reader = open(interop("hdf5-reference.h5")).expect("opening the dataset");
    let columns: Vec<ColumnSpec> = reader.schema().columns()[1..].to_vec();
    let names: Vec<&str> = columns.iter().map(|column| &*column.name).collect();
    reader.read(&names, &[StepRange::new(1, 0, LENGTHS[1])]).expect("reading rows")
}

#[test]
fn appends_to_a_file_of_the_reference() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("continued.h5");
    std::fs::copy(interop("hdf5-reference.h5"), &path).expect("copying a file");
    let episode = reference_episode();
    // A kill leaves a part of the copy that replaces the file.
    let left = folder.path().join(".continued.h5.copy.tmp");
    std::fs::write(&left, b"half a copy").expect("writing a file");
    for round in 1..3 {
        let options = WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() };
        let mut writer = create(&path, episode.schema(), options).expect("continuing the dataset");
        writer.write_episode(&episode).expect("writing an episode");
        writer.finish().expect("finishing the dataset");
        let reader = open(&path).expect("opening the dataset");
        assert_eq!(reader.episodes().len(), 3 + round);
        has_images(&*reader, "pixels");
        let names: Vec<&str> = episode.schema().columns().iter().map(|column| &*column.name).collect();
        let read = reader.read(&names, &[StepRange::new(2 + round, 0, LENGTHS[1])]).expect("reading rows");
        (0..names.len()).for_each(|at| assert!(read.bytes(at) == episode.bytes(at), "{}", names[at]));
    }
    assert!(!left.exists());
}

/// Runs `hdf5_check.py` if Python with h5py is available.
fn check(mode: &str, path: &Path) -> Option<Value> {
    let Some(python) = std::env::var_os("SWM_LANCE_PYTHON").or_else(|| std::env::var_os("SWM_REFERENCE_PYTHON")) else {
        println!("SKIPPED: set SWM_LANCE_PYTHON to a Python with numpy and h5py");
        return None;
    };
    let output = Command::new(python).arg("-B").arg(interop("hdf5_check.py")).arg(mode).arg(path).output();
    let output = output.expect("running Python");
    let errors = String::from_utf8_lossy(&output.stderr);
    if errors.contains("ModuleNotFoundError") {
        println!("SKIPPED: {}", errors.lines().last().unwrap_or_default());
        return None;
    }
    assert!(output.status.success(), "{errors}");
    Some(serde_json::from_slice(&output.stdout).expect("parsing the JSON"))
}

/// Compares the columns that h5py reads with the columns that this crate reads.
fn check_columns(path: &Path, seen: &Value) {
    let reader = open(path).expect("opening the dataset");
    let all: Vec<StepRange> =
        reader.episodes().iter().enumerate().map(|(at, episode)| StepRange::new(at, 0, episode.length)).collect();
    for column in &reader.schema().columns()[1..] {
        let read = reader.read(&[&column.name], &all).expect("reading rows");
        let seen = &seen["columns"][&column.name];
        let dtype = seen["dtype"].as_str().expect("a type");
        assert_eq!(dtype, column.dtype.name(), "{}", column.name);
        assert_eq!(seen["shape"][0], read.rows(), "{}", column.name);
        let (mut sum, mut weighted) = (0.0, 0.0);
        for t in 0..read.rows() {
            let row: f64 = read
                .row(t)
                .to_f64(&column.name)
                .expect("reading the values")
                .iter()
                .filter(|value| !value.is_nan())
                .sum();
            sum += row;
            weighted += row * (t % 1000 + 1) as f64;
        }
        for (ours, theirs) in [(sum, &seen["sum"]), (weighted, &seen["weighted"])] {
            let theirs = theirs.as_f64().expect("a number");
            assert!((ours - theirs).abs() <= 1e-9 * ours.abs(), "{}: {ours} {theirs}", column.name);
        }
    }
}

#[test]
fn files_round_trip_through_h5py() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let path = folder.path().join("ours.h5");
    format_suite::write(&path, WriteMode::Create, 0..40);
    format_suite::write(&path, WriteMode::Append, 40..77);
    let Some(seen) = check("read", &path) else { return };
    check_columns(&path, &seen);
    assert!(seen["record"].as_str().expect("text").contains("variation.agent.color"));
    let Some(seen) = check("append", &path) else { return };
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 78);
    check_columns(&path, &seen);
    // Appends an episode after the episode that h5py appended.
    let mut writer = format_suite::writer(&path, WriteMode::Append).expect("continuing the dataset");
    writer.write_episode(&crate::sample::episode(0)).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    let seen = check("read", &path).expect("running h5py");
    check_columns(&path, &seen);
    assert_eq!(open(&path).expect("opening the dataset").episodes().len(), 79);
}

#[test]
fn rows_that_were_never_written_have_the_value_that_the_file_says() {
    let reader = open(interop("hdf5-unwritten.h5")).expect("opening the dataset");
    let rows: Vec<StepRange> = (0..3).map(|episode| StepRange::new(episode, 0, 4)).collect();
    let read = |name: &str| reader.read(&[name], &rows).expect("reading rows").to_f32(name).expect("numbers");
    assert_eq!(read("absent"), [7.5; 24]);
    assert_eq!(read("half"), [-3.0, -3.0, -3.0, -3.0, 0.0, 1.0, 2.0, 3.0, -3.0, -3.0, -3.0, -3.0]);
    assert_eq!(read("halves"), [[0.5; 4], [3.0; 4], [3.0; 4]].concat());
    assert_eq!(read("true"), [[1.0; 4], [0.0; 4], [1.0; 4]].concat());
    assert_eq!(read("zero"), [[1.0; 4], [0.0; 4], [0.0; 4]].concat());
    // Only an enumeration of 0 and 1 is a boolean.
    assert_eq!(read("choice")[..4], [1.0, 2.0, 1.0, 2.0]);
    let dtype = |name: &str| reader.schema().column(name).expect("a column").dtype;
    assert_eq!((dtype("flag"), dtype("choice")), (DType::Bool, DType::Int32));
}

#[test]
fn values_in_other_files_are_refused() {
    let error = open(interop("hdf5-external.h5")).err().expect("an error").to_string();
    assert!(error.contains("reward") && error.contains("external"), "{error}");
}
