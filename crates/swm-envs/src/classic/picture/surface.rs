//! A surface of RGB pixels and the shapes that SDL_gfx draws: polygons and discs with smooth outlines.
//!
//! Corners are whole pixels, y points up, and a smooth outline lets through what is below it by 256ths. The surface
//! remembers which pixels of every row were drawn since it was last equal to its background, so a frame restores and
//! resamples these alone.

use crate::draw::Point;
use std::ops::Range;

/// A colour as one number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Color(u32);

impl Color {
    /// A colour.
    pub const fn new([r, g, b]: [u8; 3]) -> Self {
        Self(u32::from_le_bytes([r, g, b, 0]))
    }

    /// Red, green and blue.
    pub const fn rgb(self) -> [u8; 3] {
        let [r, g, b, _] = self.0.to_le_bytes();
        [r, g, b]
    }

    /// `weight` 256ths of this colour over another one; 255 covers it.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn over(self, below: Self, weight: i32) -> Self {
        // An opaque colour's own share is 255 of 256, as SDL_gfx scales it.
        let share = (255 * weight) >> 8;
        let [above, below] = [self, below].map(|color| color.rgb().map(i32::from));
        Self::new(std::array::from_fn(|i| (below[i] + (((above[i] - below[i]) * share) >> 8)) as u8))
    }
}

/// Coordinates are cut to this, far outside of any surface, so that no arithmetic overflows.
const FAR: f64 = 8192.0;

/// The pixel of a place: fractions are dropped.
#[allow(clippy::cast_possible_truncation)]
pub fn pixel([x, y]: [f64; 2]) -> Point {
    let whole = |v: f64| v.clamp(-FAR, FAR) as i32;
    Point::new(whole(x), whole(y))
}

/// RGB pixels, row after row, the lowest row first.
#[derive(Clone)]
pub struct Surface {
    width: usize,
    pixels: Vec<Color>,
    /// The columns of every row that were drawn on.
    drawn: Vec<Range<usize>>,
    /// How far a shape covers the pixels of a row.
    covered: Vec<f32>,
}

/// No column; joined with others, it adds nothing.
pub const NONE: Range<usize> = Range { start: usize::MAX, end: 0 };

impl Surface {
    /// A surface of one colour, of which nothing counts as drawn.
    pub fn new(width: usize, height: usize, color: Color) -> Self {
        Self { width, pixels: vec![color; width * height], drawn: vec![NONE; height], covered: vec![0.0; width] }
    }

