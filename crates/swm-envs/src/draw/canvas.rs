//! [`Canvas`]: an image of palette indices, with shapes that cover the same pixels as those of pygame 2.6.

use std::ops::Range;

/// A pixel by column and row; it may lie outside the canvas.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// Column.
    pub x: i32,
    /// Row.
    pub y: i32,
}

/// Coordinates are clipped to this magnitude, far outside any canvas, so that no arithmetic overflows.
const COORDINATE_LIMIT: f64 = 8192.0;

impl Point {
    /// Makes the pixel at column `x` and row `y`.
    pub const fn new(x: i32, y: i32) -> Self {
        Self { x, y }
    }

    /// Returns the pixel nearest to a point; halves round to even.
    pub fn nearest(x: f64, y: f64) -> Self {
        let whole = |v: f64| v.round_ties_even().clamp(-COORDINATE_LIMIT, COORDINATE_LIMIT) as i32;
        Self { x: whole(x), y: whole(y) }
    }

    fn shifted(self, x: i32, y: i32) -> Self {
        Self { x: self.x + x, y: self.y + y }
    }
}

/// A rectangle of pixels from the corner `low`, included, to the corner `high`, excluded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Area {
    low: Point,
    high: Point,
}

impl Area {
    /// The empty area.
    pub const EMPTY: Self = Self { low: Point::new(i32::MAX, i32::MAX), high: Point::new(i32::MIN, i32::MIN) };

    /// Returns the smallest area that also contains the pixels within `reach` of `point`.
    #[must_use]
    pub fn with(self, point: Point, reach: i32) -> Self {
        Self {
            low: Point::new(self.low.x.min(point.x - reach), self.low.y.min(point.y - reach)),
            high: Point::new(self.high.x.max(point.x + reach + 1), self.high.y.max(point.y + reach + 1)),
        }
    }

    /// Returns the area of a canvas of `side`² pixels.
    pub const fn square(side: usize) -> Self {
        Self { low: Point::new(0, 0), high: Point::new(side as i32, side as i32) }
    }

    /// Returns whether two areas have a pixel in common.
    pub fn touches(self, other: Self) -> bool {
        self.low.x < other.high.x && other.low.x < self.high.x && self.low.y < other.high.y && other.low.y < self.high.y
    }

    /// Returns the columns and rows that lie inside a canvas of `side`² pixels.
    pub fn within(self, side: usize) -> (Range<usize>, Range<usize>) {
        let cut = |v: i32| v.clamp(0, side as i32) as usize;
        (cut(self.low.x)..cut(self.high.x), cut(self.low.y)..cut(self.high.y))
    }
}

/// A colour for every index. Colours of blended pixels are added while drawing and dropped by
/// [`Palette::drop_blended`].
#[derive(Clone, Debug)]
pub struct Palette {
    colors: [[u8; 3]; 256],
    fixed: usize,
    used: usize,
}

impl Palette {
    /// Makes a palette whose indices 0, 1, … are these colours.
    pub fn new<const N: usize>(colors: &[[u8; 3]; N]) -> Self {
        let mut all = [[0; 3]; 256];
        all[..N].copy_from_slice(colors);
        Self { colors: all, fixed: N, used: N }
    }

    /// The colour of an index.
    pub fn color(&self, index: u8) -> [u8; 3] {
        self.colors[usize::from(index)]
    }

    /// Drops the colours of blended pixels.
    pub fn drop_blended(&mut self) {
        self.used = self.fixed;
    }

    /// Returns the index of `color` blended over the colour of index `under` with an opacity from 0 to 1; `under`
    /// itself when all indices are in use.
    fn blended(&mut self, color: [u8; 3], opacity: f32, under: u8) -> u8 {
        let below = self.color(under);
        let Some(slot) = self.colors.get_mut(self.used) else { return under };
        *slot = std::array::from_fn(|i| (f32::from(color[i]) * opacity + f32::from(below[i]) * (1.0 - opacity)) as u8);
        self.used += 1;
        (self.used - 1) as u8
    }
}

/// A square of palette indices.
#[derive(Clone, Debug)]
pub struct Canvas {
    side: usize,
    pixels: Vec<u8>,
}

