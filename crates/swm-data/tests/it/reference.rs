//! Interoperability with the published Python package `stable-worldmodel`. In `tests/interop`, the script `export.py`
//! wrote `reference.lance` with this package, and the script `check.py` reads datasets written here with it.

use crate::sample::{episode, options, rows, schema, write};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use swm_core::{Batch, ColumnSpec, DType, Schema};
use swm_data::lance::{Shard, commit_shards, create_shard};
use swm_data::{Constants, ImageCodec, Location, StepRange, WriteMode, WriteOptions, create, open};

fn interop() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/interop")
}

/// The columns that `export.py` writes.
fn reference_schema() -> Schema {
    Schema::new([
        ColumnSpec::image("pixels", 24, 32),
        ColumnSpec::new("action", DType::Float32, [2]),
        ColumnSpec::new("reward", DType::Float32, [1]),
        ColumnSpec::new("variation_agent_color", DType::Float32, [3]),
    ])
    .expect("creating the schema")
}

/// Episode `e` of `export.py`. The third episode ends with action 0.
fn reference_episode(e: usize) -> Batch {
    let rows = 6 + e;
    let mut batch = Batch::zeros(&reference_schema(), rows);
    batch.par_rows_mut(|t, mut row| {
        for (i, rgb) in row.at::<u8>(0).chunks_exact_mut(3).enumerate() {
            rgb.copy_from_slice(&[(4 * (i / 32) + 10 * e) as u8, (4 * (i % 32) + t) as u8, 90]);
        }
        let last = if e == 2 { 0.0 } else { f32::NAN };
        row.set(1, &if t + 1 == rows { [last; 2] } else { [e as f32, t as f32 / 4.0] });
        row.set(2, &[t as f32]);
        row.set(3, &[e as f32, 255.0, 7.0]);
    });
    batch
}

fn check_reference(path: &Path, episodes: usize) {
    let reader = open(path).expect("opening the dataset");
    assert_eq!(reader.schema().columns()[2..], *reference_schema().columns());
    assert_eq!(reader.episodes().len(), episodes);
    for e in 0..episodes {
        let expected = reference_episode(e);
        let read = reader
            .read(
                &["pixels", "action", "reward", "variation_agent_color"],
                &[StepRange::new(e, 0, reader.episodes()[e].length)],
            )
            .expect("reading rows");
        assert_eq!(read.rows(), expected.rows());
        for column in 1..4 {
            // Compares the values as text, so that NaN equals NaN.
            let text = |b: &Batch| format!("{:?}", floats(b.bytes(column)));
            assert_eq!(text(&read), text(&expected), "column {column} of episode {e}");
        }
        let off: f64 = read.bytes(0).iter().zip(expected.bytes(0)).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum();
        assert!(off / (expected.bytes(0).len() as f64) < 3.0, "{off}");
    }
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.chunks_exact(4).map(|b| f32::from_ne_bytes([b[0], b[1], b[2], b[3]])).collect()
}

#[test]
fn reads_a_dataset_of_the_reference() {
    check_reference(&interop().join("reference.lance"), 3);
    let text = open(interop().join("reference-text.lance")).expect("opening the dataset");
    let names: Vec<&str> = text.schema().columns().iter().map(|c| c.name.as_str()).collect();
    assert_eq!(names, ["episode_idx", "step_idx", "state"], "text columns are skipped");
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).expect("creating a folder");
    for entry in std::fs::read_dir(from).expect("listing a folder") {
        let entry = entry.expect("reading the folder entry");
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).expect("copying a file");
        }
    }
}

/// Appends two episodes to a copy of the reference's dataset.
fn append_to_reference(folder: &Path) -> PathBuf {
    let path = folder.join("continued.lance");
    copy(&interop().join("reference.lance"), &path);
    let mut writer = create(&path, &reference_schema(), options(WriteMode::Append)).expect("continuing the dataset");
    assert_eq!(writer.episodes(), 3);
    writer.write_episode(&reference_episode(3)).expect("writing an episode");
    writer.write_episode(&reference_episode(4)).expect("writing an episode");
    writer.finish().expect("finishing the dataset");
    path
}

#[test]
fn appends_to_a_dataset_of_the_reference() {
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    check_reference(&append_to_reference(folder.path()), 5);
}

