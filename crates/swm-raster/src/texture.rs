//! [`Texture`]: pictures with smaller versions of themselves, looked up with linear interpolation.
//!
//! The choice between two versions is that of Mesa's software rasteriser, with which pictures are compared: the larger
//! of the coordinates' derivatives counts, and versions blend only in the second half of the way from one to the next.

/// A flat texture, or the six faces of a cube (+x, -x, +y, -y, +z, -z, as OpenGL orders and turns them).
#[derive(Clone, Debug)]
pub struct Texture {
    faces: Vec<Vec<Level>>,
}

/// One version: RGBA texels in a word each, row after row.
#[derive(Clone, Debug)]
struct Level {
    width: i32,
    height: i32,
    texels: Vec<u32>,
}

/// Every other byte of a word: two channels that can be multiplied by up to 256 at once.
const TWO: u32 = 0x00ff_00ff;

/// Words weighted by numbers that sum to 256, channel by channel.
#[inline(always)]
fn weighted<const N: usize>(words: [u32; N], weights: [u32; N]) -> u32 {
    let (mut even, mut odd) = (0x0080_0080, 0x0080_0080);
    for (word, weight) in words.into_iter().zip(weights) {
        even += (word & TWO) * weight;
        odd += (word >> 8 & TWO) * weight;
    }
    (even >> 8 & TWO) | (odd & !TWO)
}

impl Level {
    /// Half the width and height, at least 1.
    fn halved(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let at = |x: i32, y: i32| self.texels[to_usize(y.min(self.height - 1) * self.width + x.min(self.width - 1))];
        let texels = (0..width * height).map(|place| {
            let (x, y) = (2 * (place % width), 2 * (place / width));
            weighted([at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)], [64; 4])
        });
        Self { width, height, texels: texels.collect() }
    }

    /// The colour at coordinates from 0 to 1, between four texels, to a 256th of the way.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::cast_sign_loss)]
    fn look(&self, s: f32, t: f32, repeat: bool) -> u32 {
        let (w, h) = (self.width, self.height);
        let x = (s * (256 * w) as f32) as i32 - 128;
        let y = (t * (256 * h) as f32) as i32 - 128;
        let (fx, fy) = ((x & 255) as u32, (y & 255) as u32);
        let (x, y) = (x >> 8, y >> 8);
        // The ends of coordinates are half a texel beyond the texture; what is farther is no number, and black.
        let first = |i: i32, n: i32| if i < 0 { if repeat { n - 1 } else { 0 } } else { i };
        let second = |i: i32, n: i32| if i + 1 >= n { if repeat { 0 } else { n - 1 } } else { i + 1 };
        let (xa, xb) = (first(x, w), second(x, w));
        let (ya, yb) = (first(y, h).wrapping_mul(w), second(y, h).wrapping_mul(w));
        let at = |x: i32, y: i32| self.texels.get(y.wrapping_add(x) as usize).copied().unwrap_or(0);
        let four = [at(xa, ya), at(xb, ya), at(xa, yb), at(xb, yb)];
        let right = fx * fy;
        let weights = [65536 - 256 * (fx + fy) + right, 256 * fx - right, 256 * fy - right, right];
        // Rounded so that they still sum to 256.
        let [_, b, c, d] = weights.map(|weight| (weight + 128) >> 8);
        weighted(four, [256 - b - c - d, b, c, d])
    }
}

/// A place that is not negative.
#[inline(always)]
#[allow(clippy::cast_sign_loss)]
fn to_usize(i: i32) -> usize {
    i as usize
}

/// The faces of a cube, as OpenGL's table has them: which coordinate runs across, along and away, and whether backwards.
const FACES: [[(usize, f32); 3]; 6] = [
    [(2, -1.0), (1, -1.0), (0, 1.0)],
    [(2, 1.0), (1, -1.0), (0, -1.0)],
    [(0, 1.0), (2, 1.0), (1, 1.0)],
    [(0, 1.0), (2, -1.0), (1, -1.0)],
    [(0, 1.0), (1, -1.0), (2, 1.0)],
    [(0, -1.0), (1, -1.0), (2, -1.0)],
];

