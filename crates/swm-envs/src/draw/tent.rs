//! From a picture to one of another size: the area filter of the reference's wrapper (Pillow's `BILINEAR`), a tent as
//! wide as two pixels of the coarser of the two pictures.
//!
//! The mean is taken along y first, where it runs over whole rows, and rounded once at the end. Pillow rounds between the
//! two directions, so single bytes may differ by 1.

use super::Area;
use std::ops::Range;

/// What each pixel along one side of the new picture is made of.
#[derive(Clone, Debug, Default)]
pub struct Axis {
    /// The first pixel of the old picture, and the one behind the last.
    first: Vec<usize>,
    end: Vec<usize>,
    /// Where its weights begin.
    start: Vec<usize>,
    weights: Vec<f32>,
}

impl Axis {
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
    fn new(from: usize, to: usize) -> Self {
        let scale = from as f64 / to as f64;
        let reach = scale.max(1.0);
        let mut axis = Self::default();
        for i in 0..to {
            let center = (i as f64 + 0.5) * scale;
            let source = (center - reach + 0.5).max(0.0) as usize..((center + reach + 0.5) as usize).min(from);
            let tent = |j: usize| (1.0 - ((j as f64 + 0.5 - center) / reach).abs()).max(0.0);
            let sum: f64 = source.clone().map(tent).sum();
            axis.first.push(source.start);
            axis.end.push(source.end);
            axis.start.push(axis.weights.len());
            axis.weights.extend(source.map(|j| (tent(j) / sum) as f32));
        }
        axis
    }

    fn len(&self) -> usize {
        self.first.len()
    }

    /// The old pixels that pixel `i` is made of.
    fn source(&self, i: usize) -> Range<usize> {
        self.first[i]..self.end[i]
    }

    fn weights(&self, i: usize) -> &[f32] {
        &self.weights[self.start[i]..][..self.source(i).len()]
    }

    /// The new pixels that some of the old ones show up in.
    pub fn touched(&self, old: &Range<usize>) -> Range<usize> {
        let from = self.end.partition_point(|&end| end <= old.start);
        from..self.first.partition_point(|&first| first < old.end).max(from)
    }

    /// What pixel `i` shows of numbers along the old side; those outside of `values`, which begin at `start`, are 0.
    pub fn mean(&self, i: usize, values: &[f32], start: usize) -> f32 {
        let shares = self.source(i).zip(self.weights(i));
        shares.map(|(j, weight)| weight * j.checked_sub(start).and_then(|j| values.get(j)).unwrap_or(&0.0)).sum()
    }
}

/// Resizes square pictures of one size to another size.
#[derive(Clone, Debug)]
pub struct Tent {
    side: usize,
    columns: Axis,
    rows: Axis,
    /// A row of the new picture, before it is resized along x.
    line: Vec<f32>,
}

impl Tent {
    /// From `side`² to `width` x `height`.
    pub fn new(side: usize, width: usize, height: usize) -> Self {
        let (columns, rows) = (Axis::new(side, width), Axis::new(side, height));
        Self { side, columns, rows, line: Vec::with_capacity(3 * side) }
    }

    /// Width and height of the new pictures.
    pub fn size(&self) -> (usize, usize) {
        (self.columns.len(), self.rows.len())
    }

    /// What it does along x and along y.
    pub fn axes(&self) -> [&Axis; 2] {
        [&self.columns, &self.rows]
    }

    /// Draws the part of the new picture that an area of the old one shows up in.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn draw(&mut self, old: &[u8], area: Area, new: &mut [u8]) {
        let (columns, rows) = area.within(self.side);
        let (columns, rows) = (self.columns.touched(&columns), self.rows.touched(&rows));
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let left = self.columns.first[columns.start];
        let wide = self.columns.end[columns.end - 1] - left;
        self.line.resize(3 * wide, 0.0);
        for y in rows {
            self.line.fill(0.0);
            for (k, &weight) in self.rows.source(y).zip(self.rows.weights(y)) {
                let old = &old[3 * (k * self.side + left)..][..3 * wide];
                self.line.iter_mut().zip(old).for_each(|(sum, &value)| *sum += weight * f32::from(value));
            }
            let line = self.line.as_chunks::<3>().0;
            let new = &mut new.as_chunks_mut::<3>().0[y * self.columns.len()..];
            for x in columns.clone() {
                let mut sum = [0.5; 3];
                for (&weight, pixel) in self.columns.weights(x).iter().zip(&line[self.columns.first[x] - left..]) {
                    (0..3).for_each(|c| sum[c] += weight * pixel[c]);
                }
                new[x] = sum.map(|v| v as u8);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_what_pillow_makes_of_them() {
        // The red channel of a picture of 6 x 6, (x * 37 + y * y * 11) % 256, as
        // Image.fromarray(picture).resize((4, 3), Image.BILINEAR) and (2, 8) give it.
        let old: Vec<u8> = (0..36).flat_map(|i| [((i % 6 * 37 + (i / 6) * (i / 6) * 11) % 256) as u8, 0, 0]).collect();
        let red = |width: usize, height: usize, area: Area| {
            let mut new = vec![7; width * height * 3];
            Tent::new(6, width, height).draw(&old, area, &mut new);
            new.chunks(3).map(|pixel| pixel[0]).collect::<Vec<_>>()
        };
        let all = Area::square(6);
        let near = |got: &[u8], wanted: &[u8]| got.iter().zip(wanted).all(|(a, b)| a.abs_diff(*b) <= 1);
        let (whole, other) = (red(4, 3, all), red(2, 8, all));
        assert!(near(&whole, &PILLOW_4_3), "{whole:?}");
        assert!(near(&other, &PILLOW_2_8), "{other:?}");
        // A part is drawn as in the whole, and nothing else.
        let part = red(4, 3, Area::EMPTY.with(crate::draw::Point::new(0, 0), 0));
        assert!(part.iter().zip(&whole).all(|(a, b)| *a == 7 || a == b));
        assert_eq!((part[0], part[11]), (whole[0], 7));
    }

    const PILLOW_4_3: [u8; 12] = [25, 77, 130, 182, 91, 139, 168, 156, 112, 151, 119, 136];
    const PILLOW_2_8: [u8; 16] = [46, 139, 53, 146, 69, 162, 97, 182, 138, 175, 173, 122, 143, 116, 65, 158];
}