#[test]
#[allow(clippy::too_many_lines, reason = "one dataset per codec and kind of writer, checked by one Python process")]
fn reference_reads_datasets_written_here() {
    let Some(python) = std::env::var_os("SWM_REFERENCE_PYTHON") else {
        println!("SKIPPED: set SWM_REFERENCE_PYTHON to a Python with stable-worldmodel and pylance");
        return;
    };
    let folder = tempfile::tempdir().expect("creating a temporary folder");
    let ours = folder.path().join("ours.lance");
    write(&ours, WriteMode::Create, 2, 0..5);
    write(&ours, WriteMode::Append, 100, 5..8);
    let appended = append_to_reference(folder.path());
    let lossless = [("png", ImageCodec::Png), ("qoi", ImageCodec::Qoi)].map(|(name, codec)| {
        let path = folder.path().join(name).with_extension("lance");
        let mut writer = create(&path, &schema(), WriteOptions { codec, ..options(WriteMode::Create) })
            .expect("creating the dataset");
        let constants = Constants::from([("scene.xml".to_owned(), b"<mujoco/>".to_vec())]);
        writer.write_episode_with(&episode(0), &constants).expect("writing an episode");
        writer.finish().expect("finishing the dataset");
        path
    });
    // Two shards, committed together.
    let sharded = folder.path().join("parts.lance");
    for index in 0..2 {
        let shard = Shard { index, count: 2 };
        let location = Location::from(&sharded);
        let mut writer =
            create_shard(&location, &schema(), options(WriteMode::Create), shard).expect("creating the shard");
        for e in 4 * index..4 * (index + 1) {
            writer.write_episode(&episode(e)).expect("writing an episode");
        }
        writer.finish().expect("finishing the dataset");
    }
    assert_eq!(commit_shards(&Location::from(&sharded)).expect("committing the shards"), 8);
    let mut command = Command::new(python);
    command.arg("-B").arg(interop().join("check.py")).args([&ours, &appended, &lossless[0], &lossless[1], &sharded]);
    let output = command.output().expect("running Python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).expect("text");
    let seen: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).expect("parsing the JSON")).collect();

    let lengths = |value: &Value| -> Vec<u64> {
        value["lengths"].as_array().expect("a list").iter().map(|v| v.as_u64().expect("a number")).collect()
    };
    assert_eq!(lengths(&seen[0]), (0..8).map(|e| rows(e) as u64).collect::<Vec<_>>());
    assert_eq!(lengths(&seen[1]), [6, 7, 8, 9, 10]);
    let mut expected = vec![];
    let mut means = vec![];
    for e in 0..8 {
        let batch = episode(e);
        for t in 0..rows(e) {
            expected.push((e as i64, t as i64));
            let frame = batch.row(t).get::<u8>("pixels").expect("reading the images");
            means.push(frame.iter().map(|&v| f64::from(v)).sum::<f64>() / frame.len() as f64);
        }
    }
    let elements =
        |value: &Value| -> Vec<Option<f64>> { value.as_array().expect("a list").iter().map(Value::as_f64).collect() };
    let column = |name: &str| elements(&seen[0]["columns"][name]);
    for (i, &(e, t)) in expected.iter().enumerate() {
        assert_eq!(seen[0]["episode_idx"][i], e);
        assert_eq!(seen[0]["step_idx"][i], t);
        let last = t as usize + 1 == rows(e as usize);
        assert_eq!(column("action")[2 * i], (!last).then_some(e as f64));
        assert_eq!(column("state")[3 * i + 1], Some(t as f64));
        assert_eq!(column("variation_agent_color")[3 * i + 1], Some(255.0));
        assert_eq!(column("reward")[i], Some(t as f64));
        let mean = seen[0]["pixel_means"][i].as_f64().expect("a mean");
        assert!((mean - means[i]).abs() < 4.0, "{mean} {}", means[i]);
    }
    for seen in &seen[2..4] {
        for (i, mean) in elements(&seen["pixel_means"]).into_iter().enumerate() {
            assert!((mean.expect("a mean") - means[i]).abs() < 1e-9, "lossless images have the same mean");
        }
    }
    assert_eq!(seen[4], seen[0], "committed shards equal the dataset of one writer");
    // Both readers define the same clips: 2 steps with frameskip 2 take 4 rows.
    let clips: usize = (0..8).map(|e| rows(e) - 3).sum();
    assert_eq!(seen[0]["clips"], clips);
    assert_eq!(seen[0]["clip_action_shape"], serde_json::json!([2, 4]));
    assert_eq!(elements(&seen[0]["clip_action"])[1], Some(0.25));
    assert_eq!(seen[0]["clip_pixels_shape"], serde_json::json!([2, 3, 16, 24]));
}
