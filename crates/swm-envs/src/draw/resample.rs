//! [`Resampler`]: converts a canvas to RGB of another size with OpenCV's bilinear interpolation.

use super::{Area, Canvas, Palette};
use std::ops::Range;
use swm_image::resize::{BilinearTap, bilinear_blend, bilinear_taps};

/// Converts canvases of one size to RGB images of another size.
#[derive(Clone, Debug)]
pub struct Resampler {
    columns: Vec<BilinearTap>,
    rows: Vec<BilinearTap>,
}

impl Resampler {
    /// Makes a resampler from canvases of `side`² pixels to images of `width` x `height` pixels.
    pub fn new(side: usize, width: usize, height: usize) -> Self {
        Self { columns: bilinear_taps(side, width), rows: bilinear_taps(side, height) }
    }

    /// The width of the image, in pixels.
    pub fn width(&self) -> usize {
        self.columns.len()
    }

    /// Writes the part of the image `rgb`, `[height, width, 3]`, that depends on an area of the canvas.
    pub fn draw(&self, canvas: &Canvas, palette: &Palette, area: Area, rgb: &mut [u8]) {
        let (columns, rows) = area.within(canvas.side());
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let (columns, rows) = (touched(&self.columns, &columns), touched(&self.rows, &rows));
        let taps = &self.columns[columns.clone()];
        for y in rows {
            let row = &self.rows[y];
            let lines = [canvas.row(row.first), canvas.row(row.second)];
            let start = 3 * (y * self.width() + columns.start);
            let pixels = rgb[start..start + 3 * taps.len()].as_chunks_mut::<3>().0;
            for (pixel, tap) in pixels.iter_mut().zip(taps) {
                let [a, b, c, d] =
                    [lines[0][tap.first], lines[0][tap.second], lines[1][tap.first], lines[1][tap.second]];
                *pixel = if a == b && a == c && a == d {
                    palette.color(a)
                } else {
                    bilinear_blend([a, b, c, d].map(|index| palette.color(index)), tap.weights, row.weights)
                };
            }
        }
    }
}

/// Returns the indices of the taps that read a range of pixels of the canvas.
fn touched(taps: &[BilinearTap], range: &Range<usize>) -> Range<usize> {
    let from = taps.partition_point(|tap| tap.second < range.start);
    let to = taps.partition_point(|tap| tap.first < range.end);
    from..to
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Point;

    #[test]
    fn resampled_images_equal_those_of_opencv() {
        let mut canvas = Canvas::new(8);
        canvas.fill_polygon(&[Point::new(0, 0), Point::new(3, 0), Point::new(3, 5), Point::new(0, 5)], 1);
        let palette = Palette::new(&[[0, 0, 0], [200, 100, 50]]);
        let everything = Area::square(8);
        let red = |width: usize, height: usize| {
            let mut rgb = vec![9; width * height * 3];
            Resampler::new(8, width, height).draw(&canvas, &palette, everything, &mut rgb);
            rgb.chunks(3).map(|pixel| pixel[0]).collect::<Vec<_>>()
        };
        // cv2.resize(red channel, (3, 3)) and (5, 2)
        assert_eq!(red(3, 3), [200, 100, 0, 200, 100, 0, 0, 0, 0]);
        assert_eq!(red(5, 2), [200, 200, 100, 0, 0, 100, 100, 50, 0, 0]);
    }
}
