//! Conversion of RGB bytes to normalised tensors.

use crate::device::is_cpu;
use burn::tensor::{Device, Int, Tensor, TensorData};
use rayon::prelude::*;
use swm_core::{Batch, DType, Error, Result, Schema};

/// The size and the normalisation of a model's images: `(byte / 255 - mean) / std` for each colour channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageNormalization {
    /// The side of the square images, in pixels.
    pub side: usize,
    /// The mean of each channel for pixel values in 0 ..= 1.
    pub mean: [f32; 3],
    /// The standard deviation of each channel for pixel values in 0 ..= 1.
    pub std: [f32; 3],
}

impl ImageNormalization {
    /// Mean and standard deviation of the ImageNet pixels, with which published encoders were trained.
    pub const IMAGENET: ([f32; 3], [f32; 3]) = ([0.485, 0.456, 0.406], [0.229, 0.224, 0.225]);

    /// Returns the normalised values of the 256 byte values, for each channel.
    fn table(&self) -> [[f32; 256]; 3] {
        std::array::from_fn(|c| std::array::from_fn(|byte| (byte as f32 / 255.0 - self.mean[c]) / self.std[c]))
    }

    /// Returns the number of images in `rgb`.
    fn count(&self, rgb: &[u8]) -> Result<usize> {
        let side = self.side;
        let bytes = side * side * 3;
        if rgb.is_empty() || !rgb.len().is_multiple_of(bytes) {
            return Err(Error::mismatch(
                "reading images",
                format!("{} bytes", rgb.len()),
                format!("images of {side} x {side} x 3 bytes"),
            ));
        }
        Ok(rgb.len() / bytes)
    }
}

/// Checks that a column holds square images with a side of `side` pixels.
///
/// # Errors
/// When the column is missing, or has another type or shape.
pub fn check(side: usize, schema: &Schema, column: &str) -> Result<()> {
    let spec = schema.column(column)?;
    if spec.dtype == DType::U8 && spec.shape == [side, side, 3] {
        return Ok(());
    }
    Err(Error::mismatch(
        format!("reading the images of '{column}'"),
        format!("{} {:?}", spec.dtype.name(), spec.shape),
        format!(
            "uint8 [{side}, {side}, 3], the model's images (render and collect with {side} pixels, or train with model.image to match)"
        ),
    ))
}

/// Cuts images into normalised patches, row by row; the values of a patch are ordered by channel, then row, then
/// column.
///
/// # Shapes
/// Maps `[frames, side, side, 3]` bytes to `[frames, patches, 3 * patch * patch]`.
///
/// # Errors
/// When `rgb` is not a positive number of images of `images.side`.
pub fn patches(images: &ImageNormalization, patch: usize, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
    let (grid, width) = (images.side / patch, 3 * patch * patch);
    if !is_cpu(device) && images.side.is_multiple_of(2) && images.side.is_multiple_of(patch) {
        return Ok(device_patches(images, patch, rgb, images.count(rgb)?, device));
    }
    let values = normalised(images, patch, rgb)?;
    let frames = values.len() / (grid * grid * width);
    Ok(Tensor::from_data(TensorData::new(values, [frames, grid * grid, width]), device))
}

/// [`patches`] on a GPU: it gets the bytes, four in an integer, and converts and orders them.
fn device_patches(images: &ImageNormalization, patch: usize, rgb: &[u8], frames: usize, device: &Device) -> Tensor<3> {
    let grid = images.side / patch;
    let words: Vec<i32> = rgb.as_chunks::<4>().0.iter().map(|bytes| i32::from_le_bytes(*bytes)).collect();
    let count = words.len();
    let words = Tensor::<1, Int>::from_data(TensorData::new(words, [count]), device);
    let byte = |index: i32| words.clone().bitwise_right_shift_scalar(8 * index).bitwise_and_scalar(255);
    let bytes: Tensor<2, Int> = Tensor::stack((0..4).map(byte).collect(), 1);
    let channels = |values: [f32; 3]| Tensor::<1>::from_floats(values, device).reshape([1, 1, 1, 1, 1, 3]);
    let values = bytes.float().reshape([frames, grid, patch, grid, patch, 3]) / 255.0;
    let values = (values - channels(images.mean)) / channels(images.std);
    values.permute([0, 1, 3, 5, 2, 4]).reshape([frames, grid * grid, 3 * patch * patch])
}