    /// Pixels in a row, and rows.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.drawn.len())
    }

    /// A row, from below.
    pub fn row(&self, y: usize) -> &[Color] {
        &self.pixels[y * self.width..][..self.width]
    }

    /// The columns of a row that were drawn on; empty where none was.
    pub fn drawn(&self, y: usize) -> Range<usize> {
        self.drawn[y].clone()
    }

    /// Makes every pixel one colour.
    pub fn clear(&mut self, color: Color) {
        self.pixels.fill(color);
    }

    /// Becomes another surface of the same size, of which nothing counts as drawn.
    pub fn copy(&mut self, other: &Self) {
        self.pixels.copy_from_slice(&other.pixels);
        self.set_drawn(false);
    }

    /// Counts everything as drawn, or nothing.
    pub fn set_drawn(&mut self, everything: bool) {
        self.drawn.fill(if everything { 0..self.width } else { NONE });
    }

    /// Takes back what was drawn on a copy of `background`.
    pub fn restore(&mut self, background: &Self) {
        for (y, drawn) in self.drawn.iter_mut().enumerate() {
            let columns = std::mem::replace(drawn, NONE);
            if !columns.is_empty() {
                let row = y * self.width + columns.start..y * self.width + columns.end;
                self.pixels[row.clone()].copy_from_slice(&background.pixels[row]);
            }
        }
    }

    /// The pixels from `x0` to `x1`, both included, in either order.
    #[allow(clippy::cast_sign_loss, clippy::cast_possible_wrap, clippy::cast_possible_truncation)]
    pub fn level(&mut self, y: i32, x0: i32, x1: i32, color: Color) {
        let (from, to) = (x0.min(x1).max(0), x0.max(x1).min(self.width as i32 - 1));
        if from <= to && (0..self.drawn.len() as i32).contains(&y) {
            let (y, columns) = (y as usize, from as usize..to as usize + 1);
            let drawn = &mut self.drawn[y];
            *drawn = drawn.start.min(columns.start)..drawn.end.max(columns.end);
            self.pixels[y * self.width..][columns].fill(color);
        }
    }

    /// Covers what was drawn on a row.
    #[allow(clippy::cast_sign_loss)]
    pub fn level_over(&mut self, y: i32, color: Color) {
        let (y, drawn) = (y as usize, self.drawn(y as usize));
        if !drawn.is_empty() {
            self.pixels[y * self.width..][drawn].fill(color);
        }
    }

    /// The pixels from `y0` to `y1`, both included.
    pub fn upright(&mut self, x: i32, y0: i32, y1: i32, color: Color) {
        (y0..=y1).for_each(|y| self.level(y, x, x, color));
    }

    /// `weight` 256ths of a colour over a pixel.
    pub fn blend(&mut self, at: Point, color: Color, weight: i32) {
        self.change(at, |below| color.over(below, weight));
    }

    /// A share of a colour over a pixel, rounded down.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn mix(&mut self, at: Point, color: Color, share: f32) {
        self.change(at, |below| {
            let [above, below] = [color, below].map(|color| color.rgb().map(f32::from));
            Color::new(std::array::from_fn(|i| (above[i] * share + below[i] * (1.0 - share)) as u8))
        });
    }

    fn change(&mut self, at: Point, color: impl FnOnce(Color) -> Color) {
        let (Ok(x), Ok(y)) = (usize::try_from(at.x), usize::try_from(at.y)) else { return };
        if x < self.width && y < self.drawn.len() {
            let pixel = &mut self.pixels[y * self.width + x];
            *pixel = color(*pixel);
            let drawn = &mut self.drawn[y];
            *drawn = drawn.start.min(x)..drawn.end.max(x + 1);
        }
    }

    /// A line that shares every step between the two pixels it passes between (Wu).
    fn smooth_line(&mut self, from: Point, to: Point, color: Color) {
        let (a, b) = if from.y <= to.y { (from, to) } else { (to, from) };
        let (width, height, side) = ((b.x - a.x).abs(), b.y - a.y, (b.x - a.x).signum());
        if height == 0 {
            return self.level(a.y, a.x, b.x, color);
        }
        if width == 0 {
            return self.upright(a.x, a.y, b.y, color);
        }
        if width == height {
            return (0..=width).for_each(|i| self.level(a.y + i, a.x + i * side, a.x + i * side, color));
        }
        for end in [from, to] {
            self.level(end.y, end.x, end.x, color);
        }
        let flat = width > height;
        let (steps, rise) = if flat { (width, height) } else { (height, width) };
        // How far the line is past a pixel, in 65536ths; rounded down as a whole at the beginning.
        let slope = (i64::from(rise) << 16) / i64::from(steps);
        for i in 1..steps {
            #[allow(clippy::cast_possible_truncation)]
            let (past, weight) = {
                let at = slope * i64::from(i);
                ((at >> 16) as i32, ((at >> 8) & 255) as i32)
            };
            let (near, far) = if flat {
                let x = a.x + i * side;
                (Point::new(x, a.y + past), Point::new(x, a.y + past + 1))
            } else {
                let y = a.y + i;
                (Point::new(a.x + past * side, y), Point::new(a.x + (past + 1) * side, y))
            };
            self.blend(near, color, 255 - weight);
            self.blend(far, color, weight);
        }
    }

    /// A line between places, not pixels. Every step along its longer axis is shared between the two pixels around the
    /// line; its ends cover their pixels in part.
    #[allow(clippy::cast_possible_truncation)]
    pub fn fine_line(&mut self, from: [f64; 2], to: [f64; 2], color: Color) {
        let steep = (to[0] - from[0]).abs() < (to[1] - from[1]).abs();
        let along = usize::from(steep);
        let (from, to) = if from[along] <= to[along] { (from, to) } else { (to, from) };
        let slope = (to[1 - along] - from[1 - along]) / (to[along] - from[along]);
        for step in from[along].floor() as i32..=to[along].ceil() as i32 {
            let at = f64::from(step);
            let across = from[1 - along] + slope * (at - from[along]);
            let covered = (1.0 + at - from[along]).min(1.0 + to[along] - at).min(1.0);
            let share = across - across.floor();
            for (beside, share) in [(1, share), (0, 1.0 - share)] {
                let across = across as i32 + beside;
                let at = if steep { Point::new(across, step) } else { Point::new(step, across) };
                self.mix(at, color, (share * covered) as f32);
            }
        }
    }

    /// A shape on some rows, told by the `spans` in which it crosses a level line at a height. A pixel is covered as far
    /// as the spans at [`LINES`] heights in it are; what spans share counts once for each, but no pixel more than whole.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
    pub fn shape<const N: usize>(
        &mut self,
        rows: Range<i32>,
        color: Color,
        opacity: f32,
        spans: impl Fn(f64) -> [[f64; 2]; N],
    ) {
        let width = self.width as f64;
        let bounds = |v: f64| v.clamp(0.0, width);
        for y in rows.start.max(0)..rows.end.min(self.drawn.len() as i32) {
            let mut reach = NONE;
            for line in 0..LINES {
                for [left, right] in spans(f64::from(y) + (line as f64 + 0.5) / LINES as f64) {
                    let (left, right) = (bounds(left), bounds(right));
                    if left < right {
                        let pixels = left as usize..right.ceil() as usize;
                        for x in pixels.clone() {
                            let part = right.min(x as f64 + 1.0) - left.max(x as f64);
                            self.covered[x] += part as f32 / LINES as f32;
                        }
                        reach = reach.start.min(pixels.start)..reach.end.max(pixels.end);
                    }
                }
            }
            for x in reach {
                let share = std::mem::take(&mut self.covered[x]).min(1.0) * opacity;
                if share > 0.0 {
                    self.mix(Point::new(x as i32, y), color, share);
                }
            }
        }
    }

    /// Fills a polygon and smooths its outline.
    pub fn polygon(&mut self, corners: &[Point], color: Color) {
        let sides = || corners.iter().zip(corners[1..].iter().chain(&corners[..1])).map(|(&a, &b)| (a, b));
        sides().for_each(|(a, b)| self.smooth_line(a, b, color));
        let (low, high) = corners.iter().fold((i32::MAX, i32::MIN), |(low, high), p| (low.min(p.y), high.max(p.y)));
        #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap)]
        let last = self.drawn.len() as i32 - 1;
        for y in low.max(0)..=high.min(last) {
            // Where the sides cross this row, in 65536ths of a pixel. A side owns its lower end, and the topmost
            // ones their upper end too.
            let mut crossings = [0; MAX_CORNERS];
            let mut count = 0;
            for (a, b) in sides() {
                let (a, b) = if a.y < b.y { (a, b) } else { (b, a) };
                if (a.y..b.y).contains(&y) || (y == high && a.y < y && y == b.y) {
                    let along = (i64::from(y - a.y) << 16) / i64::from(b.y - a.y);
                    let at = along * i64::from(b.x - a.x) + (i64::from(a.x) << 16);
                    let place = crossings[..count].partition_point(|&other| other <= at);
                    crossings.copy_within(place..count, place + 1);
                    crossings[place] = at;
                    count += 1;
                }
            }
            #[allow(clippy::cast_possible_truncation)]
            let nearest = |at: i64| ((at + (1 << 15)) >> 16) as i32;
            for pair in crossings[..count].chunks_exact(2) {
                self.level(y, nearest(pair[0] + 1), nearest(pair[1] - 1), color);
            }
        }
    }

    /// Fills a disc and smooths its outline.
    pub fn disc(&mut self, centre: Point, radius: i32, color: Color) {
        self.smooth_circle(centre, radius, color);
        // The midpoint algorithm; a row is as wide as where the circle enters it.
        let (mut decision, mut x, mut y, mut row) = (1 - radius, 0, radius, radius + 1);
        while x <= y {
            if row != y {
                self.level(centre.y + y, centre.x - x, centre.x + x, color);
                self.level(centre.y - y, centre.x - x, centre.x + x, color);
                row = y;
            }
            if x < y {
                self.level(centre.y - x, centre.x - y, centre.x + y, color);
                self.level(centre.y + x, centre.x - y, centre.x + y, color);
            }
            if decision < 0 {
                decision += 2 * x + 3;
            } else {
                decision += 2 * (x - y) + 5;
                y -= 1;
            }
            x += 1;
        }
    }

    /// The outline of a circle: from bottom and top outwards to the diagonal, then on to the sides,
    /// every step shared between the two pixels nearest to the true circle.
    ///
    /// `off` is how far a pixel is outside the circle, x² + y² - r², of which the slope along y (or x) makes a length.
    fn smooth_circle(&mut self, centre: Point, radius: i32, color: Color) {
        #[allow(clippy::cast_possible_truncation)]
        let steps = (f64::from(radius) * std::f64::consts::FRAC_1_SQRT_2).round_ties_even() as i32;
        for y in [-radius, radius] {
            self.level(centre.y + y, centre.x, centre.x, color);
        }
        let (mut x, mut y, mut off) = (0, -radius, 0);
        // The slopes: how `off` changes with the next step outwards, and with the next one towards the middle.
        let (mut outwards, mut inwards) = (0, -2 * radius);
        for _ in 0..steps {
            x -= 1;
            off += outwards - 1;
            let other = if off >= 0 {
                y - 1
            } else if off - inwards > 1 && 2 * off - inwards >= 1 {
                y + 1
            } else {
                let before = y;
                let past = off - inwards > 1;
                y += 1;
                off -= inwards + 1;
                inwards += 2;
                if past { before } else { y + 1 }
            };
            outwards -= 2;
            let weight = share(off, inwards);
            self.mirrored(centre, [x, y], color, 255 - weight);
            self.mirrored(centre, [x, other], color, weight);
        }
        for _ in 0..steps {
            y += 1;
            off -= inwards + 1;
            let other = if off <= 0 {
                x + 1
            } else if off + outwards < 1 && 2 * off + outwards <= 1 {
                x - 1
            } else {
                let before = x;
                let past = off + outwards < 1;
                x -= 1;
                off += outwards - 1;
                outwards -= 2;
                if past { before } else { x - 1 }
            };
            inwards += 2;
            let weight = share(off, outwards);
            self.mirrored(centre, [x, y], color, 255 - weight);
            self.mirrored(centre, [other, y], color, weight);
        }
    }

    /// A pixel and its mirror images.
    fn mirrored(&mut self, centre: Point, [x, y]: [i32; 2], color: Color, weight: i32) {
        for (x, y) in [(-x, -y), (x, -y), (-x, y), (x, y)] {
            self.blend(Point::new(centre.x + x, centre.y + y), color, weight);
        }
    }
}

