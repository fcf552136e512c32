//! The format `lerobot`: reads datasets that LeRobot's own package wrote (`tests/interop/lerobot_export.py`), and lets
//! LeRobot read datasets written here. Run the long tests with:
//!
//! ```text
//! cargo test --release --workspace --test it -- --ignored lerobot::
//! ```

use crate::hostile::copied;
use crate::video::{THIRD_PARTY_LENGTHS, check_frames, interop};
use crate::{format_suite, fuzz, sample};
use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float64Type, Int64Type};
use arrow_array::{ArrowPrimitiveType, PrimitiveArray, RecordBatch};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;
use swm_core::{ColumnSpec, DType};
use swm_data::{CommitPolicy, Constants, ImageCodec, StepRange, WriteMode, WriteOptions, create, open};

#[test]
fn passes_the_format_suite() {
    format_suite::all("d.lerobot");
}

#[test]
fn killed_writer_keeps_committed_episodes() {
    format_suite::killed("d.lerobot", 4);
}

#[test]
#[ignore = "takes a minute"]
fn writer_killed_50_times_keeps_committed_episodes() {
    format_suite::killed("d.lerobot", 50);
}

#[test]
fn reads_datasets_of_lerobot() {
    for name in ["lerobot-v30-h264", "lerobot-v30-av1", "lerobot-v21"] {
        let reader = open(interop().join(name)).expect("opening the dataset");
        assert_eq!(reader.episodes().iter().map(|e| e.length).collect::<Vec<_>>(), THIRD_PARTY_LENGTHS, "{name}");
        check_frames(&*reader, "pixels", &format!("{name}-top.png"), 0);
        check_frames(&*reader, "observation.images.wrist", &format!("{name}-wrist.png"), 0);
        let schema = reader.schema();
        assert_eq!(schema.column("pixels").expect("a camera"), &ColumnSpec::image("pixels", 48, 64));
        assert_eq!(schema.column("proprio").expect("the state"), &ColumnSpec::new("proprio", DType::Float32, [3]));
        assert_eq!(
            schema.column("next.done").expect("finding the column"),
            &ColumnSpec::new("next.done", DType::Bool, [])
        );
        let tasks = ["push the block", "open the drawer", "push the block"];
        for (e, &length) in THIRD_PARTY_LENGTHS.iter().enumerate() {
            let names = ["observation.state", "action", "next.reward", "next.done", "task_index", "frame_index"];
            let read = reader.read(&names, &[StepRange::new(e, 0, length)]).expect("reading rows");
            for t in 0..length {
                let (row, time) = (read.row(t), t as f32);
                assert_eq!(row.get::<f32>("observation.state").expect("reading the values"), [e as f32, time, -0.5]);
                assert_eq!(row.get::<f32>("action").expect("reading the values"), [e as f32 + time / 4.0, -time]);
                assert_eq!(row.get::<f32>("next.reward").expect("reading the value"), [time / 2.0]);
                assert_eq!(row.get::<u8>("next.done").expect("reading the flag"), [u8::from(t + 1 == length)]);
                assert_eq!(row.get::<i64>("task_index").expect("reading the value"), [(e % 2) as i64]);
                assert_eq!(row.get::<i32>("frame_index").expect("reading the value"), [t as i32]);
            }
            let task = Constants::from([("task".to_owned(), tasks[e].as_bytes().to_vec())]);
            assert_eq!(reader.constants(e).expect("reading constants"), task);
        }
        let hash = reader.content_hash().expect("hashing the content");
        assert_eq!(
            hash,
            open(interop().join(name)).expect("opening the dataset").content_hash().expect("hashing the content")
        );
        let mut writer = create(
            interop().join(name),
            &swm_core::Schema::new(schema.columns()[2..].to_vec()).expect("creating the schema"),
            WriteOptions { mode: WriteMode::Append, ..WriteOptions::default() },
        );
        assert!(
            writer
                .as_mut()
                .err()
                .expect("appending to a third-party dataset must be an error")
                .to_string()
                .contains("convert it"),
            "{name}"
        );
    }
}

