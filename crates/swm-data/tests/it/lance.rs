//! The Lance format: what was written is what is read, whatever happens in between.

use std::path::Path;
use std::sync::Arc;
use swm_core::{Batch, ColumnSpec, DType, Manifest, Schema};
use swm_data::{CommitPolicy, Reader, StepRange, WriteMode, WriteOptions, Writer, create, open};

pub fn schema() -> Schema {
    Schema::new([
        ColumnSpec::image("pixels", 16, 24),
        ColumnSpec::new("action", DType::Float32, [2]),
        ColumnSpec::new("state", DType::Float64, [3]),
        ColumnSpec::new("reward", DType::Float32, []),
        ColumnSpec::new("success", DType::Bool, []),
        ColumnSpec::new("step_idx", DType::Int64, []),
        ColumnSpec::new("variation.agent.color", DType::Int64, [3]),
        ColumnSpec::image("goal", 16, 24),
    ])
    .expect("schema")
}

/// Episode `e`: a smooth moving picture, and numbers that say where they belong.
pub fn episode(e: usize, rows: usize) -> Batch {
    let mut batch = Batch::zeros(&schema(), rows);
    batch.par_rows_mut(|t, mut row| {
        for (i, value) in row.at::<u8>(0).iter_mut().enumerate() {
            *value = (i / 9 + 3 * t + 20 * e) as u8;
        }
        let action = if t + 1 == rows { [f32::NAN; 2] } else { [e as f32, t as f32 / 4.0] };
        row.set(1, &action);
        row.set(2, &[e as f64, t as f64, -0.5]);
        row.set(3, &[t as f32]);
        row.set(4, &[u8::from(t % 3 == 0)]);
        row.set(5, &[t as i64]);
        row.set(6, &[e as i64, 255, 7]);
        row.at::<u8>(7).fill(100 + e as u8);
    });
    batch
}

pub fn options(mode: WriteMode) -> WriteOptions {
    WriteOptions {
        mode,
        manifest: Some(Manifest::new("collect", 3, serde_json::json!({"env": "test"}))),
        ..Default::default()
    }
}

pub fn write(path: &Path, mode: WriteMode, episodes: std::ops::Range<usize>) {
    let mut writer = create(path, &schema(), options(mode)).expect("creates");
    for e in episodes {
        writer.write_episode(&episode(e, 5 + e)).expect("writes");
    }
    writer.finish().expect("finishes");
}

/// Checks that episode `e` is stored in position `position`.
pub fn check(reader: &dyn Reader, position: usize, e: usize) {
    let names: Vec<&str> = schema_names();
    let expected = episode(e, 5 + e);
    assert_eq!(reader.episodes()[position].length, expected.rows());
    let read = reader.read(&names, &[StepRange::new(position, 0, expected.rows())]).expect("reads");
    assert_eq!(read.schema(), expected.schema());
    for (i, column) in expected.schema().columns().iter().enumerate() {
        if column.is_image() {
            let off = read.bytes(i).iter().zip(expected.bytes(i)).map(|(&a, &b)| a.abs_diff(b)).max();
            assert!(off.expect("pixels") < 40, "{}: {off:?}", column.name);
        } else {
            assert_eq!(read.bytes(i), expected.bytes(i), "{}", column.name);
        }
    }
}

fn schema_names() -> Vec<&'static str> {
    vec!["pixels", "action", "state", "reward", "success", "step_idx", "variation.agent.color", "goal"]
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("with space ü.lance");
    write(&path, WriteMode::Create, 0..4);
    let reader = open(&path).expect("opens");
    assert_eq!(reader.episodes().len(), 4);
    for e in 0..4 {
        check(&*reader, e, e);
    }
    assert_eq!(reader.manifest().expect("a manifest").seed, 3);
    let index = reader.schema().find("variation.agent.color").expect("dots come back");
    assert_eq!(reader.schema().columns()[index].dtype, DType::Int64);
}