impl Texture {
    /// A flat texture of `channels` (3 or 4) bytes a texel; `None` where the sizes do not fit.
    pub fn flat(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Option<Self> {
        Some(Self { faces: vec![pyramid(width, height, channels, bytes)?] })
    }

    /// A cube texture: six squares one after the other, or one for all sides; `None` where the sizes do not fit.
    pub fn cube(side: usize, channels: usize, bytes: &[u8]) -> Option<Self> {
        let face = side.checked_mul(side)?.checked_mul(channels)?;
        let faces = match bytes.len() {
            one if one == face && face > 0 => {
                let face = pyramid(side, side, channels, bytes)?;
                vec![face; 6]
            }
            six if face.checked_mul(6) == Some(six) && face > 0 => {
                bytes.chunks_exact(face).map(|bytes| pyramid(side, side, channels, bytes)).collect::<Option<_>>()?
            }
            _ => return None,
        };
        Some(Self { faces })
    }

    /// A white one, flat and a cube's.
    pub fn white() -> Self {
        Self { faces: vec![vec![Level { width: 1, height: 1, texels: vec![u32::MAX] }]; 6] }
    }

    /// Whether it is a cube's.
    pub fn is_cube(&self) -> bool {
        self.faces.len() == 6
    }

    /// The colour (0 to 1) at coordinates that repeat from 1 on; `change` is how much they change from a pixel to the next, at
    /// most, in either direction: `[s, t]`.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation)]
    pub(crate) fn flat_at(&self, s: f32, t: f32, change: [f32; 2]) -> [f32; 3] {
        let levels = &self.faces[0];
        let rho = (change[0] * levels[0].width as f32).max(change[1] * levels[0].height as f32);
        let whole = |x: f32| {
            let part = x - x as i32 as f32;
            if part < 0.0 { part + 1.0 } else { part }
        };
        Self::blend(levels, whole(s), whole(t), rho, true)
    }

    /// The colour (0 to 1) in a direction, which changes so much from a pixel to the next, to the right and down.
    #[inline]
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn cube_at(&self, d: [f32; 3], right: [f32; 3], down: [f32; 3]) -> [f32; 3] {
        let size = d.map(f32::abs);
        let axis = if size[0] >= size[1] && size[0] >= size[2] { 0 } else { 1 + usize::from(size[2] > size[1]) };
        let face = 2 * axis + usize::from(d[axis] < 0.0);
        let pick = |d: [f32; 3]| FACES[face].map(|(axis, sign)| sign * d[axis]);
        let [across, along, major] = pick(d);
        let major = 1.0 / major.max(1e-20);
        let (s, t) = (across * major, along * major);
        let levels = &self.faces[face.min(self.faces.len() - 1)];
        let half = 0.5 * levels[0].width as f32;
        let slope = |by: [f32; 3]| {
            let [across, along, away] = pick(by);
            (across - s * away).abs().max((along - t * away).abs())
        };
        let rho = slope(right).max(slope(down)) * major * half;
        Self::blend(levels, 0.5 * s + 0.5, 0.5 * t + 0.5, rho, false)
    }

    /// The colour between versions, for coordinates from 0 to 1.
    #[inline(always)]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn blend(levels: &[Level], s: f32, t: f32, rho: f32, repeat: bool) -> [f32; 3] {
        let last = levels.len() - 1;
        // 3.5 / sqrt(8): a texel a pixel is still the full version.
        let scaled = if rho > 1.0 { (rho * 1.237_436_9).min(1e9) } else { 1.0 };
        let exponent = (scaled.to_bits() >> 23) - 127;
        let mantissa = f32::from_bits(scaled.to_bits() & 0x007f_ffff | 0x3f80_0000);
        let level = (exponent as usize).min(last);
        let between = if level < last { ((2.0 * mantissa - 3.0) * 256.0) as i32 } else { 0 };
        let fine = levels[level].look(s, t, repeat);
        let seen = match u32::try_from(between) {
            // Less than a few steps of a byte apart, one of them will do.
            Ok(between) if between > 240 => levels[level + 1].look(s, t, repeat),
            Ok(between) if between > 16 => {
                weighted([fine, levels[level + 1].look(s, t, repeat)], [256 - between, between])
            }
            _ => fine,
        };
        [0, 8, 16].map(|shift| (seen >> shift & 255) as f32 * (1.0 / 255.0))
    }
}

/// A picture and its smaller versions, down to one texel.
fn pyramid(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Option<Vec<Level>> {
    let texels = width.checked_mul(height)?;
    if texels == 0 || !(3..=4).contains(&channels) || texels.checked_mul(channels)? != bytes.len() {
        return None;
    }
    // Coordinates are counted in 256ths of texels.
    let side = |n: usize| i32::try_from(n).ok().filter(|n| *n <= 1 << 14);
    let word = |c: &[u8]| u32::from_le_bytes([c[0], c[1], c[2], c.get(3).copied().unwrap_or(255)]);
    let texels = bytes.chunks_exact(channels).map(word).collect();
    let mut levels = vec![Level { width: side(width)?, height: side(height)?, texels }];
    while let Some(level) = levels.last().filter(|level| level.width > 1 || level.height > 1) {
        levels.push(level.halved());
    }
    Some(levels)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_stand_where_they_were_given() {
        let texture = Texture::flat(2, 1, 3, &[255, 0, 0, 0, 0, 255]).expect("a texture");
        assert_eq!(texture.flat_at(0.25, 0.5, [0.0; 2]), [1.0, 0.0, 0.0]);
        assert_eq!(texture.flat_at(1.75, 0.5, [0.0; 2]), [0.0, 0.0, 1.0]);
        // A pixel that covers everything sees the mean.
        let mean = texture.flat_at(0.25, 0.5, [4.0; 2]);
        assert!((mean[0] - 0.5).abs() < 0.01 && (mean[2] - 0.5).abs() < 0.01, "{mean:?}");
    }

    #[test]
    fn a_cube_has_six_sides() {
        let bytes: Vec<u8> = (0..6u8).flat_map(|face| [face * 40, 0, 0]).collect();
        let texture = Texture::cube(1, 3, &bytes).expect("a texture");
        let directions =
            [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
        for (face, direction) in (0..6u8).zip(directions) {
            let seen = texture.cube_at(direction, [0.0; 3], [0.0; 3]);
            assert!((seen[0] * 255.0 - f32::from(face * 40)).abs() < 0.01);
        }
    }

    #[test]
    fn sizes_that_do_not_fit_are_refused() {
        assert!(Texture::flat(2, 2, 3, &[0; 11]).is_none());
        assert!(Texture::flat(0, 2, 3, &[]).is_none());
        assert!(Texture::cube(2, 3, &[0; 13]).is_none());
    }
}