/// At how many heights in a pixel the spans of a shape are asked for.
const LINES: usize = 4;
/// The most corners a polygon may have.
const MAX_CORNERS: usize = 4;

/// How much of a pixel the circle leaves to its neighbour, in 255ths.
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn share(off: i32, slope: i32) -> i32 {
    if slope == 0 { 255 } else { ((off.abs() as f32 / slope.abs() as f32).min(1.0) * 255.0) as i32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Some rows of a black shape on white, from below.
    fn rows(draw: impl FnOnce(&mut Surface), rows: Range<usize>, columns: Range<usize>) -> Vec<Vec<u8>> {
        let mut surface = Surface::new(14, 13, Color::new([255; 3]));
        draw(&mut surface);
        rows.map(|y| surface.row(y)[columns.clone()].iter().map(|color| color.rgb()[0]).collect()).collect()
    }

    #[test]
    fn shapes_cover_what_gfxdraw_covers() {
        // pygame 2.6.1: gfxdraw.aacircle and filled_circle at (6, 6), radius 4.
        let disc = rows(|surface| surface.disc(Point::new(6, 6), 4, Color::new([0; 3])), 2..7, 1..7);
        let wanted = [
            [255, 255, 255, 129, 32, 0],
            [255, 255, 86, 0, 0, 0],
            [255, 129, 0, 0, 0, 0],
            [255, 0, 0, 0, 0, 0],
            [255, 0, 0, 0, 0, 0],
        ];
        assert_eq!(disc, wanted);
        // gfxdraw.aapolygon and filled_polygon.
        let corners = [Point::new(2, 1), Point::new(11, 4), Point::new(8, 10), Point::new(1, 7)];
        let polygon = rows(|surface| surface.polygon(&corners, Color::new([0; 3])), 0..11, 1..12);
        let wanted = [
            [255, 255, 255, 255, 255, 255, 255, 255, 255, 255, 255],
            [255, 0, 86, 171, 255, 255, 255, 255, 255, 255, 255],
            [214, 0, 0, 0, 0, 86, 171, 255, 255, 255, 255],
            [171, 0, 0, 0, 0, 0, 0, 0, 86, 171, 255],
            [129, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 255],
            [0, 0, 0, 0, 0, 0, 0, 0, 0, 129, 255],
            [255, 147, 0, 0, 0, 0, 0, 0, 0, 255, 255],
            [255, 255, 255, 183, 74, 0, 0, 0, 0, 255, 255],
            [255, 255, 255, 255, 255, 220, 110, 0, 255, 255, 255],
        ];
        assert_eq!(polygon, wanted);
    }

    #[test]
    fn shapes_told_by_spans_cover_shares_of_pixels() {
        // A triangle from (2, 1) to (10, 1) and (2, 9), and a square in it that counts no pixel twice.
        let spans = |y: f64| match y {
            1.0..6.0 => [[2.0, 11.0 - y], [2.0, 4.0]],
            6.0..9.0 => [[2.0, 11.0 - y], [0.0; 2]],
            _ => [[0.0; 2]; 2],
        };
        let black = Color::new([0; 3]);
        let triangle = rows(|surface| surface.shape(0..99, black, 1.0, spans), 0..13, 0..14);
        let white: f64 = triangle.iter().flatten().map(|&v| f64::from(v) / 255.0).sum();
        assert!((white - (13.0 * 14.0 - 32.0)).abs() < 0.2, "{white}");
        assert_eq!(triangle[1], [255, 255, 0, 0, 0, 0, 0, 0, 0, 127, 255, 255, 255, 255]);
        let half = rows(|surface| surface.shape(-5..9, black, 0.5, |_| [[-3.0, 1.5]]), 8..10, 0..3);
        assert_eq!(half, [[127, 191, 255], [255; 3]]);
    }

    #[test]
    fn what_leaves_the_surface_is_cut_and_what_was_drawn_is_known() {
        let blank = Surface::new(14, 13, Color::new([255; 3]));
        let mut surface = blank.clone();
        let far = pixel([1e300, f64::NEG_INFINITY]);
        surface.polygon(&[Point::new(-5, 3), far, Point::new(20, 5)], Color::new([1; 3]));
        surface.disc(Point::new(13, 12), 6, Color::new([2; 3]));
        assert_eq!(surface.row(12)[13].rgb(), [2; 3]);
        for y in 0..13 {
            let drawn = surface.drawn(y);
            let differs = |x: &usize| surface.row(y)[*x] != blank.row(y)[*x];
            assert!((0..14).filter(differs).all(|x| drawn.contains(&x)), "row {y}");
        }
        surface.restore(&blank);
        assert!((0..13).all(|y| surface.row(y) == blank.row(y) && surface.drawn(y).is_empty()));
    }
}
