//! Contact sheets: frames of a dataset side by side in one image.

use swm_core::{Error, Result};
use swm_image::RgbImage;

/// Pixels between and around the frames of a contact sheet.
const GAP: usize = 2;
/// Grey level between frames. It differs from the white or black background of frames.
const BACKGROUND: u8 = 128;

/// Arranges `frames` (each `[height, width, 3]` RGB bytes) in a grid with `columns` columns, in reading order. Every
/// pixel becomes a square with side `scale`.
///
/// # Errors
/// If there is no frame, a frame does not have the given size, or `columns`, `scale` or a side is 0.
pub fn contact_sheet<F: AsRef<[u8]>>(
    width: usize,
    height: usize,
    frames: &[F],
    columns: usize,
    scale: usize,
) -> Result<RgbImage> {
    if frames.is_empty() || columns == 0 || scale == 0 || width == 0 || height == 0 {
        return Err(Error::config(
            "contact sheet",
            format!("{} frames of {width} x {height} pixels in {columns} columns, scaled by {scale}", frames.len()),
            "give at least one frame, and make each size at least 1",
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
    Ok(RgbImage { width: sheet_width, height: sheet_height, rgb })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contact_sheet_places_frames_in_reading_order() {
        let frames: Vec<Vec<u8>> = (1..=3).map(|v| vec![v; 2 * 3]).collect();
        let sheet = contact_sheet(2, 1, &frames, 2, 3).expect("creating the contact sheet");
        assert_eq!((sheet.width, sheet.height), (GAP + 2 * (6 + GAP), GAP + 2 * (3 + GAP)));
        let at = |x: usize, y: usize| sheet.rgb[(y * sheet.width + x) * 3];
        assert_eq!([at(0, 0), at(2, 2), at(7, 4), at(8, 4), at(10, 2)], [BACKGROUND, 1, 1, BACKGROUND, 2]);
        assert_eq!([at(2, 5), at(2, 7), at(10, 7)], [BACKGROUND, 3, BACKGROUND]);
        // Fewer frames than columns leave no empty cells.
        assert_eq!(contact_sheet(2, 1, &frames[..1], 8, 1).expect("creating the contact sheet").width, 2 + 2 * GAP);
        let wrong = contact_sheet(2, 2, &frames, 2, 1).expect_err("frames of another size").to_string();
        assert!(wrong.contains("frame 0") && wrong.contains("12"), "{wrong}");
        assert!(contact_sheet::<Vec<u8>>(2, 2, &[], 2, 1).is_err());
    }
}
