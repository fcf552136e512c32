//! Comparison of a converted dataset with its source: differences per column, and hashes of decoded content.

use crate::dataset::episodes::describe_columns;
use rayon::prelude::*;
use serde::Serialize;
use swm_core::columns::{EPISODE_IDX, STEP_IDX};
use swm_core::{Batch, ColumnSpec, DType, Schema};

/// The columns of a schema except index columns, with their indices.
pub(super) fn data_columns(schema: &Schema) -> impl Iterator<Item = (usize, &ColumnSpec)> {
    schema.columns().iter().enumerate().filter(|(_, column)| column.name != EPISODE_IDX && column.name != STEP_IDX)
}

/// Comparison of a column of the target with the source.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ColumnComparison {
    /// Name of the column.
    pub column: String,
    /// Whether all bytes are equal.
    pub exact: bool,
    /// The largest absolute difference between a value of the source and the value of the target.
    pub max_error: f64,
    /// Peak signal-to-noise ratio of images in decibels, if the images differ.
    pub psnr: Option<f64>,
    /// Sum of squared differences.
    #[serde(skip)]
    squares: f64,
    /// Number of compared values.
    #[serde(skip)]
    pub(super) values: u64,
}

impl ColumnComparison {
    pub(super) fn new(spec: &ColumnSpec) -> Self {
        Self { column: spec.name.clone(), exact: true, max_error: 0.0, psnr: None, squares: 0.0, values: 0 }
    }

    /// Adds the values of an episode. Fails with `(given, expected)` if a numeric value differs by more than rounding
    /// to single precision.
    pub(super) fn add(&mut self, spec: &ColumnSpec, source: &[u8], target: &[u8]) -> Result<(), (String, String)> {
        self.values += (source.len() / spec.dtype.size()) as u64;
        if source == target {
            return Ok(());
        }
        if spec.is_image() {
            let (sum, most) = source
                .par_chunks(1 << 16)
                .zip(target.par_chunks(1 << 16))
                .map(|(a, b)| {
                    let differences = a.iter().zip(b).map(|(&a, &b)| u64::from(a.abs_diff(b)));
                    (differences.clone().map(|d| d * d).sum::<u64>(), differences.max().unwrap_or(0))
                })
                .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1.max(b.1)));
            self.exact = false;
            self.squares += sum as f64;
            self.max_error = self.max_error.max(most as f64);
            self.psnr = Some(10.0 * (255.0_f64.powi(2) * self.values as f64 / self.squares).log10());
            return Ok(());
        }
        let size = spec.dtype.size();
        for (a, b) in source.chunks_exact(size).zip(target.chunks_exact(size)).filter(|(a, b)| a != b) {
            let (a, b) = (scalar(spec.dtype, a), scalar(spec.dtype, b));
            // Formats that store only single precision round doubles.
            let rounded = spec.dtype == DType::Float64 && f64::from(a as f32) == b;
            if !(a.is_nan() && b.is_nan()) {
                if !rounded {
                    return Err((b.to_string(), a.to_string()));
                }
                self.exact = false;
                self.max_error = self.max_error.max((a - b).abs());
            }
        }
        Ok(())
    }
}

/// Converts the bytes of a value to `f64`.
fn scalar(dtype: DType, bytes: &[u8]) -> f64 {
    match dtype {
        DType::Bool | DType::U8 => f64::from(bytes[0]),
        DType::Int32 => f64::from(bytemuck::pod_read_unaligned::<i32>(bytes)),
        DType::Int64 => bytemuck::pod_read_unaligned::<i64>(bytes) as f64,
        DType::Float32 => f64::from(bytemuck::pod_read_unaligned::<f32>(bytes)),
        DType::Float64 => bytemuck::pod_read_unaligned(bytes),
    }
}

/// The hash of an episode, combined from hashes of groups of its rows, which are computed in parallel.
pub(super) fn episode_hash(rows: &Batch) -> [u8; 32] {
    /// Approximate size of a group of rows in bytes.
    const PIECE: usize = 128 << 10;
    let mut hasher = blake3::Hasher::new();
    for (i, column) in data_columns(rows.schema()) {
        let piece = (PIECE / column.row_bytes().max(1)).max(1) * column.row_bytes().max(1);
        let pieces: Vec<blake3::Hash> = rows.bytes(i).par_chunks(piece).map(blake3::hash).collect();
        pieces.iter().for_each(|piece| {
            hasher.update(piece.as_bytes());
        });
    }
    hasher.update(&(rows.rows() as u64).to_le_bytes());
    *hasher.finalize().as_bytes()
}

/// The hash of a dataset, combined from the hashes of its episodes.
pub(super) fn dataset_hash(schema: &Schema, hashes: &[[u8; 32]]) -> String {
    let mut hasher = blake3::Hasher::new();
    let columns: Vec<ColumnSpec> = data_columns(schema).map(|(_, column)| column.clone()).collect();
    hasher.update(describe_columns(&columns).as_bytes());
    hashes.iter().for_each(|hash| {
        hasher.update(hash);
    });
    hasher.finalize().to_hex().to_string()
}