#[test]
fn reads_images_that_are_stored_in_tables() {
    let reader = open(interop().join("lerobot-v30-h264")).expect("opening the dataset");
    let name = "observation.images.still";
    let ranges = [StepRange::new(2, 3, 2), StepRange::new(0, 10, 1), StepRange::new(2, 3, 1)];
    let read = reader.read(&[name], &ranges).expect("reading rows");
    for (row, (e, t)) in [(2, 3), (2, 4), (0, 10), (2, 3)].into_iter().enumerate() {
        let frame = read.row(row).get::<u8>(name).expect("reading the image").to_vec();
        for y in 0..24 {
            for x in 0..32 {
                let block = (4 + t..12 + t).contains(&y) && (8 + 2 * t..20 + 2 * t).contains(&x);
                let expected = if block { [250, 220 - 50 * e, 20] } else { [3 * y + 40 * e, 3 * x, 60 + 10 * t] };
                let found = &frame[(y * 32 + x) * 3..][..3];
                assert_eq!(found, expected.map(|v| v.min(255) as u8), "({x}, {y}) of row {row}");
            }
        }
    }
}

/// The data file of all episodes of a small dataset of LeRobot 3.0.
pub const DATA: &str = "data/chunk-000/file-000.parquet";
/// The list of episodes of such a dataset.
pub const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";

/// Writes a Parquet file again, with other rows.
pub fn rewrite(path: &Path, change: impl FnOnce(RecordBatch) -> RecordBatch) {
    let file = File::open(path).expect("opening the file");
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("a Parquet file").build().expect("a reader");
    let mut batches: Vec<RecordBatch> = reader.collect::<Result<_, _>>().expect("reading the rows");
    assert_eq!(batches.len(), 1, "the file has so few rows that they are one batch");
    let batch = change(batches.remove(0));
    let file = File::create(path).expect("creating the file");
    let mut writer = ArrowWriter::try_new(file, batch.schema(), None).expect("a writer");
    writer.write(&batch).expect("writing the rows");
    writer.close().expect("closing the file");
}

/// Changes the values of a column of a Parquet file, one value or null per row.
pub fn change_values<T: ArrowPrimitiveType>(path: &Path, column: &str, change: impl FnOnce(&mut [Option<T::Native>])) {
    rewrite(path, |batch| {
        let at = batch.schema().index_of(column).expect("the column");
        let mut columns = batch.columns().to_vec();
        let mut values: Vec<Option<T::Native>> = columns[at].as_primitive::<T>().iter().collect();
        change(&mut values);
        columns[at] = Arc::new(values.into_iter().collect::<PrimitiveArray<T>>());
        RecordBatch::try_new(batch.schema(), columns).expect("the changed rows")
    });
}

#[test]
fn images_in_tables_are_refused_if_the_rows_are_not_those_of_the_episodes() {
    let read = |change: &dyn Fn(&Path)| {
        let (_folder, path) = copied("lerobot-v30-h264");
        change(&path.join(DATA));
        // The image of the first row, which no change moves.
        let reader = open(&path).expect("opening the dataset");
        reader.read(&["observation.images.still"], &[StepRange::new(0, 0, 1)]).map(|read| read.bytes(0).to_vec())
    };
    let original = read(&|_| {}).expect("the original");
    assert_eq!(read(&|file| rewrite(file, |rows| rows)).expect("the same rows in another file"), original);
    let refused = |what: &str, change: &dyn Fn(&Path)| {
        let error = read(change).map(|image| image.len()).expect_err(what).to_string();
        assert!(error.contains("its rows do not belong to the episodes that it should contain"), "{what}: {error}");
    };
    let last = THIRD_PARTY_LENGTHS.iter().sum::<usize>() - 1;
    let end = THIRD_PARTY_LENGTHS[0];
    let change = |file: &Path, change: &dyn Fn(&mut [Option<i64>])| {
        change_values::<Int64Type>(file, "episode_index", change);
    };
    refused("rows of two episodes in another order", &|file| change(file, &|indices| indices.swap(end - 1, end)));
    refused("a last row of an unknown episode", &|file| change(file, &|indices| indices[last] = Some(7)));
    refused("an episode with one row more", &|file| change(file, &|indices| indices[end] = Some(0)));
    refused("a file without its last row", &|file| rewrite(file, |rows| rows.slice(0, last)));
}

