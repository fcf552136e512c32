//! The shapes of SDL_gfx, with anti-aliased outlines: lines, polygons, discs, and shapes given by horizontal spans.

use super::surface::{Color, NONE, Surface};
use crate::draw::Point;
use std::ops::Range;

/// Horizontal lines per row of pixels at which the spans of a shape are evaluated.
const LINES: usize = 4;
/// The maximal number of corners of a polygon.
const MAX_CORNERS: usize = 4;

impl Surface {
    /// Draws an anti-aliased line between pixels: every step is shared between the two nearest pixels (Wu 1991).
    fn smooth_line(&mut self, from: Point, to: Point, color: Color) {
        let (a, b) = if from.y <= to.y { (from, to) } else { (to, from) };
        let (width, height, side) = ((b.x - a.x).abs(), b.y - a.y, (b.x - a.x).signum());
        if height == 0 {
            return self.horizontal_line(a.y, a.x, b.x, color);
        }
        if width == 0 {
            return self.vertical_line(a.x, a.y, b.y, color);
        }
        if width == height {
            return (0..=width).for_each(|i| self.horizontal_line(a.y + i, a.x + i * side, a.x + i * side, color));
        }
        for end in [from, to] {
            self.horizontal_line(end.y, end.x, end.x, color);
        }
        let flat = width > height;
        let (steps, rise) = if flat { (width, height) } else { (height, width) };
        // The offset across the line per step, in 1/65536 pixel, rounded down.
        let slope = (i64::from(rise) << 16) / i64::from(steps);
        for i in 1..steps {
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

    /// Draws an anti-aliased line between points with fractional coordinates. Every step along its major axis is shared
    /// between the two nearest pixels; the pixels at the ends are covered in part.
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
            for (offset, share) in [(1, share), (0, 1.0 - share)] {
                let across = across as i32 + offset;
                let at = if steep { Point::new(across, step) } else { Point::new(step, across) };
                self.blend_share(at, color, (share * covered) as f32);
            }
        }
    }

