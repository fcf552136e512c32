//! [`Surface`]: an RGB image with y up, and the pixels and straight lines drawn on it.
//!
//! The surface records which columns of every row were drawn since it was last equal to its background, so that a frame
//! restores and resizes only these columns.

use crate::draw::Point;
use std::ops::Range;

/// A colour, packed into 32 bits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Color(u32);

impl Color {
    /// Packs red, green and blue.
    pub const fn new([r, g, b]: [u8; 3]) -> Self {
        Self(u32::from_le_bytes([r, g, b, 0]))
    }

    /// Unpacks red, green and blue.
    pub const fn rgb(self) -> [u8; 3] {
        let [r, g, b, _] = self.0.to_le_bytes();
        [r, g, b]
    }

    /// Blends this colour over `below` with a weight of `weight` / 256.
    fn over(self, below: Self, weight: i32) -> Self {
        // SDL_gfx scales the weight by the opacity, which is 255 of 256 for an opaque colour.
        let share = (255 * weight) >> 8;
        let [above, below] = [self, below].map(|color| color.rgb().map(i32::from));
        Self::new(std::array::from_fn(|i| (below[i] + (((above[i] - below[i]) * share) >> 8)) as u8))
    }
}

/// Coordinates are clipped to this magnitude, far outside any surface, so that no arithmetic overflows.
const FAR: f64 = 8192.0;

/// Returns the pixel of a point; fractions are truncated.
pub fn pixel([x, y]: [f64; 2]) -> Point {
    let whole = |v: f64| v.clamp(-FAR, FAR) as i32;
    Point::new(whole(x), whole(y))
}

/// An RGB image; its lowest row comes first.
#[derive(Clone)]
pub struct Surface {
    pub(super) width: usize,
    /// The colours, `[height, width]`.
    pixels: Vec<Color>,
    /// For every row, a range of columns that contains all drawn columns.
    pub(super) drawn: Vec<Range<usize>>,
    /// Scratch memory: the coverage of the pixels of a row by a shape.
    pub(super) covered: Vec<f32>,
}

/// The empty range of columns; its union with another range is that range.
pub const NONE: Range<usize> = Range { start: usize::MAX, end: 0 };

impl Surface {
    /// Makes a surface of one colour without drawn columns.
    pub fn new(width: usize, height: usize, color: Color) -> Self {
        Self { width, pixels: vec![color; width * height], drawn: vec![NONE; height], covered: vec![0.0; width] }
    }

    /// Width and height, in pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.drawn.len())
    }

    /// The pixels of a row; row 0 is the lowest.
    pub fn row(&self, y: usize) -> &[Color] {
        &self.pixels[y * self.width..][..self.width]
    }

    /// A range that contains the drawn columns of a row; empty if the row has no drawn column.
    pub fn drawn(&self, y: usize) -> Range<usize> {
        self.drawn[y].clone()
    }

    /// Sets every pixel to a colour.
    pub fn clear(&mut self, color: Color) {
        self.pixels.fill(color);
    }

    /// Copies another surface of the same size, and marks all columns as not drawn.
    pub fn copy(&mut self, other: &Self) {
        self.pixels.copy_from_slice(&other.pixels);
        self.set_drawn(false);
    }

    /// Marks all columns as drawn, or as not drawn.
    pub fn set_drawn(&mut self, all: bool) {
        self.drawn.fill(if all { 0..self.width } else { NONE });
    }

    /// Restores the drawn columns from `background`.
    pub fn restore(&mut self, background: &Self) {
        for (y, drawn) in self.drawn.iter_mut().enumerate() {
            let columns = std::mem::replace(drawn, NONE);
            if !columns.is_empty() {
                let row = y * self.width + columns.start..y * self.width + columns.end;
                self.pixels[row.clone()].copy_from_slice(&background.pixels[row]);
            }
        }
    }

    /// Draws a horizontal line from `x0` to `x1`, both included, in either order.
    pub fn horizontal_line(&mut self, y: i32, x0: i32, x1: i32, color: Color) {
        let (from, to) = (x0.min(x1).max(0), x0.max(x1).min(self.width as i32 - 1));
        if from <= to && (0..self.drawn.len() as i32).contains(&y) {
            let (y, columns) = (y as usize, from as usize..to as usize + 1);
            let drawn = &mut self.drawn[y];
            *drawn = drawn.start.min(columns.start)..drawn.end.max(columns.end);
            self.pixels[y * self.width..][columns].fill(color);
        }
    }

    /// Fills the drawn columns of a row.
    pub fn fill_drawn(&mut self, y: i32, color: Color) {
        let (y, drawn) = (y as usize, self.drawn(y as usize));
        if !drawn.is_empty() {
            self.pixels[y * self.width..][drawn].fill(color);
        }
    }

    /// Draws a vertical line from `y0` to `y1`, both included.
    pub fn vertical_line(&mut self, x: i32, y0: i32, y1: i32, color: Color) {
        (y0..=y1).for_each(|y| self.horizontal_line(y, x, x, color));
    }

    /// Blends a colour over a pixel with `weight` / 256.
    pub fn blend(&mut self, at: Point, color: Color, weight: i32) {
        self.change(at, |below| color.over(below, weight));
    }

    /// Blends a share of a colour over a pixel; channels are rounded down.
    pub(super) fn blend_share(&mut self, at: Point, color: Color, share: f32) {
        self.change(at, |below| {
            let [above, below] = [color, below].map(|color| color.rgb().map(f32::from));
            Color::new(std::array::from_fn(|i| (above[i] * share + below[i] * (1.0 - share)) as u8))
        });
    }

    /// Replaces the colour of a pixel, if it is on the surface.
    fn change(&mut self, at: Point, color: impl FnOnce(Color) -> Color) {
        let (Ok(x), Ok(y)) = (usize::try_from(at.x), usize::try_from(at.y)) else { return };
        if x < self.width && y < self.drawn.len() {
            let pixel = &mut self.pixels[y * self.width + x];
            *pixel = color(*pixel);
            let drawn = &mut self.drawn[y];
            *drawn = drawn.start.min(x)..drawn.end.max(x + 1);
        }
    }
}