#[test]
fn start_times_that_are_null_or_not_finite_are_refused() {
    let (_folder, path) = copied("lerobot-v30-h264");
    let list = path.join(EPISODES);
    for key in ["observation.images.top", "observation.images.wrist"] {
        let column = format!("videos/{key}/from_timestamp");
        let change = |time| change_values::<Float64Type>(&list, &column, |times| times[1] = time);
        let mut start = None;
        change_values::<Float64Type>(&list, &column, |times| start = times[1]);
        for time in [None, Some(f64::NAN), Some(f64::INFINITY), Some(f64::NEG_INFINITY)] {
            change(time);
            let error = open(&path).map(|reader| reader.episodes().len()).expect_err("no start time").to_string();
            assert!(error.contains(&format!("it lacks start times of '{key}'")), "{time:?}: {error}");
        }
        change(start);
        let expected = fuzz::read_everything(&interop().join("lerobot-v30-h264")).expect("the original");
        assert_eq!(fuzz::read_everything(&path).expect("the start time of before"), expected);
    }
}

/// The error of reading the state of a dataset of LeRobot after changes of files of its metadata.
fn error_of_state(name: &str, changes: [(&str, &str, &str); 2]) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lerobot");
    fuzz::copy_all(&interop().join(name), &path);
    for (file, from, to) in changes {
        let file = path.join("meta").join(file);
        let text = std::fs::read_to_string(&file).expect("the file");
        assert!(text.contains(from), "{from}");
        std::fs::write(&file, text.replacen(from, to, 1)).expect("writing the file");
    }
    let reader = open(&path).expect("opening the dataset");
    reader.read(&["proprio"], &[StepRange::new(0, 0, 1)]).expect_err("another size").to_string()
}

#[test]
fn values_beyond_the_memory_or_the_declared_shape_are_not_decoded() {
    let rows = [
        ("info.json", "\"total_frames\": 34", "\"total_frames\": 1000000000025"),
        ("episodes.jsonl", "\"length\": 9", "\"length\": 1000000000000"),
    ];
    let error = error_of_state("lerobot-v21", rows);
    assert!(error.contains("1000000000025 rows of 12 bytes, more than half of the free memory"), "{error}");
    let shape = [
        ("info.json", "\"dtype\": \"float32\"", "\"dtype\": \"bool\""),
        ("info.json", "[\n                3\n", "[\n                1\n"),
    ];
    let error = error_of_state("lerobot-v30-h264", shape);
    assert!(error.contains("more values than the dataset declares"), "{error}");
}

#[test]
fn features_that_contradict_the_recorded_columns_are_refused() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("d.lerobot");
    sample::write(&path, WriteMode::Create, 2, 0..3);
    let info = path.join("meta/info.json");
    let own: serde_json::Value =
        serde_json::from_str(&std::fs::read_to_string(&info).expect("the file")).expect("JSON");
    let error = |change: &dyn Fn(&mut serde_json::Map<String, serde_json::Value>)| {
        let mut json = own.clone();
        change(json["features"].as_object_mut().expect("features"));
        std::fs::write(&info, json.to_string()).expect("writing the file");
        open(&path).map(|reader| reader.schema().clone()).expect_err("a changed feature").to_string()
    };
    for name in ["action", "reward", "observation.images.pixels"] {
        let other = error(&|features| {
            let side = &mut features[name]["shape"][0];
            *side = (side.as_u64().expect("a side") + 1).into();
        });
        assert!(other.contains(&format!("the feature '{name}' is")), "{other}");
    }
    let integers = error(&|features| features["action"]["dtype"] = "int64".into());
    assert!(integers.contains("the feature 'action' is int64"), "{integers}");
    for dtype in ["string", "float32"] {
        let other = error(&|features| features["observation.images.pixels"]["dtype"] = dtype.into());
        assert!(other.contains("pixels"), "{dtype}: {other}");
    }
    let missing = error(&|features| drop(features.remove("reward")));
    assert!(missing.contains("the recorded column 'reward' has no feature"), "{missing}");
}

