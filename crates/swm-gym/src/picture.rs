//! Pictures at the size one asks for: environments draw at their own.
//!
//! A pixel is a mean of those below it, weighted by a tent, in the arithmetic of Pillow's `BILINEAR`: weights of 22 binary
//! digits, one direction after the other, bytes in between. Rows come first, as in Pillow from version 13 on; single
//! bytes of older versions differ by 1. Pixel art is not blended: each pixel is the nearest one, as in Pillow's `NEAREST`.

use swm_core::FrameMut;

/// Binary digits of a weight.
const DIGITS: u32 = 22;
/// What rounds to the nearest.
const HALF: i32 = 1 << (DIGITS - 1);

/// Scales pictures, keeping its tables between them.
pub struct Scaler {
    pixel_art: bool,
    columns: Axis,
    rows: Axis,
    /// A row of the new picture before it is narrowed: sums, then bytes.
    sums: Vec<i32>,
    line: Vec<u8>,
}

/// What the new pixels along one side are made of.
#[derive(Default)]
struct Axis {
    sides: (usize, usize),
    /// Of each new pixel, the first old one and where its weights begin and end.
    taps: Vec<(usize, usize, usize)>,
    weights: Vec<i32>,
}

impl Axis {
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn fit(&mut self, old: usize, new: usize, pixel_art: bool) {
        if self.sides == (old, new) {
            return;
        }
        self.sides = (old, new);
        self.taps.clear();
        self.weights.clear();
        let scale = old as f64 / new as f64;
        let reach = scale.max(1.0);
        for i in 0..new {
            let centre = (i as f64 + 0.5) * scale;
            let begin = self.weights.len();
            let first = if pixel_art {
                self.weights.push(1 << DIGITS);
                (centre as usize).min(old - 1)
            } else {
                let first = (centre - reach + 0.5).max(0.0) as usize;
                let below = first..((centre + reach + 0.5) as usize).min(old);
                let tent = |x: usize| (1.0 - ((x as f64 - centre + 0.5) / reach).abs()).max(0.0);
                let total: f64 = below.clone().map(tent).sum();
                self.weights.extend(below.map(|x| (tent(x) / total * f64::from(1 << DIGITS) + 0.5) as i32));
                first
            };
            self.taps.push((first, begin, self.weights.len()));
        }
    }

    /// Of each new pixel, the first old one and the weights.
    fn taps(&self) -> impl Iterator<Item = (usize, &[i32])> {
        self.taps.iter().map(|&(first, begin, end)| (first, &self.weights[begin..end]))
    }
}

/// A sum of weighted bytes as a byte; weights may add up to a hair more than 1.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn byte(sum: i32) -> u8 {
    (sum >> DIGITS).min(255) as u8
}

impl Scaler {
    /// One that blends, or one for pixel art.
    pub fn new(pixel_art: bool) -> Self {
        Self { pixel_art, columns: Axis::default(), rows: Axis::default(), sums: vec![], line: vec![] }
    }

