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
    width: usize,
    height: usize,
    texels: Vec<[u8; 4]>,
}

impl Level {
    /// Half the width and height, at least 1.
    fn halved(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let at = |x: usize, y: usize| self.texels[y.min(self.height - 1) * self.width + x.min(self.width - 1)];
        let mut texels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let four = [at(2 * x, 2 * y), at(2 * x + 1, 2 * y), at(2 * x, 2 * y + 1), at(2 * x + 1, 2 * y + 1)];
                texels.push(std::array::from_fn(|k| {
                    let sum: u16 = four.iter().map(|texel| u16::from(texel[k])).sum();
                    u8::try_from((sum + 2) / 4).unwrap_or(u8::MAX)
                }));
            }
        }
        Self { width, height, texels }
    }

    /// The colour at coordinates in texels, from 0 to 255.
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    fn look(&self, x: f32, y: f32, repeat: bool) -> [f32; 3] {
        let (x, y) = (x - 0.5, y - 0.5);
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        let (x0, y0) = (left as i32, top as i32);
        let wrap = |i: i32, n: usize| -> usize {
            let n = n as i32;
            let i = match repeat {
                // Nearly all widths are powers of two.
                true if n & (n - 1) == 0 => i & (n - 1),
                true => i.rem_euclid(n),
                false => i.clamp(0, n - 1),
            };
            usize::try_from(i).unwrap_or(0)
        };
        let (xa, xb) = (wrap(x0, self.width), wrap(x0.saturating_add(1), self.width));
        let (ya, yb) = (wrap(y0, self.height) * self.width, wrap(y0.saturating_add(1), self.height) * self.width);
        let [a, b, c, d] = [ya + xa, ya + xb, yb + xa, yb + xb].map(|i| self.texels[i].map(f32::from));
        std::array::from_fn(|k| {
            let (above, below) = (a[k] + fx * (b[k] - a[k]), c[k] + fx * (d[k] - c[k]));
            above + fy * (below - above)
        })
    }
}

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
        Self { faces: vec![vec![Level { width: 1, height: 1, texels: vec![[u8::MAX; 4]] }]; 6] }
    }

    /// Whether it is a cube's.
    pub fn is_cube(&self) -> bool {
        self.faces.len() == 6
    }

    /// The colour (0 to 1) at coordinates that repeat from 1 on; `change` is how much they change from a pixel to the next, at
    /// most, in either direction: `[s, t]`.
    #[inline]
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn flat_at(&self, s: f32, t: f32, change: [f32; 2]) -> [f32; 3] {
        let levels = &self.faces[0];
        let (width, height) = (levels[0].width as f32, levels[0].height as f32);
        let rho = (change[0] * width).max(change[1] * height);
        // What repeats is cut off before it meets the limits of whole numbers.
        let (s, t) = (s - s.floor(), t - t.floor());
        Self::blend(levels, s, t, rho, true)
    }

    /// The colour (0 to 1) in a direction, which changes so much from a pixel to the next, to the right and down.
    #[inline]
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn cube_at(&self, d: [f32; 3], right: [f32; 3], down: [f32; 3]) -> [f32; 3] {
        let [x, y, z] = d;
        let (ax, ay, az) = (x.abs(), y.abs(), z.abs());
        // The face, and which coordinates run across and down it: OpenGL's table.
        type Pick = fn([f32; 3]) -> [f32; 3];
        let (face, pick): (usize, Pick) = if ax >= ay && ax >= az {
            if x >= 0.0 { (0, |d| [-d[2], -d[1], d[0]]) } else { (1, |d| [d[2], -d[1], -d[0]]) }
        } else if ay >= az {
            if y >= 0.0 { (2, |d| [d[0], d[2], d[1]]) } else { (3, |d| [d[0], -d[2], -d[1]]) }
        } else if z >= 0.0 {
            (4, |d| [d[0], -d[1], d[2]])
        } else {
            (5, |d| [-d[0], -d[1], -d[2]])
        };
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
    #[inline]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn blend(levels: &[Level], s: f32, t: f32, rho: f32, repeat: bool) -> [f32; 3] {
        let last = levels.len() - 1;
        // 3.5 / sqrt(8): a texel a pixel is still the full version.
        let scaled = (rho * 1.237_436_9).clamp(0.5, 1e9);
        let exponent = ((scaled.to_bits() >> 23) as i32 - 127).clamp(-1, 30);
        let mantissa = scaled / f32::from_bits(((exponent + 127) as u32) << 23);
        let (level, mut between) = match usize::try_from(exponent) {
            Ok(level) if level < last => (level, (2.0 * mantissa - 3.0).max(0.0)),
            Ok(_) => (last, 0.0),
            Err(_) => (0, 0.0),
        };
        if rho <= 1.0 {
            between = 0.0;
        }
        let look = |level: &Level| level.look(s * level.width as f32, t * level.height as f32, repeat);
        let fine = look(&levels[level]);
        if between <= 0.0 {
            return fine.map(|c| c * (1.0 / 255.0));
        }
        let coarse = look(&levels[level + 1]);
        std::array::from_fn(|k| (fine[k] + between * (coarse[k] - fine[k])) * (1.0 / 255.0))
    }
}

/// A picture and its smaller versions, down to one texel.
fn pyramid(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Option<Vec<Level>> {
    let texels = width.checked_mul(height)?;
    if texels == 0 || !(3..=4).contains(&channels) || texels.checked_mul(channels)? != bytes.len() {
        return None;
    }
    let texels = bytes.chunks_exact(channels).map(|c| [c[0], c[1], c[2], c.get(3).copied().unwrap_or(255)]).collect();
    let mut levels = vec![Level { width, height, texels }];
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
