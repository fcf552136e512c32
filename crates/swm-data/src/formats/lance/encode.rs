//! Encodes episodes as the values of a data file.

use super::record::ContentHash;
use super::schema::{self, Kind, Precision, StoredColumn};
use crate::dataset::Constants;
use arrow_array::{Array as _, ArrayRef, BinaryArray, FixedSizeListArray, Float32Array, Float64Array, Int32Array};
use arrow_buffer::{Buffer, OffsetBuffer, ScalarBuffer};
use rayon::prelude::*;
use std::sync::Arc;
use swm_core::{Batch, DType, Error, Result};
use swm_image::ImageCodec;

/// An encoded episode. The commit assigns its `episode_idx`.
pub struct EncodedEpisode {
    /// Number of rows.
    pub rows: i32,
    /// `step_idx`, then the columns in the order of the table.
    pub values: Vec<ArrayRef>,
    /// Hash of the values and the constants; see [`ContentHash`].
    pub hash: String,
    /// The constants of the episode.
    pub constants: Constants,
}

impl EncodedEpisode {
    /// Encodes an episode, with all images in parallel.
    ///
    /// # Errors
    /// If the episode is too long, or a value does not fit its stored type.
    pub fn new(columns: &[StoredColumn], episode: &Batch, codec: ImageCodec, constants: &Constants) -> Result<Self> {
        let Ok(rows) = i32::try_from(episode.rows()) else {
            return Err(Error::mismatch("writing an episode", "2^31 or more rows", "fewer rows"));
        };
        let mut values: Vec<ArrayRef> = vec![Arc::new(Int32Array::from_iter_values(0..rows))];
        let mut hash = ContentHash::new();
        for column in columns {
            let index = episode.schema().index(&column.spec.name)?;
            let stored: ArrayRef = match column.kind {
                Kind::Image => Arc::new(encode_images(episode, index, codec)?),
                Kind::Values(precision) => Arc::new(encode_values(episode, index, precision)?),
            };
            hash.add(column, &stored).map_err(|problem| Error::external("writing an episode", problem))?;
            values.push(stored);
        }
        Ok(Self { rows, values, hash: hash.finish(constants), constants: constants.clone() })
    }

    /// Size in memory, in bytes.
    pub fn bytes(&self) -> usize {
        let constants: usize = self.constants.values().map(Vec::len).sum();
        constants + self.values.iter().map(|values| values.get_array_memory_size()).sum::<usize>()
    }
}

/// Encodes the images of a column in parallel. An image that equals the previous image, such as a goal image,
/// is not encoded again.
fn encode_images(episode: &Batch, index: usize, codec: ImageCodec) -> Result<BinaryArray> {
    let spec = &episode.schema().columns()[index];
    let (height, width) = (spec.shape[0], spec.shape[1]);
    let frames: Vec<&[u8]> = episode.bytes(index).chunks_exact(spec.row_bytes()).collect();
    let repeats: Vec<bool> = (0..frames.len()).into_par_iter().map(|i| i > 0 && frames[i] == frames[i - 1]).collect();
    let encoded: Result<Vec<Vec<u8>>> = (0..frames.len())
        .into_par_iter()
        .map(|i| {
            let mut bytes = vec![];
            if !repeats[i] {
                bytes.reserve(frames[i].len() / 8);
                codec.encode(frames[i], height, width, &mut bytes)?;
            }
            Ok(bytes)
        })
        .collect();
    let encoded = encoded?;
    // For every row, the index of the encoded image to store.
    let sources: Vec<usize> = repeats
        .iter()
        .enumerate()
        .scan(0, |source, (i, &repeat)| {
            *source = if repeat { *source } else { i };
            Some(*source)
        })
        .collect();
    let total: usize = sources.iter().map(|&i| encoded[i].len()).sum();
    if i32::try_from(total).is_err() {
        return Err(Error::mismatch(
            format!("writing column '{}'", spec.name),
            format!("{total} bytes in one episode"),
            "less than 2 GiB; write shorter episodes or smaller images",
        ));
    }
    let mut values = Vec::with_capacity(total);
    for &i in &sources {
        values.extend_from_slice(&encoded[i]);
    }
    let offsets = OffsetBuffer::from_lengths(sources.iter().map(|&i| encoded[i].len()));
    BinaryArray::try_new(offsets, Buffer::from_vec(values), None).map_err(|e| Error::external("storing images", e))
}

/// Converts a numeric column to fixed-size lists.
fn encode_values(episode: &Batch, index: usize, precision: Precision) -> Result<FixedSizeListArray> {
    let spec = &episode.schema().columns()[index];
    // `float32` represents integers exactly up to 2^24.
    let exact = |v: i64| v.unsigned_abs() <= 1 << 24;
    let bytes = episode.bytes(index);
    let lossy = match spec.dtype {
        DType::Int32 => values_of::<i32>(bytes).find(|&v| !exact(v.into())).map(i64::from),
        DType::Int64 => values_of::<i64>(bytes).find(|&v| !exact(v)),
        _ => None,
    };
    if let Some(value) = lossy {
        return Err(Error::OutOfSpace {
            what: format!("a value of column '{}'", spec.name),
            given: value.to_string(),
            expected:
                "integers within ±2^24, because the table stores float32; use another format, such as .h5, or split \
                       larger values into two columns"
                    .to_owned(),
        });
    }
    let n = spec.len() as i32;
    let values: ArrayRef = match precision {
        Precision::Double => {
            Arc::new(Float64Array::new(ScalarBuffer::from(values_of(bytes).collect::<Vec<f64>>()), None))
        }
        Precision::Single => Arc::new(Float32Array::new(ScalarBuffer::from(episode.to_f32(&spec.name)?), None)),
    };
    FixedSizeListArray::try_new(schema::list_item(precision), n, values, None)
        .map_err(|e| Error::external("storing numeric values", e))
}

fn values_of<T: bytemuck::Pod>(bytes: &[u8]) -> impl Iterator<Item = T> {
    bytemuck::cast_slice::<u8, T>(bytes).iter().copied()
}
