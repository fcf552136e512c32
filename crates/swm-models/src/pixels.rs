//! From RGB bytes to normalised numbers.

use burn::tensor::{Device, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{DType, Error, Result, Schema};

/// How pictures become numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageNormalization {
    /// The side of the square pictures.
    pub side: usize,
    /// Mean by colour, of 0 ..= 1.
    pub mean: [f32; 3],
    /// Spread by colour, of 0 ..= 1.
    pub std: [f32; 3],
}

impl ImageNormalization {
    /// The mean and spread of ImageNet, which published encoders were trained with.
    pub const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);

    /// 256 possible bytes for 3 colours: the normalisation is a table.
    fn table(&self) -> [[f32; 256]; 3] {
        std::array::from_fn(|c| {
            std::array::from_fn(|byte| {
                #[allow(clippy::cast_precision_loss)]
                let value = byte as f32 / 255.0;
                (value - self.mean[c]) / self.std[c]
            })
        })
    }

    /// How many pictures some bytes are.
    fn count(&self, rgb: &[u8]) -> Result<usize> {
        let side = self.side;
        let bytes = side * side * 3;
        if rgb.is_empty() || !rgb.len().is_multiple_of(bytes) {
            return Err(Error::mismatch(
                "reading pictures",
                format!("{} bytes", rgb.len()),
                format!("pictures of {side} x {side} x 3 bytes"),
            ));
        }
        Ok(rgb.len() / bytes)
    }
}

/// Checks that a column holds pictures of the size the model sees.
///
/// # Errors
/// When there is no such column, or it holds something else.
pub fn check(side: usize, schema: &Schema, column: &str) -> Result<()> {
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
/// `[frames, side, side, 3]` bytes to `[frames, patches, 3 * patch * patch]`.
///
/// # Errors
/// When the bytes are not whole pictures of that side.
pub fn patches(pixels: &ImageNormalization, patch: usize, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
    let side = pixels.side;
    let (frames, grid) = (pixels.count(rgb)?, side / patch);
    let (bytes, numbers) = (side * side * 3, 3 * patch * patch);
    let table = pixels.table();
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

/// Normalised pictures as planes, one a colour.
///
/// # Shapes
/// `[frames, side, side, 3]` bytes to `[frames, 3, side, side]`.
///
/// # Errors
/// When the bytes are not whole pictures of that side.
pub fn planes(pixels: &ImageNormalization, rgb: &[u8], device: &Device) -> Result<Tensor<4>> {
    let (side, frames) = (pixels.side, pixels.count(rgb)?);
    // A picture is one patch as large as itself.
    Ok(patches(pixels, side, rgb, device)?.reshape([frames, 3, side, side]))
}
