//! Sample episodes in which every value depends on the episode and the row.

use std::path::Path;
use swm_core::{Batch, ColumnSpec, DType, Manifest, Schema};
use swm_data::{CommitPolicy, ImageCodec, Reader, StepRange, WriteMode, WriteOptions, create};

pub const COLUMNS: [&str; 8] =
    ["pixels", "action", "state", "reward", "success", "step_idx", "variation.agent.color", "goal"];

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
    .expect("creating the schema")
}

/// Number of rows of episode `e`.
pub fn rows(e: usize) -> usize {
    5 + e % 7
}

/// Episode `e`: a smooth moving image, a constant goal, and values computed from `e` and the row.
pub fn episode(e: usize) -> Batch {
    let rows = rows(e);
    let mut batch = Batch::zeros(&schema(), rows);
    batch.par_rows_mut(|t, mut row| {
        for (i, value) in row.at::<u8>(0).iter_mut().enumerate() {
            *value = ((i / 9 + 3 * t + 20 * e) % 256) as u8;
        }
        let action = if t + 1 == rows { [f32::NAN; 2] } else { [e as f32, t as f32 / 4.0] };
        row.set(1, &action);
        row.set(2, &[e as f64, t as f64, -0.5]);
        row.set(3, &[t as f32]);
        row.set(4, &[u8::from(t % 3 == 0)]);
        row.set(5, &[t as i64]);
        row.set(6, &[e as i64, 255, 7]);
        row.at::<u8>(7).fill(100 + (e % 100) as u8);
    });
    batch
}

pub fn manifest(seed: u64) -> Manifest {
    Manifest::new("collect", seed, serde_json::json!({"env": "test"}))
}

pub fn options(mode: WriteMode) -> WriteOptions {
    let codec = ImageCodec::Jpeg { quality: 95 };
    WriteOptions { mode, codec, manifest: Some(manifest(3)), ..WriteOptions::default() }
}

/// Writes episodes, with a commit after every `group` episodes.
pub fn write(path: &Path, mode: WriteMode, group: usize, episodes: std::ops::Range<usize>) {
    let commit = CommitPolicy { episodes: group, ..CommitPolicy::default() };
    let mut writer = create(path, &schema(), WriteOptions { commit, ..options(mode) }).expect("creating the dataset");
    for e in episodes {
        writer.write_episode(&episode(e)).expect("writing an episode");
    }
    writer.finish().expect("finishing the dataset");
}

/// Checks that position `p` holds episode `first + p`, for all positions.
pub fn check(reader: &dyn Reader, first: usize) {
    let all: Vec<StepRange> =
        reader.episodes().iter().enumerate().map(|(p, episode)| StepRange::new(p, 0, episode.length)).collect();
    let read = reader.read(&COLUMNS, &all).expect("reading rows");
    let mut at = 0;
    for (p, stored) in reader.episodes().iter().enumerate() {
        let expected = episode(first + p);
        assert_eq!(stored.length, expected.rows(), "length of episode {p}");
        for (i, column) in schema().columns().iter().enumerate() {
            let n = column.row_bytes();
            let found = &read.bytes(i)[at * n..(at + stored.length) * n];
            if column.is_image() {
                let off: f64 = found.iter().zip(expected.bytes(i)).map(|(&a, &b)| f64::from(a.abs_diff(b))).sum();
                assert!(
                    off / (found.len() as f64) < 6.0,
                    "{} of episode {p}: {}",
                    column.name,
                    off / found.len() as f64
                );
            } else {
                assert_eq!(found, expected.bytes(i), "{} of episode {p}", column.name);
            }
        }
        at += stored.length;
    }
}
