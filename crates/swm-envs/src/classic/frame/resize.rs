//! [`Resize`]: converts a [`Surface`] to an RGB frame of another size with the triangle filter of Pillow's bilinear
//! resize.
//!
//! The arithmetic is Pillow's: weights in units of 2⁻²², first along x, then along y, with bytes in between. (From
//! version 13 on, Pillow begins with y where that is faster; some bytes then differ by 1.)
//!
//! A pixel of a frame is a weighted mean of the surface pixels under the filter. Rows of a drawing consist of a few
//! runs of one colour, so the mean along x is computed per run, from precomputed partial sums of the weights. Only the
//! columns of the surface that are marked as drawn are filtered again.

use super::surface::{Color, NONE, Surface};
use std::ops::Range;
use swm_image::resize::{FilterAxis, WEIGHT_HALF, weighted_byte};

/// The filter along one axis.
#[derive(Clone)]
struct Axis {
    filter: FilterAxis<i32>,
    /// For every pixel of the frame, the index of its first partial sum in `sums`.
    sums_start: Vec<usize>,
    /// For every pixel of the frame, the partial sums of its weights, from 0 to the sum of all its weights.
    sums: Vec<i32>,
    /// For every pixel of the surface, the range of frame pixels that depend on it.
    reach: Vec<Range<usize>>,
}

impl Axis {
    fn new(surface: usize, frame: usize) -> Self {
        let filter = FilterAxis::<i32>::triangle(surface, frame);
        let (mut sums_start, mut sums, mut reach) = (vec![], vec![], vec![NONE; surface]);
        for i in 0..frame {
            sums_start.push(sums.len());
            sums.push(0);
            let mut sum = 0;
            for (x, weight) in filter.source(i).zip(filter.weights(i)) {
                sum += weight;
                sums.push(sum);
                reach[x] = reach[x].start.min(i)..i + 1;
            }
        }
        Self { filter, sums_start, sums, reach }
    }

    /// Returns the range of frame pixels that depend on any surface pixel in `pixels`.
    fn reached(&self, pixels: &Range<usize>) -> Range<usize> {
        self.reach[pixels.start].start..self.reach[pixels.end - 1].end
    }
}

/// Pairs of a colour of the surface and the colour that replaces it in the frame, applied in order.
pub type Swaps<'a> = &'a [(Color, Color)];

/// Converts surfaces of one size to frames of one size. It caches the converted background.
#[derive(Clone)]
pub struct Resize {
    columns: Axis,
    rows: Axis,
    /// The surface filtered along x, top row first, `[surface height, width, 3]`.
    lines: Vec<u8>,
    /// The background filtered along x, with the shape of `lines`.
    background_lines: Vec<u8>,
    /// The background as a frame, `[height, width, 3]`.
    background_frame: Vec<u8>,
    /// For every line, the range of bytes that differ from the background.
    changed: Vec<Range<usize>>,
    /// Scratch memory: weighted sums for one row of the frame, `[width, 3]`.
    sums: Vec<i32>,
}

impl Resize {
    /// Makes a converter from surfaces of `surface` (width, height) to frames of `width` x `height`, in pixels.
    pub fn new(surface: (usize, usize), width: usize, height: usize) -> Self {
        let bytes = 3 * width;
        Self {
            columns: Axis::new(surface.0, width),
            rows: Axis::new(surface.1, height),
            lines: vec![0; surface.1 * bytes],
            background_lines: vec![0; surface.1 * bytes],
            background_frame: vec![0; height * bytes],
            changed: vec![0..0; surface.1],
            sums: vec![0; bytes],
        }
    }

    /// Sets the background; all columns of `background` must be marked as drawn.
    pub fn set_background(&mut self, background: &Surface, swaps: Swaps<'_>) {
        let mut frame = std::mem::take(&mut self.background_frame);
        self.filter_rows(background, swaps);
        self.filter_columns(&mut frame);
        self.background_lines.copy_from_slice(&self.lines);
        self.background_frame = frame;
    }

    /// Converts a surface, which differs from the background only in the columns marked as drawn. Shape of `rgb`:
    /// `[height, width, 3]`.
    pub fn draw(&mut self, surface: &Surface, swaps: Swaps<'_>, rgb: &mut [u8]) {
        rgb.copy_from_slice(&self.background_frame);
        self.filter_rows(surface, swaps);
        self.filter_columns(rgb);
        let bytes = self.sums.len();
        for (y, columns) in self.changed.iter().enumerate().filter(|(_, columns)| !columns.is_empty()) {
            let line = y * bytes + columns.start..y * bytes + columns.end;
            self.lines[line.clone()].copy_from_slice(&self.background_lines[line]);
        }
    }

