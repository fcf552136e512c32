//! Pictures as a LeWM sees them.

use super::config::LewmConfig;
use crate::pixels::{self, ImageNormalization};
use burn::tensor::{Device, Tensor};
use swm_core::{Result, Schema};

/// Checks that a column holds pictures of the size the model sees.
///
/// # Errors
/// When there is no such column, or it holds something else.
pub fn check(config: &LewmConfig, schema: &Schema, column: &str) -> Result<()> {
    pixels::check(config.image, schema, column)
}

/// Pictures as normalised patches.
///
/// # Shapes
/// `[frames, image, image, 3]` bytes to `[frames, patches, 3 * patch * patch]`.
///
/// # Errors
/// When the bytes are not whole pictures of the configured size.
pub fn patches(config: &LewmConfig, rgb: &[u8], device: &Device) -> Result<Tensor<3>> {
    pixels::patches(&seen(config), config.encoder.patch(), rgb, device)
}

/// Pictures as normalised planes.
///
/// # Shapes
/// `[frames, image, image, 3]` bytes to `[frames, 3, image, image]`.
///
/// # Errors
/// As [`patches`].
pub fn planes(config: &LewmConfig, rgb: &[u8], device: &Device) -> Result<Tensor<4>> {
    pixels::planes(&seen(config), rgb, device)
}

fn seen(config: &LewmConfig) -> ImageNormalization {
    ImageNormalization { side: config.image, mean: config.pixel_mean, std: config.pixel_std }
}