/// Computes the values of [`patches`].
///
/// # Errors
/// As [`patches`].
pub(crate) fn normalised(images: &ImageNormalization, patch: usize, rgb: &[u8]) -> Result<Vec<f32>> {
    let side = images.side;
    let (frames, grid) = (images.count(rgb)?, side / patch);
    let (bytes, width) = (side * side * 3, 3 * patch * patch);
    let table = images.table();
    let mut values = vec![0.0f32; frames * bytes];
    values.par_chunks_mut(bytes).zip(rgb.par_chunks(bytes)).for_each(|(to, from)| {
        if patch == 1 {
            for (to, pixel) in to.as_chunks_mut::<3>().0.iter_mut().zip(from.as_chunks::<3>().0) {
                *to = std::array::from_fn(|c| table[c][usize::from(pixel[c])]);
            }
            return;
        }
        for (index, to) in to.chunks_mut(width).enumerate() {
            let (top, left) = (index / grid * patch, index % grid * patch);
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
    Ok(values)
}

/// The frames of a batch: RGB bytes, or features of the part of an encoder that is not trained.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Frames<'a> {
    /// The elements of all frames, as bytes.
    bytes: &'a [u8],
    /// The number of features of a frame, `[1, features]`; `None` for RGB bytes.
    features: Option<usize>,
    /// The bytes of a frame.
    frame: usize,
}

impl<'a> Frames<'a> {
    /// Returns the frames in the column `column` of a batch.
    ///
    /// # Errors
    /// When the batch has no such column.
    pub fn of(images: &ImageNormalization, batch: &'a Batch, column: &str) -> Result<Self> {
        let spec = batch.schema().column(column)?;
        let bytes = batch.bytes(batch.schema().index(column)?);
        Ok(match (spec.dtype, spec.shape.last()) {
            (DType::Float32, Some(&width)) => Self { bytes, features: Some(width), frame: width * size_of::<f32>() },
            _ => Self { bytes, features: None, frame: images.side * images.side * 3 },
        })
    }

    /// Returns the frames with the given indices.
    pub fn range(self, frames: std::ops::Range<usize>) -> Self {
        Self { bytes: &self.bytes[frames.start * self.frame..frames.end * self.frame], ..self }
    }

    /// The bytes of each frame.
    pub fn each(self) -> std::slice::ChunksExact<'a, u8> {
        self.bytes.chunks_exact(self.frame)
    }

    /// Converts the frames to the inputs of an encoder: patches as [`patches`], or features, `[frames, 1, features]`.
    ///
    /// # Errors
    /// As [`patches`].
    pub fn inputs(self, images: &ImageNormalization, patch: usize, device: &Device) -> Result<Tensor<3>> {
        let Some(width) = self.features else { return patches(images, patch, self.bytes, device) };
        let values: Vec<f32> = bytemuck::pod_collect_to_vec(self.bytes);
        let frames = values.len() / width;
        Ok(Tensor::from_data(TensorData::new(values, [frames, 1, width]), device))
    }
}

/// Converts images to normalised colour planes, channels first.
///
/// # Shapes
/// Maps `[frames, side, side, 3]` bytes to `[frames, 3, side, side]`.
///
/// # Errors
/// When `rgb` is not a positive number of images of `images.side`.
pub fn planes(images: &ImageNormalization, rgb: &[u8], device: &Device) -> Result<Tensor<4>> {
    let (side, frames) = (images.side, images.count(rgb)?);
    // A patch as large as the image has the layout of the planes.
    Ok(patches(images, side, rgb, device)?.reshape([frames, 3, side, side]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_orders_and_normalises_as_the_cpu() {
        let (mean, std) = ImageNormalization::IMAGENET;
        let images = ImageNormalization { side: 6, mean, std };
        let rgb: Vec<u8> = (0..2 * 6 * 6 * 3).map(|i| (i * 89 % 256) as u8).collect();
        for patch in [1, 2, 3, 6] {
            let device = Device::flex();
            let expected = patches(&images, patch, &rgb, &device).expect("two images");
            let found = device_patches(&images, patch, &rgb, 2, &device);
            assert_eq!(found.dims(), expected.dims());
            for (a, b) in found.into_data().iter::<f32>().zip(expected.into_data().iter::<f32>()) {
                assert!((a - b).abs() <= 1e-6 * b.abs().max(1.0), "{a} instead of {b}");
            }
        }
    }
}