impl Canvas {
    /// Makes a canvas of `side`² pixels with index 0.
    pub fn new(side: usize) -> Self {
        Self { side, pixels: vec![0; side * side] }
    }

    /// The number of pixels along a side.
    pub fn side(&self) -> usize {
        self.side
    }

    /// The indices of one row.
    pub fn row(&self, y: usize) -> &[u8] {
        &self.pixels[y * self.side..][..self.side]
    }

    /// Sets every pixel to `index`.
    pub fn clear(&mut self, index: u8) {
        self.pixels.fill(index);
    }

    /// Copies an area from another canvas of the same size.
    pub fn copy_area(&mut self, from: &Self, area: Area) {
        let (columns, rows) = area.within(self.side);
        for y in rows {
            let start = y * self.side;
            let row = start + columns.start..start + columns.end;
            self.pixels[row.clone()].copy_from_slice(&from.pixels[row]);
        }
    }

    /// Fills the pixels of a row from `x0` to `x1`, both included, in either order.
    fn span(&mut self, y: i32, x0: i32, x1: i32, index: u8) {
        let last = self.side as i32 - 1;
        let (from, to) = (x0.min(x1).max(0), x0.max(x1).min(last));
        if (0..=last).contains(&y) && from <= to {
            let start = y as usize * self.side;
            self.pixels[start + from as usize..=start + to as usize].fill(index);
        }
    }

    /// Fills a polygon of up to [`MAX_CORNERS`] corners.
    ///
    /// Each row is filled between pairs of edge crossings, both rounded down. An edge includes its upper end and
    /// excludes its lower end, except in the polygon's last row. Horizontal edges are drawn completely.
    pub fn fill_polygon(&mut self, corners: &[Point], index: u8) {
        let (top, bottom) = corners.iter().fold((i32::MAX, i32::MIN), |(a, b), p| (a.min(p.y), b.max(p.y)));
        if top == bottom {
            let (left, right) = corners.iter().fold((i32::MAX, i32::MIN), |(a, b), p| (a.min(p.x), b.max(p.x)));
            self.span(top, left, right, index);
            return;
        }
        let (first, last) = (top.max(0), bottom.min(self.side as i32 - 1));
        let mut edges = [Edge::default(); MAX_CORNERS];
        let mut count = 0;
        let around = |i: usize| (corners[if i == 0 { corners.len() - 1 } else { i - 1 }], corners[i]);
        for (a, b) in (0..corners.len()).map(around) {
            if a.y != b.y && count < MAX_CORNERS {
                edges[count] = Edge::new(a, b, first, bottom);
                count += 1;
            }
        }
        for y in first..=last {
            let mut crossings = [0; MAX_CORNERS];
            let mut crossed = 0;
            for edge in &mut edges[..count] {
                if y >= edge.top && y < edge.end {
                    let at = edge.x;
                    edge.advance();
                    // Insertion sort, because there are few crossings.
                    let mut slot = crossed;
                    while slot > 0 && crossings[slot - 1] > at {
                        crossings[slot] = crossings[slot - 1];
                        slot -= 1;
                    }
                    crossings[slot] = at;
                    crossed += 1;
                }
            }
            for pair in crossings[..crossed].chunks_exact(2) {
                self.span(y, pair[0], pair[1], index);
            }
        }
        for (a, b) in (0..corners.len()).map(around) {
            if a.y == b.y && top < a.y && a.y < bottom {
                self.span(a.y, a.x, b.x, index);
            }
        }
    }

    /// Fills a circle by the midpoint algorithm.
    pub fn fill_circle(&mut self, centre: Point, radius: i32, index: u8) {
        let mut decision = 1 - radius;
        let (mut step_x, mut step_y) = (0, -2 * radius);
        let (mut x, mut y) = (0, radius);
        while x < y {
            if decision >= 0 {
                y -= 1;
                step_y += 2;
                decision += step_y;
            }
            x += 1;
            step_x += 2;
            decision += step_x + 1;
            if decision >= 0 {
                self.span(centre.y + y - 1, centre.x - x, centre.x + x - 1, index);
                self.span(centre.y - y, centre.x - x, centre.x + x - 1, index);
            }
            self.span(centre.y + x - 1, centre.x - y, centre.x + y - 1, index);
            self.span(centre.y - x, centre.x - y, centre.x + y - 1, index);
        }
    }