    /// Fills a shape on some rows. `spans` returns the intervals in which the shape crosses the horizontal line at a
    /// height. The coverage of a pixel is the mean over [`LINES`] heights, at most 1; overlapping spans count
    /// repeatedly.
    pub fn fill_spans<const N: usize>(
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
                    self.blend_share(Point::new(x as i32, y), color, share);
                }
            }
        }
    }

    /// Fills a polygon of up to [`MAX_CORNERS`] corners and anti-aliases its outline.
    pub fn polygon(&mut self, corners: &[Point], color: Color) {
        let sides = || corners.iter().zip(corners[1..].iter().chain(&corners[..1])).map(|(&a, &b)| (a, b));
        sides().for_each(|(a, b)| self.smooth_line(a, b, color));
        let (low, high) = corners.iter().fold((i32::MAX, i32::MIN), |(low, high), p| (low.min(p.y), high.max(p.y)));
        let last = self.drawn.len() as i32 - 1;
        for y in low.max(0)..=high.min(last) {
            // The columns at which the sides cross this row, in 1/65536 pixel. A side includes its lower end; the
            // topmost sides also include their upper end.
            let mut crossings = [0; MAX_CORNERS];
            let mut count = 0;
            for (a, b) in sides() {
                let (a, b) = if a.y < b.y { (a, b) } else { (b, a) };
                if (a.y..b.y).contains(&y) || (y == high && a.y < y && y == b.y) {
                    let along = (i64::from(y - a.y) << 16) / i64::from(b.y - a.y);
                    let at = along * i64::from(b.x - a.x) + (i64::from(a.x) << 16);
                    let slot = crossings[..count].partition_point(|&crossing| crossing <= at);
                    crossings.copy_within(slot..count, slot + 1);
                    crossings[slot] = at;
                    count += 1;
                }
            }
            let nearest = |at: i64| ((at + (1 << 15)) >> 16) as i32;
            for pair in crossings[..count].chunks_exact(2) {
                self.horizontal_line(y, nearest(pair[0] + 1), nearest(pair[1] - 1), color);
            }
        }
    }

    /// Fills a disc and anti-aliases its outline.
    pub fn disc(&mut self, centre: Point, radius: i32, color: Color) {
        self.smooth_circle(centre, radius, color);
        // The midpoint algorithm. The outer rows are filled at the first step of the circle in each row.
        let (mut decision, mut x, mut y, mut row) = (1 - radius, 0, radius, radius + 1);
        while x <= y {
            if row != y {
                self.horizontal_line(centre.y + y, centre.x - x, centre.x + x, color);
                self.horizontal_line(centre.y - y, centre.x - x, centre.x + x, color);
                row = y;
            }
            if x < y {
                self.horizontal_line(centre.y - x, centre.x - y, centre.x + y, color);
                self.horizontal_line(centre.y + x, centre.x - y, centre.x + y, color);
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

    /// Draws an anti-aliased circle: from bottom and top outwards to the diagonal, then on to the sides. Every step is
    /// shared between the two pixels nearest to the exact circle.
    ///
    /// `off` is r² - x² - y², which is positive inside the circle. Divided by 2y (or 2x) it approximates the distance
    /// to the circle along y (or x), in pixels.
    fn smooth_circle(&mut self, centre: Point, radius: i32, color: Color) {
        let steps = (f64::from(radius) * std::f64::consts::FRAC_1_SQRT_2).round_ties_even() as i32;
        for y in [-radius, radius] {
            self.horizontal_line(centre.y + y, centre.x, centre.x, color);
        }
        let (mut x, mut y, mut off) = (0, -radius, 0);
        // 2x and 2y determine the change of `off` by the next step along x and along y.
        let (mut twice_x, mut twice_y) = (0, -2 * radius);
        for _ in 0..steps {
            x -= 1;
            off += twice_x - 1;
            let neighbour = if off >= 0 {
                y - 1
            } else if off - twice_y > 1 && 2 * off - twice_y >= 1 {
                y + 1
            } else {
                let before = y;
                let is_past = off - twice_y > 1;
                y += 1;
                off -= twice_y + 1;
                twice_y += 2;
                if is_past { before } else { y + 1 }
            };
            twice_x -= 2;
            let weight = neighbour_share(off, twice_y);
            self.mirrored(centre, [x, y], color, 255 - weight);
            self.mirrored(centre, [x, neighbour], color, weight);
        }
        for _ in 0..steps {
            y += 1;
            off -= twice_y + 1;
            let neighbour = if off <= 0 {
                x + 1
            } else if off + twice_x < 1 && 2 * off + twice_x <= 1 {
                x - 1
            } else {
                let before = x;
                let is_past = off + twice_x < 1;
                x -= 1;
                off += twice_x - 1;
                twice_x -= 2;
                if is_past { before } else { x - 1 }
            };
            twice_y += 2;
            let weight = neighbour_share(off, twice_x);
            self.mirrored(centre, [x, y], color, 255 - weight);
            self.mirrored(centre, [neighbour, y], color, weight);
        }
    }

    /// Blends a pixel and its mirror images in the other quadrants.
    fn mirrored(&mut self, centre: Point, [x, y]: [i32; 2], color: Color, weight: i32) {
        for (x, y) in [(-x, -y), (x, -y), (-x, y), (x, y)] {
            self.blend(Point::new(centre.x + x, centre.y + y), color, weight);
        }
    }
}

/// Returns the weight of the second of the two pixels that share a step of the circle, in 1/255.
fn neighbour_share(off: i32, slope: i32) -> i32 {
    if slope == 0 { 255 } else { ((off.abs() as f32 / slope.abs() as f32).min(1.0) * 255.0) as i32 }
}

#[cfg(test)]
mod tests {
    use super::super::surface::pixel;
    use super::*;

    /// Draws a black shape on white and returns some rows, the lowest first.
    fn rows(draw: impl FnOnce(&mut Surface), rows: Range<usize>, columns: Range<usize>) -> Vec<Vec<u8>> {
        let mut surface = Surface::new(14, 13, Color::new([255; 3]));
        draw(&mut surface);
        rows.map(|y| surface.row(y)[columns.clone()].iter().map(|color| color.rgb()[0]).collect()).collect()
    }

    #[test]
    fn discs_and_polygons_equal_those_of_pygame_gfxdraw() {
        // pygame 2.6.1: gfxdraw.aacircle and filled_circle at (6, 6), radius 4.
        let disc = rows(|surface| surface.disc(Point::new(6, 6), 4, Color::new([0; 3])), 2..7, 1..7);
        let expected = [
            [255, 255, 255, 129, 32, 0],
            [255, 255, 86, 0, 0, 0],
            [255, 129, 0, 0, 0, 0],
            [255, 0, 0, 0, 0, 0],
            [255, 0, 0, 0, 0, 0],
        ];
        assert_eq!(disc, expected);
        // gfxdraw.aapolygon and filled_polygon.
        let corners = [Point::new(2, 1), Point::new(11, 4), Point::new(8, 10), Point::new(1, 7)];
        let polygon = rows(|surface| surface.polygon(&corners, Color::new([0; 3])), 0..11, 1..12);
        let expected = [
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
        assert_eq!(polygon, expected);
    }

    #[test]
    fn span_coverage_is_the_area_inside() {
        // A triangle from (2, 1) to (10, 1) and (2, 9), and an overlapping square; coverage stays at most 1.
        let spans = |y: f64| match y {
            1.0..6.0 => [[2.0, 11.0 - y], [2.0, 4.0]],
            6.0..9.0 => [[2.0, 11.0 - y], [0.0; 2]],
            _ => [[0.0; 2]; 2],
        };
        let black = Color::new([0; 3]);
        let triangle = rows(|surface| surface.fill_spans(0..99, black, 1.0, spans), 0..13, 0..14);
        let white: f64 = triangle.iter().flatten().map(|&v| f64::from(v) / 255.0).sum();
        assert!((white - (13.0 * 14.0 - 32.0)).abs() < 0.2, "{white}");
        assert_eq!(triangle[1], [255, 255, 0, 0, 0, 0, 0, 0, 0, 127, 255, 255, 255, 255]);
        let half = rows(|surface| surface.fill_spans(-5..9, black, 0.5, |_| [[-3.0, 1.5]]), 8..10, 0..3);
        assert_eq!(half, [[127, 191, 255], [255; 3]]);
    }

    #[test]
    fn shapes_are_clipped_and_drawn_columns_recorded() {
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
