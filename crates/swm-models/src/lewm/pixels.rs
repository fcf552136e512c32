//! From RGB bytes to normalised patches.

use super::config::LewmConfig;
use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{DType, Error, Result, Schema};

/// Checks that a column holds pictures of the size the model sees.
///
/// # Errors
/// When there is no such column, or it holds something else.
pub fn check(config: &LewmConfig, schema: &Schema, column: &str) -> Result<()> {
    let side = config.image;
    let spec = schema.column(column)?;
    if spec.dtype == DType::U8 && spec.shape == [side, side, 3] {
        return Ok(());
    }
    Err(Error::mismatch(
        format!("reading the pictures of '{column}'"),
        format!("{} {:?}", spec.dtype.name(), spec.shape),
        format!(
            "uint8 [{side}, {side}, 3], what the model sees (draw and collect pictures of {side} pixels, or train with model.image to match)"
        ),
    ))
}

/// Cuts pictures into normalised patches, in rows; the numbers of a patch go by colour, then row, then column.
///
/// # Shapes
/// `[frames, image, image, 3]` bytes to `[frames, patches, 3 * patch * patch]`.
///
/// # Errors
/// When the bytes are not whole pictures of the configured size.
pub fn patches(config: &LewmConfig, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
    let (side, patch) = (config.image, config.encoder.patch());
    let bytes = side * side * 3;
    if rgb.is_empty() || !rgb.len().is_multiple_of(bytes) {
        return Err(Error::mismatch(
            "reading pictures",
            format!("{} bytes", rgb.len()),
            format!("pictures of {side} x {side} x 3 bytes"),
        ));
    }
    let (frames, grid) = (rgb.len() / bytes, side / patch);
    let numbers = 3 * patch * patch;
    // 256 possible bytes for 3 colours: the normalisation is a table.
    let table: Vec<[f32; 256]> = (0..3)
        .map(|c| {
            std::array::from_fn(|byte| {
                #[allow(clippy::cast_precision_loss)]
                let value = byte as f32 / 255.0;
                (value - config.pixel_mean[c]) / config.pixel_std[c]
            })
        })
        .collect();
    let mut values = vec![0.0f32; frames * bytes];
    values.par_chunks_mut(bytes).zip(rgb.par_chunks(bytes)).for_each(|(to, from)| {
        for (place, to) in to.chunks_mut(numbers).enumerate() {
            let (top, left) = (place / grid * patch, place % grid * patch);
            for y in 0..patch {
                let row = &from[((top + y) * side + left) * 3..][..patch * 3];
                for (x, pixel) in row.chunks(3).enumerate() {
                    for c in 0..3 {
                        to[(c * patch + y) * patch + x] = table[c][usize::from(pixel[c])];
                    }
                }
            }
        }
    });
    Ok(Tensor::from_data(TensorData::new(values, [frames, grid * grid, numbers]), device))
}