    /// Draws a line of [`WIDTH`] with flat ends by Bresenham's algorithm. Its thickness lies along the minor axis.
    fn flat_line(&mut self, from: Point, to: Point, index: u8) {
        if from == to {
            return;
        }
        let (before, after) = (WIDTH / 2 - 1, WIDTH / 2);
        let (dx, dy) = ((to.x - from.x).abs(), (to.y - from.y).abs());
        let (step_x, step_y) = (if from.x < to.x { 1 } else { -1 }, if from.y < to.y { 1 } else { -1 });
        let steep = dx <= dy;
        let mut error = (if dx > dy { dx } else { -dy }) / 2;
        let mut at = from;
        for _ in 0..=dx.max(dy) {
            let first = if steep { at.shifted(-before, 0) } else { at.shifted(0, -before) };
            match self.strip(first, steep) {
                Some(start) if steep => {
                    self.pixels[start..start + WIDTH as usize].copy_from_slice(&[index; WIDTH as usize])
                }
                Some(start) => (0..WIDTH as usize).for_each(|k| self.pixels[start + k * self.side] = index),
                None if steep => self.span(at.y, first.x, at.x + after, index),
                None => (first.y..=at.y + after).for_each(|y| self.span(y, at.x, at.x, index)),
            }
            let previous = error;
            if previous > -dx {
                error -= dy;
                at.x += step_x;
            }
            if previous < dy {
                error += dx;
                at.y += step_y;
            }
        }
    }

    /// Returns the offset of a strip of [`WIDTH`] pixels from `first` to the right or down, if it lies on the canvas.
    fn strip(&self, first: Point, right: bool) -> Option<usize> {
        let (x, y) = (usize::try_from(first.x).ok()?, usize::try_from(first.y).ok()?);
        let (last_x, last_y) = if right { (x + WIDTH as usize - 1, y) } else { (x, y + WIDTH as usize - 1) };
        (last_x < self.side && last_y < self.side).then_some(y * self.side + x)
    }

    /// Draws a thick line of [`WIDTH`] with round ends. A line of length 0 is not drawn.
    ///
    /// The sides are computed from absolute coordinate differences, as in the reference's debug drawing. They are
    /// skewed if the line descends from left to right.
    pub fn thick_line(&mut self, from: Point, to: Point, index: u8) {
        let radius = WIDTH / 2;
        self.flat_line(from, to, index);
        let across = [(to.y - from.y).abs(), (to.x - from.x).abs()].map(f64::from);
        if across == [0.0, 0.0] {
            return;
        }
        let scale = f64::from(radius) / (across[0] * across[0] + across[1] * across[1]).sqrt();
        let [x, y] = across.map(|v| (v * scale).round_ties_even() as i32);
        self.fill_polygon(&[from.shifted(-x, -y), from.shifted(x, y), to.shifted(x, y), to.shifted(-x, -y)], index);
        self.fill_circle(from, radius, index);
        self.fill_circle(to, radius, index);
    }

    /// Draws an anti-aliased line, one pixel wide.
    pub fn fine_line(&mut self, from: Point, to: Point, color: [u8; 3], palette: &mut Palette) {
        let steep = (to.x - from.x).abs() < (to.y - from.y).abs();
        let flip = |p: Point| if steep { Point::new(p.y, p.x) } else { p };
        let (mut a, mut b) = (flip(from), flip(to));
        if a.x > b.x {
            std::mem::swap(&mut a, &mut b);
        }
        self.blend(flip(a), color, 1.0, palette);
        let slope = (b.y - a.y) as f32 / (b.x - a.x).max(1) as f32;
        let mut y = a.y as f32;
        for x in a.x + 1..b.x {
            y += slope;
            let above = y.floor();
            self.blend(flip(Point::new(x, above as i32)), color, 1.0 - (y - above), palette);
            if y > above {
                self.blend(flip(Point::new(x, above as i32 + 1)), color, y - above, palette);
            }
        }
        if b != a {
            self.blend(flip(b), color, 1.0, palette);
        }
    }

