//! Conversion of images to the inputs of a LeWM.

use super::config::LewmConfig;
use crate::pixels::{self, ImageNormalization};
use burn::tensor::{Device, Tensor};
use swm_core::{Result, Schema};

/// Checks that a column holds images of the model's size.
///
/// # Errors
/// When the column is missing or has another type or shape.
pub fn check(config: &LewmConfig, schema: &Schema, column: &str) -> Result<()> {
    pixels::check(config.image, schema, column)
}

/// Converts images to normalised patches.
///
/// # Shapes
/// Maps `[frames, image, image, 3]` bytes to `[frames, patches, 3 * patch * patch]`.
///
/// # Errors
/// When the bytes are not a whole number of images.
pub fn patches(config: &LewmConfig, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
    pixels::patches(&normalization(config), config.encoder.patch(), rgb, device)
}

/// Converts images to normalised colour planes.
///
/// # Shapes
/// Maps `[frames, image, image, 3]` bytes to `[frames, 3, image, image]`.
///
/// # Errors
/// As [`patches`].
pub fn planes(config: &LewmConfig, rgb: &[u8], device: &Device) -> Result<Tensor<4>> {
    pixels::planes(&normalization(config), rgb, device)
}

pub(crate) fn normalization(config: &LewmConfig) -> ImageNormalization {
    ImageNormalization { side: config.image, mean: config.pixel_mean, std: config.pixel_std }
}
