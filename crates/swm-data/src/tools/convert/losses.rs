//! The losses of images in a conversion: the minimum signal-to-noise ratio.

use super::comparison::{ColumnComparison, data_columns};
use super::{ConvertMode, ConvertOptions};
use crate::dataset::{Location, Reader};
use crate::formats::{FORMATS, FormatEntry, detect, has_no_dataset};
use swm_core::{Error, Result};
use swm_image::ImageCodec;

/// The minimum peak signal-to-noise ratio of an image column if none is given, in decibels.
pub const LEAST_PSNR: f64 = 25.0;

/// Checks a minimum signal-to-noise ratio that the user gave.
///
/// # Errors
/// If it is no ratio, or no image is stored with losses and verified, so that it would have no effect.
pub fn check_ratio(ratio: f64, reader: &dyn Reader, target: &Location, options: &ConvertOptions) -> Result<()> {
    let refused = |problem: String, fix: &str| Err(Error::config("least_psnr", problem, fix));
    if ratio.is_nan() || ratio < 0.0 {
        return refused(format!("{ratio} dB"), "give a number of at least 0");
    }
    if !options.verify {
        return refused("nothing is verified, so it has no effect".to_owned(), "leave it out, or verify the target");
    }
    if !has_images(reader) {
        return refused("the dataset has no images, so it has no effect".to_owned(), "leave it out");
    }
    // An existing target keeps its codec.
    let continues = matches!(options.mode, ConvertMode::Resume | ConvertMode::Append)
        && target.path().is_none_or(|path| path.exists() && !has_no_dataset(path));
    let format = match &options.format {
        Some(id) => Some(FORMATS.get(id)?),
        None => detect(target),
    };
    if !continues && format.is_some_and(|format| !is_lossy(format, options)) {
        let problem = format!("{target} stores images without loss, so it has no effect");
        return refused(problem, "leave it out, or choose the codec jpeg or a format of videos");
    }
    Ok(())
}

/// Returns whether a dataset has columns of images.
pub fn has_images(reader: &dyn Reader) -> bool {
    data_columns(reader.schema()).any(|(_, column)| column.is_image())
}

/// Returns whether a new dataset stores images with losses.
pub fn is_lossy(format: &FormatEntry, options: &ConvertOptions) -> bool {
    !format.exact_images || matches!(options.codec, ImageCodec::Jpeg { .. })
}

/// Checks the signal-to-noise ratio of image columns.
pub fn check_psnr(columns: &[ColumnComparison], options: &ConvertOptions) -> Result<()> {
    let least = options.least_psnr.unwrap_or(LEAST_PSNR);
    let bad = columns.iter().find(|column| column.psnr.is_some_and(|psnr| psnr < least));
    bad.map_or(Ok(()), |column| {
        Err(Error::mismatch(
            format!("images of column '{}'", column.column),
            format!("a signal-to-noise ratio of {:.1} dB", column.psnr.unwrap_or_default()),
            format!("at least {least} dB; choose a codec with higher quality"),
        ))
    })
}
