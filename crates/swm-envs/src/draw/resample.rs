//! From a canvas to RGB of another size: bilinear, in the fixed-point arithmetic of OpenCV.

use super::{Area, Canvas, Palette};
use std::ops::Range;

/// Fixed-point 1.
const ONE: i32 = 2048;

/// The two pixels of the canvas, in one direction, that a pixel of the picture lies between.
#[derive(Clone, Copy, Debug)]
struct Tap {
    first: usize,
    second: usize,
    /// Their shares, which add up to [`ONE`].
    shares: [i32; 2],
}

/// Where the pixels of a picture of one size lie on a canvas.
#[derive(Clone, Debug)]
pub struct Resampler {
    columns: Vec<Tap>,
    rows: Vec<Tap>,
}

#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn taps(canvas: usize, picture: usize) -> Vec<Tap> {
    let scale = canvas as f64 / picture as f64;
    let last = canvas - 1;
    (0..picture)
        .map(|i| {
            let at = ((i as f64 + 0.5) * scale - 0.5) as f32;
            let (first, part) = if at < 0.0 { (0, 0.0) } else { (at as usize, at - at.floor()) };
            let (first, part) = if first >= last { (last, 0.0) } else { (first, part) };
            let share = (part * ONE as f32).round_ties_even() as i32;
            Tap { first, second: (first + 1).min(last), shares: [ONE - share, share] }
        })
        .collect()
}

impl Resampler {
    /// For pictures of `width` x `height` of canvases of `side`².
    pub fn new(side: usize, width: usize, height: usize) -> Self {
        Self { columns: taps(side, width), rows: taps(side, height) }
    }

    /// Pixels in a row of the picture.
    pub fn width(&self) -> usize {
        self.columns.len()
    }

    /// Draws the part of the picture that an area of the canvas shows up in.
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
                    blend([a, b, c, d].map(|index| palette.color(index)), tap.shares, row.shares)
                };
            }
        }
    }
}

/// The taps that reach into a range of the canvas.
fn touched(taps: &[Tap], range: &Range<usize>) -> Range<usize> {
    let from = taps.partition_point(|tap| tap.second < range.start);
    let to = taps.partition_point(|tap| tap.first < range.end);
    from..to
}

/// Mixes four pixels: left and right above, left and right below.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn blend(colors: [[u8; 3]; 4], across: [i32; 2], down: [i32; 2]) -> [u8; 3] {
    std::array::from_fn(|i| {
        let [a, b, c, d] = colors.map(|color| i32::from(color[i]));
        let above = (a * across[0] + b * across[1]) >> 4;
        let below = (c * across[0] + d * across[1]) >> 4;
        ((((down[0] * above) >> 16) + ((down[1] * below) >> 16) + 2) >> 2) as u8
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Point;

    #[test]
    fn pictures_are_what_opencv_makes_of_the_canvas() {
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