fn damaged(name: &str, cases: u64) {
    let report = fuzz::dataset(name, &interop().join(name), cases, fuzz::read_everything);
    assert!(report.refused > 0, "{report:?}");
}

#[test]
fn reads_or_rejects_damaged_datasets() {
    ["lerobot-v30-h264", "lerobot-v21"].iter().for_each(|name| damaged(name, 200));
}

#[test]
#[ignore = "takes minutes"]
fn reads_or_rejects_datasets_damaged_in_10000_ways() {
    ["lerobot-v30-h264", "lerobot-v30-av1", "lerobot-v21"].iter().for_each(|name| damaged(name, 4000));
}

#[test]
fn files_do_not_depend_on_the_time_of_commits() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let hash = |interval| {
        let path = folder.path().join(format!("{interval:?}.lerobot"));
        let commit = CommitPolicy { interval, ..CommitPolicy::default() };
        let options = WriteOptions { commit, ..WriteOptions::default() };
        let mut writer = create(&path, &sample::schema(), options).expect("creating the dataset");
        (0..6).for_each(|e| writer.write_episode(&sample::episode(e)).expect("writing an episode"));
        writer.finish().expect("finishing the dataset");
        open(&path).expect("opening the dataset").content_hash().expect("hashing the content")
    };
    assert_eq!(hash(Duration::ZERO), hash(Duration::MAX));
}

#[test]
fn lerobot_reads_datasets_written_here() {
    let Some(python) = std::env::var_os("SWM_LEROBOT_PYTHON") else {
        println!("SKIPPED: set SWM_LEROBOT_PYTHON to a Python with lerobot 0.4");
        return;
    };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    for (name, codec, tolerance) in
        [("lossless.lerobot", ImageCodec::Png, 0.51), ("lossy.lerobot", ImageCodec::Jpeg { quality: 95 }, 5.0)]
    {
        let path = folder.path().join(name);
        for (mode, episodes) in [(WriteMode::Create, 0..3), (WriteMode::Append, 3..5)] {
            let commit = CommitPolicy { episodes: 2, ..CommitPolicy::default() };
            let options = WriteOptions { mode, codec, commit, ..WriteOptions::default() };
            let mut writer = create(&path, &sample::schema(), options).expect("creating the dataset");
            for e in episodes {
                let task = Constants::from([("task".to_owned(), format!("task {}", e % 2).into_bytes())]);
                writer.write_episode_with(&sample::episode(e), &task).expect("writing an episode");
            }
            writer.finish().expect("finishing the dataset");
        }
        let mut command = Command::new(&python);
        let output =
            command.arg("-B").arg(interop().join("lerobot_check.py")).arg(&path).output().expect("running Python");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let seen: serde_json::Value = serde_json::from_slice(&output.stdout).expect("parsing the JSON");
        assert_eq!(seen["episodes"], 5);
        let rows = seen["rows"].as_array().expect("the rows are an array");
        let mut next = 0;
        for e in 0..5 {
            let episode = sample::episode(e);
            for t in 0..episode.rows() {
                let row = &rows[next];
                assert_eq!(row["state"], serde_json::json!([e as f64, t as f64, -0.5]));
                let action_row = t.min(episode.rows() - 2);
                assert_eq!(row["action"], serde_json::json!([e as f64, action_row as f64 / 4.0]));
                assert_eq!(row["task"], format!("task {}", e % 2));
                assert_eq!((&row["episode_index"], &row["frame_index"]), (&e.into(), &t.into()));
                for column in ["pixels", "goal"] {
                    let ours = episode.row(t).get::<u8>(column).expect("reading the images").to_vec();
                    let theirs = row[column].as_array().expect("bytes");
                    assert_eq!(theirs.len(), ours.len());
                    let off: f64 = theirs
                        .iter()
                        .zip(&ours)
                        .map(|(a, &b)| (a.as_f64().expect("a byte") - f64::from(b)).abs())
                        .sum();
                    assert!(off / ours.len() as f64 <= tolerance, "{name}, {column} of {e}, {t}: {off}");
                }
                next += 1;
            }
        }
        assert_eq!(rows.len(), next);
    }
}