    /// Draws an RGB picture of `[height, width]` into a frame of any size.
    pub fn draw(&mut self, [height, width]: [usize; 2], rgb: &[u8], frame: FrameMut<'_>) {
        if (frame.height, frame.width) == (height, width) {
            frame.rgb.copy_from_slice(rgb);
            return;
        }
        self.columns.fit(width, frame.width, self.pixel_art);
        self.rows.fit(height, frame.height, self.pixel_art);
        self.sums.resize(3 * width, 0);
        self.line.resize(3 * width, 0);
        for ((first, weights), new) in self.rows.taps().zip(frame.rgb.chunks_exact_mut(3 * frame.width)) {
            self.sums.fill(HALF);
            for (row, &weight) in rgb[3 * width * first..].chunks_exact(3 * width).zip(weights) {
                self.sums.iter_mut().zip(row).for_each(|(sum, &old)| *sum += i32::from(old) * weight);
            }
            self.line.iter_mut().zip(&self.sums).for_each(|(byte_of, &sum)| *byte_of = byte(sum));
            let line = self.line.as_chunks::<3>().0;
            for ((first, weights), pixel) in self.columns.taps().zip(new.as_chunks_mut::<3>().0) {
                let mut sum = [HALF; 3];
                for (old, &weight) in line[first..].iter().zip(weights) {
                    (0..3).for_each(|c| sum[c] += i32::from(old[c]) * weight);
                }
                *pixel = sum.map(byte);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The red channel of (x * 37 + y * y * 11) % 256 over 9 x 6 pixels, at another size.
    fn red(width: usize, height: usize, pixel_art: bool) -> Vec<u8> {
        let old: Vec<u8> = (0..54).flat_map(|i| [((i % 9 * 37 + (i / 9) * (i / 9) * 11) % 256) as u8, 1, 2]).collect();
        let mut scaler = Scaler::new(pixel_art);
        // Tables of another size are not in the way.
        for (width, height) in [(5, 4), (width, height)] {
            let mut new = vec![7; width * height * 3];
            scaler.draw([6, 9], &old, FrameMut::new(width, height, &mut new));
            assert!(new.as_chunks::<3>().0.iter().all(|pixel| pixel[1..] == [1, 2]), "channels do not mix");
            if (width, height) != (5, 4) {
                return new.as_chunks::<3>().0.iter().map(|pixel| pixel[0]).collect();
            }
        }
        vec![]
    }

    #[test]
    fn pictures_are_what_pillow_makes_of_them() {
        // Image.fromarray(picture).resize(size, Image.BILINEAR), then Image.NEAREST.
        for (width, height, wanted) in BILINEAR {
            let got = red(*width, *height, false);
            assert!(got.iter().zip(*wanted).all(|(a, b)| a.abs_diff(*b) <= 1), "{width} x {height}: {got:?}");
        }
        for (width, height, wanted) in NEAREST {
            assert_eq!(red(*width, *height, true), *wanted, "{width} x {height}");
        }
    }

    const BILINEAR: &[(usize, usize, &[u8])] = &[
        (4, 3, &[42, 117, 173, 65, 108, 159, 128, 93, 129, 130, 143, 129]),
        (9, 2, &[28, 65, 102, 139, 176, 181, 154, 31, 68, 101, 138, 175, 116, 153, 126, 131, 104, 141]),
        (
            13,
            4,
            &[
                4, 24, 50, 75, 101, 126, 152, 178, 203, 209, 58, 24, 44, 39, 59, 85, 110, 136, 161, 187, 193, 155, 86,
                53, 59, 79, 119, 139, 165, 190, 163, 155, 181, 108, 79, 88, 113, 139, 159, 78, 98, 124, 149, 116, 104,
                130, 156, 181, 195, 109, 98, 118,
            ],
        ),
        (2, 8, &[81, 121, 88, 128, 103, 122, 126, 105, 153, 111, 157, 129, 135, 139, 100, 140]),
    ];

    const NEAREST: &[(usize, usize, &[u8])] = &[
        (4, 3, &[48, 122, 196, 14, 136, 210, 28, 102, 56, 130, 204, 22]),
        (9, 2, &[11, 48, 85, 122, 159, 196, 233, 14, 51, 176, 213, 250, 31, 68, 105, 142, 179, 216]),
        (
            13,
            4,
            &[
                0, 37, 37, 74, 111, 111, 148, 185, 185, 222, 3, 3, 40, 44, 81, 81, 118, 155, 155, 192, 229, 229, 10,
                47, 47, 84, 99, 136, 136, 173, 210, 210, 247, 28, 28, 65, 102, 102, 139, 19, 56, 56, 93, 130, 130, 167,
                204, 204, 241, 22, 22, 59,
            ],
        ),
        (2, 8, &[74, 222, 85, 233, 85, 233, 118, 10, 173, 65, 250, 142, 250, 142, 93, 241]),
    ];
}
