//! [`Pixels`]: a square RGB image and anti-aliased shapes to draw into it, as matplotlib draws them.

use super::{Area, Point};
use std::ops::Range;

/// A colour: red, green and blue.
pub type Rgb = [u8; 3];

/// Returns the rectangle of pixels from `low` (column, row), included, to `high`, excluded.
pub fn rect(low: [i32; 2], high: [i32; 2]) -> Area {
    Area::EMPTY.with(Point::new(low[0], low[1]), 0).with(Point::new(high[0] - 1, high[1] - 1), 0)
}

/// A square RGB image. Coordinates are in pixels from its upper left corner, so the centre of the first pixel is (½,
/// ½).
pub struct Pixels<'a> {
    side: usize,
    rgb: &'a mut [u8],
}

impl<'a> Pixels<'a> {
    /// Makes an image of `side`² pixels over `rgb`, `[side, side, 3]`.
    pub fn new(side: usize, rgb: &'a mut [u8]) -> Self {
        debug_assert_eq!(rgb.len(), side * side * 3);
        Self { side, rgb }
    }

    /// All bytes, `[side, side, 3]`.
    pub fn bytes(&mut self) -> &mut [u8] {
        self.rgb
    }

    /// Fills a rectangle of whole pixels.
    pub fn fill(&mut self, area: Area, color: Rgb) {
        let (columns, rows) = area.within(self.side);
        let first = rows.start * self.side;
        for y in rows {
            if y * self.side == first {
                self.span(y, columns.clone()).fill(color);
            } else {
                // Copying a row is faster than filling it with three bytes at a time.
                let from = 3 * (first + columns.start)..3 * (first + columns.end.max(columns.start));
                self.rgb.copy_within(from, 3 * (y * self.side + columns.start));
            }
        }
    }

    /// Blends a colour over a rectangle of whole pixels.
    pub fn tint(&mut self, area: Area, color: Rgb, opacity: f64) {
        let (columns, rows) = area.within(self.side);
        for y in rows {
            self.span(y, columns.clone()).iter_mut().for_each(|pixel| mix(pixel, color, opacity));
        }
    }

    /// Blends a filled circle into the part of the image inside `clip`. The coverage of a pixel follows from the
    /// distance of its centre to the circle.
    pub fn circle(&mut self, [cx, cy]: [f64; 2], radius: f64, color: Rgb, opacity: f64, clip: Area) {
        let (columns, rows) = clip.within(self.side);
        let cut = |v: f64, within: &Range<usize>| (v.max(0.0) as usize).clamp(within.start, within.end);
        let (outer, inner) = (radius + 0.5, (radius - 0.5).max(0.0));
        // Half the chord of a circle of this radius, in a row `dy` from its centre.
        let reach = |radius: f64, dy: f64| (radius * radius - dy * dy).max(0.0).sqrt();
        for y in cut((cy - outer).floor(), &rows)..cut((cy + outer).ceil(), &rows) {
            let dy = y as f64 + 0.5 - cy;
            let (far, near) = (reach(outer, dy), reach(inner, dy));
            let (left, right) = (cut((cx - far).floor(), &columns), cut((cx + far).ceil(), &columns));
            // Pixels whose centre is within the inner circle are covered completely.
            let (first, last) = if near > 0.0 {
                let first = cut((cx - near + 0.5).floor(), &(left..right));
                (first, cut((cx + near + 0.5).floor(), &(first..right)))
            } else {
                (right, right)
            };
            let row = self.span(y, left..right);
            let mut blend_edge = |x: usize| {
                let dx = x as f64 + 0.5 - cx;
                let covered = outer - (dx * dx + dy * dy).sqrt();
                mix(&mut row[x - left], color, opacity * covered.clamp(0.0, 1.0));
            };
            (left..first).for_each(&mut blend_edge);
            (last..right).for_each(&mut blend_edge);
            if opacity < 1.0 {
                row[first - left..last - left].iter_mut().for_each(|pixel| mix(pixel, color, opacity));
            } else {
                row[first - left..last - left].fill(color);
            }
        }
    }

    /// Returns an area that contains every pixel of a circle.
    pub fn circle_bounds([cx, cy]: [f64; 2], radius: f64) -> Area {
        Area::EMPTY.with(Point::nearest(cx, cy), radius.ceil() as i32 + 1)
    }

    /// Blends a filled polygon into the image. The coverage of a pixel is the share of its area that lies inside.
    pub fn polygon(&mut self, corners: &[[f64; 2]], color: Rgb, opacity: f64) {
        let side = self.side as f64;
        let bound = |axis: usize, pick: fn(f64, f64) -> f64| {
            corners.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0).clamp(0.0, side)
        };
        let columns = bound(0, f64::min) as usize..bound(0, f64::max).ceil() as usize;
        let rows = bound(1, f64::min) as usize..bound(1, f64::max).ceil() as usize;
        // For each pixel, the coverage that the edges add to the pixel itself and to every pixel right of it.
        let mut added = vec![[0.0; 2]; columns.len()];
        for y in rows {
            added.fill([0.0; 2]);
            for (i, &from) in corners.iter().enumerate() {
                let to = corners[(i + 1) % corners.len()];
                add_edge(&mut added, &columns, from, to, y as f64);
            }
            let mut right = 0.0;
            for (pixel, [here, beyond]) in self.span(y, columns.clone()).iter_mut().zip(&added) {
                mix(pixel, color, opacity * (right + here).abs().min(1.0));
                right += beyond;
            }
        }
    }

    /// The pixels of one row within some columns.
    fn span(&mut self, y: usize, columns: Range<usize>) -> &mut [Rgb] {
        let row = &mut self.rgb.as_chunks_mut::<3>().0[y * self.side..][..self.side];
        &mut row[columns.start.min(columns.end)..columns.end]
    }
}