    /// Filters the drawn columns of every row along x, into `lines`.
    fn filter_rows(&mut self, surface: &Surface, swaps: Swaps<'_>) {
        let (bytes, height) = (self.sums.len(), self.changed.len());
        for (y, changed) in self.changed.iter_mut().enumerate() {
            let from_below = height - 1 - y;
            let drawn = surface.drawn(from_below);
            if drawn.is_empty() {
                *changed = 0..0;
                continue;
            }
            let taps = self.columns.reached(&drawn);
            let sums = &mut self.sums[3 * taps.start..3 * taps.end];
            sums.fill(WEIGHT_HALF);
            let row = surface.row(from_below);
            let end = self.columns.filter.source(taps.end - 1).end;
            let mut x = self.columns.filter.source(taps.start).start;
            while x < end {
                let run = x..x + row[x..end].iter().take_while(|&&color| color == row[x]).count();
                let color = swaps.iter().fold(row[x], |color, &(from, to)| if color == from { to } else { color });
                let color = color.rgb().map(i32::from);
                let reached = self.columns.reached(&run);
                for tap in reached.start.max(taps.start)..reached.end.min(taps.end) {
                    let (pixels, start) = (self.columns.filter.source(tap), self.columns.sums_start[tap]);
                    let before = |x: usize| self.columns.sums[start + x.clamp(pixels.start, pixels.end) - pixels.start];
                    let weight = before(run.end) - before(run.start);
                    let sum = &mut sums[3 * (tap - taps.start)..][..3];
                    (0..3).for_each(|i| sum[i] += color[i] * weight);
                }
                x = run.end;
            }
            *changed = 3 * taps.start..3 * taps.end;
            sums_to_bytes(sums, &mut self.lines[y * bytes..][changed.clone()]);
        }
    }

    /// Filters the changed columns of `lines` along y, into `rgb`.
    fn filter_columns(&mut self, rgb: &mut [u8]) {
        let bytes = self.sums.len();
        for y in 0..self.rows.filter.len() {
            let lines = self.rows.filter.source(y);
            let changed = self.changed[lines.clone()].iter().filter(|columns| !columns.is_empty());
            let columns = changed.fold(NONE, |union, one| union.start.min(one.start)..union.end.max(one.end));
            if columns.is_empty() {
                continue;
            }
            let sums = &mut self.sums[columns.clone()];
            sums.fill(WEIGHT_HALF);
            for (line, &weight) in lines.zip(self.rows.filter.weights(y)) {
                let line = &self.lines[line * bytes..][columns.clone()];
                sums.iter_mut().zip(line).for_each(|(sum, &byte)| *sum += i32::from(byte) * weight);
            }
            sums_to_bytes(sums, &mut rgb[y * bytes..][columns]);
        }
    }
}

/// Converts sums of weighted bytes to bytes.
fn sums_to_bytes(sums: &[i32], bytes: &mut [u8]) {
    bytes.iter_mut().zip(sums).for_each(|(byte, &sum)| *byte = weighted_byte(sum));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Point;

    /// The grey level of a pixel in a test image of 9 x 6 pixels; row 0 is the top row.
    fn grey(x: usize, y: usize) -> u8 {
        if (x / 3 + y / 2) % 2 == 1 { ((x * 37 + y * y * 11) % 256) as u8 } else { 200 }
    }

    fn surface(is_drawn: impl Fn(usize, usize) -> bool) -> Surface {
        let mut surface = Surface::new(9, 6, Color::new([77; 3]));
        for (x, y) in (0..54).map(|i| (i % 9, i / 9)).filter(|&(x, y)| is_drawn(x, y)) {
            surface.horizontal_line(5 - y as i32, x as i32, x as i32, Color::new([grey(x, y); 3]));
        }
        surface
    }

    #[test]
    fn resized_frames_equal_those_of_pillow() {
        // The first rows of Image.resize(size, Image.BILINEAR).
        let expected: [(usize, usize, &[u8]); 3] = [
            (4, 3, &[182, 157, 177, 179, 127, 166, 150, 110, 190, 140, 160, 187]),
            (9, 2, &[148, 162, 176, 149, 172, 195, 136, 150, 163, 155, 169, 183, 119, 142, 165, 143, 156, 170]),
            (13, 6, &[200, 200, 200, 200, 145, 122, 148, 174, 191, 200, 200, 200, 200]),
        ];
        for (width, height, expected) in expected {
            // Of every four diagonals of pixels, this many belong to the background; all other pixels are drawn over
            // it.
            for diagonals in 0..4 {
                let mut resize = Resize::new((9, 6), width, height);
                let mut background = surface(|x, y| (x + y) % 4 < diagonals);
                background.set_drawn(true);
                resize.set_background(&background, &[]);
                let mut front = background.clone();
                front.set_drawn(false);
                for (x, y) in (0..54).map(|i| (i % 9, i / 9)) {
                    if (x + y) % 4 >= diagonals {
                        front.blend(Point::new(x as i32, 5 - y as i32), Color::new([0; 3]), 0);
                        front.horizontal_line(5 - y as i32, x as i32, x as i32, Color::new([grey(x, y); 3]));
                    }
                }
                for _ in 0..2 {
                    let mut rgb = vec![1; width * height * 3];
                    resize.draw(&front, &[], &mut rgb);
                    let red: Vec<u8> = rgb.chunks(3).map(|pixel| pixel[0]).collect();
                    assert_eq!(red[..expected.len()], *expected, "{width} x {height}, {diagonals} diagonals");
                }
            }
        }
    }

    #[test]
    fn colour_swaps_are_applied_in_order() {
        let [a, b, c] = [77, 5, 9].map(|v| Color::new([v; 3]));
        let mut background = Surface::new(2, 2, a);
        background.set_drawn(true);
        let mut resize = Resize::new((2, 2), 1, 1);
        let mut rgb = [0; 3];
        for (swaps, expected) in [(vec![(a, b), (b, c)], 9), (vec![(b, c), (a, b)], 5)] {
            resize.set_background(&background, &swaps);
            resize.draw(&background, &swaps, &mut rgb);
            assert_eq!(rgb, [expected; 3]);
        }
    }
}