    fn blend(&mut self, at: Point, color: [u8; 3], opacity: f32, palette: &mut Palette) {
        let (Ok(x), Ok(y)) = (usize::try_from(at.x), usize::try_from(at.y)) else { return };
        if x < self.side && y < self.side {
            let pixel = &mut self.pixels[y * self.side + x];
            *pixel = palette.blended(color, opacity, *pixel);
        }
    }
}

/// The width of thick lines, in pixels.
pub const WIDTH: i32 = 4;
/// The maximal number of corners of a polygon.
const MAX_CORNERS: usize = 8;

/// An edge of a polygon, followed row by row in integer arithmetic.
#[derive(Clone, Copy, Default)]
struct Edge {
    top: i32,
    /// The row after the edge's last row.
    end: i32,
    /// The column at which the edge crosses the current row, rounded down.
    x: i32,
    /// The remainder of rounding `x`, in units of 1 / `height`.
    rest: i32,
    /// The change of `x` per row, rounded down.
    step: i32,
    /// The remainder of rounding `step`, in units of 1 / `height`.
    step_rest: i32,
    /// The number of rows that the edge crosses.
    height: i32,
}

impl Edge {
    /// Makes the edge between two corners, at the first of its rows that is not above row `first`. `bottom` is the last
    /// row of the polygon.
    fn new(a: Point, b: Point, first: i32, bottom: i32) -> Self {
        let (upper, lower) = if a.y < b.y { (a, b) } else { (b, a) };
        let (width, height) = (lower.x - upper.x, lower.y - upper.y);
        let skipped = (first - upper.y).max(0) * width;
        Self {
            top: upper.y,
            end: if lower.y == bottom { bottom + 1 } else { lower.y },
            x: upper.x + skipped.div_euclid(height),
            rest: skipped.rem_euclid(height),
            step: width.div_euclid(height),
            step_rest: width.rem_euclid(height),
            height,
        }
    }

    /// Moves the edge to the next row.
    fn advance(&mut self) {
        self.x += self.step;
        self.rest += self.step_rest;
        if self.rest >= self.height {
            self.x += 1;
            self.rest -= self.height;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the rows of the canvas as text.
    fn text(canvas: &Canvas) -> Vec<String> {
        (0..canvas.side()).map(|y| canvas.row(y).iter().map(|&p| if p == 0 { '.' } else { '#' }).collect()).collect()
    }

    #[test]
    fn filled_polygon_equals_that_of_pygame() {
        // pygame.draw.polygon(surface, 1, [(1, 1), (11, 4), (8, 14), (-2, 11)]), moved by 4 columns.
        let mut canvas = Canvas::new(18);
        canvas.fill_polygon(&[Point::new(5, 1), Point::new(15, 4), Point::new(12, 14), Point::new(2, 11)], 1);
        let expected = [
            "..................",
            ".....#............",
            "....#####.........",
            "....########......",
            "....############..",
            "...############...",
            "...############...",
            "...############...",
            "..############....",
            "..############....",
            "..############....",
            "..###########.....",
            ".....########.....",
            "........#####.....",
            "............#.....",
        ];
        assert_eq!(text(&canvas)[..expected.len()], expected);
    }

    #[test]
    fn shapes_are_clipped_to_the_canvas() {
        let mut canvas = Canvas::new(8);
        let far = Point::nearest(1e300, f64::NEG_INFINITY);
        canvas.fill_polygon(&[Point::new(-5, -5), Point::new(20, -5), Point::new(20, 20), Point::new(-5, 20)], 1);
        assert!(canvas.row(7).iter().all(|&p| p == 1));
        canvas.thick_line(Point::new(4, 4), far, 2);
        canvas.thick_line(far, far, 2);
        canvas.fill_circle(far, 30, 3);
        canvas.fine_line(far, Point::new(4, 4), [1, 2, 3], &mut Palette::new(&[[0; 3]; 4]));
        canvas.fill_circle(Point::new(0, 0), 3, 4);
        assert_eq!(canvas.row(0)[..4], [4, 4, 4, 1]);
    }
}
