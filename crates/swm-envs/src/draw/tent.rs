//! From a picture to one of another size: the area filter of the reference's wrapper (Pillow's `BILINEAR`), a tent as
//! wide as two pixels of the coarser of the two, in the same fixed-point arithmetic.

use super::Area;
use std::ops::Range;

/// Bits behind the point of a weight.
const BITS: u32 = 22;

/// What each pixel along one side of the new picture is made of.
#[derive(Clone, Debug)]
struct Axis {
    /// The first pixel of the old picture.
    first: Vec<usize>,
    /// Where its weights begin, and, at the end, how many there are in all.
    start: Vec<usize>,
    weights: Vec<i32>,
}

impl Axis {
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
    fn new(from: usize, to: usize) -> Self {
        let scale = from as f64 / to as f64;
        let reach = scale.max(1.0);
        let mut axis = Self { first: vec![], start: vec![0], weights: vec![] };
        for i in 0..to {
            let center = (i as f64 + 0.5) * scale;
            let first = (center - reach + 0.5).max(0.0) as usize;
            let last = ((center + reach + 0.5) as usize).min(from);
            let tent = |j: usize| (1.0 - ((j as f64 + 0.5 - center) / reach).abs()).max(0.0);
            let sum: f64 = (first..last).map(tent).sum();
            axis.weights.extend((first..last).map(|j| (tent(j) / sum * f64::from(1 << BITS) + 0.5) as i32));
            axis.first.push(first);
            axis.start.push(axis.weights.len());
        }
        axis
    }

    fn len(&self) -> usize {
        self.first.len()
    }

    fn weights(&self, i: usize) -> &[i32] {
        &self.weights[self.start[i]..self.start[i + 1]]
    }

    /// The old pixels that pixel `i` is made of.
    fn source(&self, i: usize) -> Range<usize> {
        self.first[i]..self.first[i] + self.weights(i).len()
    }

    /// The new pixels that some of the old ones show up in.
    fn touched(&self, old: &Range<usize>) -> Range<usize> {
        if old.is_empty() {
            return 0..0;
        }
        let places = || 0..self.len();
        let from = places().find(|&i| self.source(i).end > old.start).unwrap_or(self.len());
        let to = places().rev().find(|&i| self.source(i).start < old.end).map_or(from, |i| i + 1);
        from..to
    }
}

/// Resizes square pictures of one size to another size.
#[derive(Clone, Debug)]
pub struct Tent {
    side: usize,
    columns: Axis,
    rows: Axis,
    /// The rows of the old picture, resized along x.
    between: Vec<u8>,
    /// A row of the new picture, before it is rounded.
    sums: Vec<i32>,
}

impl Tent {
    /// From `side`² to `width` x `height`.
    pub fn new(side: usize, width: usize, height: usize) -> Self {
        let (columns, rows) = (Axis::new(side, width), Axis::new(side, height));
        Self { side, columns, rows, between: vec![0; width * side * 3], sums: Vec::with_capacity(3 * width) }
    }

    /// Width and height of the new pictures.
    pub fn size(&self) -> (usize, usize) {
        (self.columns.len(), self.rows.len())
    }

    /// Draws the part of the new picture that an area of the old one shows up in.
    pub fn draw(&mut self, old: &[u8], area: Area, new: &mut [u8]) {
        let (columns, rows) = area.within(self.side);
        let (columns, rows) = (self.columns.touched(&columns), self.rows.touched(&rows));
        if columns.is_empty() || rows.is_empty() {
            return;
        }
        let width = self.columns.len();
        let span = 3 * columns.start..3 * columns.end;
        let source = self.rows.source(rows.start).start..self.rows.source(rows.end - 1).end;
        let line = |y: usize| &old[3 * y * self.side..][..3 * self.side];
        for y in source.clone() {
            let (above, here) = self.between.split_at_mut(3 * y * width);
            if y > source.start && line(y) == line(y - 1) {
                here[span.clone()].copy_from_slice(&above[above.len() - 3 * width..][span.clone()]);
                continue;
            }
            let (line, here) = (line(y).as_chunks::<3>().0, here.as_chunks_mut::<3>().0);
            for x in columns.clone() {
                let mut sum = [HALF; 3];
                for (&weight, pixel) in self.columns.weights(x).iter().zip(&line[self.columns.first[x]..]) {
                    (0..3).for_each(|c| sum[c] += weight * i32::from(pixel[c]));
                }
                here[x] = sum.map(rounded);
            }
        }
        self.sums.resize(span.len(), 0);
        for y in rows {
            self.sums.fill(HALF);
            for (k, &weight) in self.rows.weights(y).iter().enumerate() {
                let line = &self.between[3 * (self.rows.first[y] + k) * width..][span.clone()];
                self.sums.iter_mut().zip(line).for_each(|(sum, &value)| *sum += weight * i32::from(value));
            }
            let new = &mut new[3 * y * width..][span.clone()];
            new.iter_mut().zip(&self.sums).for_each(|(new, &sum)| *new = rounded(sum));
        }
    }
}

/// One half, in units of a sum.
const HALF: i32 = 1 << (BITS - 1);

/// The byte of a sum that began with [`HALF`].
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn rounded(sum: i32) -> u8 {
    (sum >> BITS).clamp(0, 255) as u8
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
        assert_eq!(red(4, 3, all), PILLOW_4_3);
        assert_eq!(red(2, 8, all), PILLOW_2_8);
        // A part is drawn as in the whole, and nothing else.
        let part = red(4, 3, Area::EMPTY.with(crate::draw::Point::new(0, 0), 0));
        assert!(part.iter().zip(PILLOW_4_3).all(|(&a, b)| a == 7 || a == b));
        assert_eq!((part[0], part[11]), (PILLOW_4_3[0], 7));
    }

    const PILLOW_4_3: [u8; 12] = [25, 77, 130, 182, 91, 139, 168, 156, 112, 151, 119, 136];
    const PILLOW_2_8: [u8; 16] = [46, 139, 53, 146, 69, 162, 97, 182, 138, 175, 173, 122, 143, 116, 65, 158];
}