/// Blends a share of `color` over a pixel.
fn mix(pixel: &mut Rgb, color: Rgb, share: f64) {
    for (under, over) in pixel.iter_mut().zip(color) {
        *under = (f64::from(*under) + (f64::from(over) - f64::from(*under)) * share + 0.5) as u8;
    }
}

/// Adds the coverage by the part of an edge in the row from `top` to `top + 1`.
///
/// Every pixel that the edge crosses gets two values: the signed area of the pixel right of the edge, and the signed
/// height of the edge within the pixel, which is the coverage of all pixels further right.
fn add_edge(added: &mut [[f64; 2]], columns: &Range<usize>, from: [f64; 2], to: [f64; 2], top: f64) {
    let (low, high, sign) = if from[1] < to[1] { (from, to, 1.0) } else { (to, from, -1.0) };
    let (y0, y1) = (low[1].max(top), high[1].min(top + 1.0));
    if y0 >= y1 {
        return;
    }
    let slope = (high[0] - low[0]) / (high[1] - low[1]);
    let at = |y: f64| low[0] + (y - low[1]) * slope - columns.start as f64;
    let [x0, x1] = [at(y0).min(at(y1)), at(y0).max(at(y1))].map(|x| x.clamp(0.0, columns.len() as f64));
    let height = (y1 - y0) * sign;
    let (first, end) = (x0 as usize, (x1.ceil() as usize).max(x0 as usize + 1));
    for (i, [here, beyond]) in added.iter_mut().enumerate().take(end).skip(first) {
        let (left, right) = (x0.max(i as f64), x1.min(i as f64 + 1.0));
        let share = if x1 > x0 { (right - left) / (x1 - x0) } else { 1.0 };
        *here += height * share * (i as f64 + 1.0 - (left + right) / 2.0);
        *beyond += height * share;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn painted(side: usize, paint: impl Fn(&mut Pixels<'_>)) -> Vec<u8> {
        let mut rgb = vec![0; side * side * 3];
        paint(&mut Pixels::new(side, &mut rgb));
        rgb.chunks(3).map(|pixel| pixel[0]).collect()
    }

    fn area_of(image: &[u8]) -> f64 {
        image.iter().map(|&v| f64::from(v) / 255.0).sum()
    }

    #[test]
    fn polygon_coverage_is_the_area_inside() {
        let square = [[1.25, 1.0], [3.5, 1.0], [3.5, 2.5], [1.25, 2.5]];
        let image = painted(5, |pixels| pixels.polygon(&square, [255; 3], 1.0));
        assert_eq!(image[5..10], [0, 191, 255, 128, 0]);
        assert_eq!(image[10..15], [0, 96, 128, 64, 0]);
        let turned =
            painted(5, |pixels| pixels.polygon(&[[2.5, 0.5], [4.5, 2.5], [2.5, 4.5], [0.5, 2.5]], [255; 3], 1.0));
        assert!((area_of(&turned) - 8.0).abs() < 0.05, "{turned:?}");
        assert_eq!((turned[12], turned[0]), (255, 0));
        // Parts outside the image are clipped.
        let cut =
            painted(4, |pixels| pixels.polygon(&[[-3.0, -3.0], [2.0, -3.0], [2.0, 9.0], [-3.0, 9.0]], [255; 3], 1.0));
        assert_eq!(cut, [255, 255, 0, 0].repeat(4));
    }

    #[test]
    fn circle_coverage_adds_up_to_the_area() {
        for (x, y, radius) in [(20.0, 20.0, 10.0), (19.3, 20.7, 5.2), (15.5, 15.5, 2.7), (22.1, 18.0, 14.9)] {
            let all = Area::square(40);
            let image = painted(40, |pixels| pixels.circle([x, y], radius, [255; 3], 1.0, all));
            let expected = std::f64::consts::PI * radius * radius;
            assert!((area_of(&image) / expected - 1.0).abs() < 0.02 + 0.2 / expected, "radius {radius}");
            let half = painted(40, |pixels| pixels.circle([x, y], radius, [255; 3], 0.5, all));
            assert!((area_of(&half) / expected - 0.5).abs() < 0.02, "radius {radius}, half opaque");
            let bounds = Pixels::circle_bounds([x, y], radius);
            assert_eq!(image, painted(40, |pixels| pixels.circle([x, y], radius, [255; 3], 1.0, bounds)));
        }
        let outside = painted(8, |pixels| pixels.circle([-50.0, 4.0], 3.0, [255; 3], 1.0, Area::square(8)));
        assert_eq!(area_of(&outside), 0.0);
    }
}
