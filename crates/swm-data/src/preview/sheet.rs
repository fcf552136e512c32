//! Still pictures of what a dataset or a world looks like: frames side by side, written as PNG.

use std::io::BufWriter;
use std::path::Path;
use swm_core::{Error, Result};

/// Pixels between the frames of a contact sheet and around them.
const GAP: usize = 2;
/// The grey between the frames: neither the white nor the black that worlds are drawn on.
const BACKGROUND: u8 = 128;

/// An RGB picture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `height * width * 3` bytes, row after row.
    pub rgb: Vec<u8>,
}

/// Lays out `frames` (each `height * width * 3` bytes, RGB) in a grid of `columns`, in reading order, every
/// pixel drawn as a square of `scale` by `scale`.
///
/// # Errors
/// When there is no frame, a frame has another size, or `columns`, `scale` or a side is 0.
pub fn contact_sheet<F: AsRef<[u8]>>(
    width: usize,
    height: usize,
    frames: &[F],
    columns: usize,
    scale: usize,
) -> Result<Picture> {
    if frames.is_empty() || columns == 0 || scale == 0 || width == 0 || height == 0 {
        return Err(Error::config(
            "contact sheet",
            format!("{} frames of {width} x {height} pixels in {columns} columns, scaled by {scale}", frames.len()),
            "give each of them at least 1",
        ));
    }
    let columns = columns.min(frames.len());
    let (cell_width, cell_height) = (width * scale + GAP, height * scale + GAP);
    let sheet_width = columns * cell_width + GAP;
    let sheet_height = frames.len().div_ceil(columns) * cell_height + GAP;
    let mut rgb = vec![BACKGROUND; sheet_width * sheet_height * 3];
    for (i, frame) in frames.iter().enumerate() {
        let frame = frame.as_ref();
        if frame.len() != width * height * 3 {
            return Err(Error::mismatch(
                format!("frame {i} of a contact sheet"),
                format!("{} bytes", frame.len()),
                format!("{}, for {width} x {height} RGB pixels", width * height * 3),
            ));
        }
        let (left, top) = (GAP + i % columns * cell_width, GAP + i / columns * cell_height);
        for y in 0..height * scale {
            let from = &frame[y / scale * width * 3..][..width * 3];
            let to = &mut rgb[((top + y) * sheet_width + left) * 3..][..width * scale * 3];
            for (pixel, square) in from.chunks_exact(3).zip(to.chunks_exact_mut(3 * scale)) {
                for copy in square.chunks_exact_mut(3) {
                    copy.copy_from_slice(pixel);
                }
            }
        }
    }
    Ok(Picture { width: sheet_width, height: sheet_height, rgb })
}

/// Writes an RGB picture (`height * width * 3` bytes) as PNG.
///
/// # Errors
/// When the bytes are not that many, or the file cannot be written.
pub fn write_png(path: &Path, width: usize, height: usize, rgb: &[u8]) -> Result<()> {
    if width == 0 || height == 0 || rgb.len() != width * height * 3 {
        return Err(Error::mismatch(
            format!("writing {}", path.display()),
            format!("{} bytes", rgb.len()),
            format!("{}, for {width} x {height} RGB pixels", width * height * 3),
        ));
    }
    let side = |pixels: usize| {
        u32::try_from(pixels).map_err(|_| {
            Error::config(
                format!("picture {}", path.display()),
                format!("{pixels} pixels wide or high"),
                "make it smaller",
            )
        })
    };
    let (wide, high) = (side(width)?, side(height)?);
    let file = std::fs::File::create(path).map_err(|source| Error::io(path, "creating a picture", source))?;
    let mut encoder = png::Encoder::new(BufWriter::new(file), wide, high);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let failed = |error: png::EncodingError| match error {
        png::EncodingError::IoError(source) => Error::io(path, "writing a picture", source),
        other => Error::external(format!("encoding {}", path.display()), other),
    };
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(rgb).map_err(failed)?;
    writer.finish().map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_laid_out_in_reading_order() {
        let frames: Vec<Vec<u8>> = (1..=3).map(|v| vec![v; 2 * 3]).collect();
        let sheet = contact_sheet(2, 1, &frames, 2, 3).expect("sheet");
        assert_eq!((sheet.width, sheet.height), (GAP + 2 * (6 + GAP), GAP + 2 * (3 + GAP)));
        let at = |x: usize, y: usize| sheet.rgb[(y * sheet.width + x) * 3];
        assert_eq!([at(0, 0), at(2, 2), at(7, 4), at(8, 4), at(10, 2)], [BACKGROUND, 1, 1, BACKGROUND, 2]);
        assert_eq!([at(2, 5), at(2, 7), at(10, 7)], [BACKGROUND, 3, BACKGROUND]);
        // Fewer frames than columns leave no empty cells.
        assert_eq!(contact_sheet(2, 1, &frames[..1], 8, 1).expect("sheet").width, 2 + 2 * GAP);
        let wrong = contact_sheet(2, 2, &frames, 2, 1).expect_err("too small").to_string();
        assert!(wrong.contains("frame 0") && wrong.contains("12"), "{wrong}");
        assert!(contact_sheet::<Vec<u8>>(2, 2, &[], 2, 1).is_err());
    }

    #[test]
    fn pictures_read_back() {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("a.png");
        let rgb: Vec<u8> = (0..5 * 4 * 3).collect();
        write_png(&path, 5, 4, &rgb).expect("written");
        let file = std::io::BufReader::new(std::fs::File::open(&path).expect("open"));
        let mut reader = png::Decoder::new(file).read_info().expect("header");
        let mut read = vec![0; rgb.len()];
        let info = reader.next_frame(&mut read).expect("frame");
        assert_eq!((info.width, info.height, read), (5, 4, rgb.clone()));
        assert!(write_png(&path, 4, 4, &rgb).is_err());
        let missing = write_png(&folder.path().join("missing/a.png"), 5, 4, &rgb).expect_err("no folder").to_string();
        assert!(missing.contains("creating a picture"), "{missing}");
    }
}
