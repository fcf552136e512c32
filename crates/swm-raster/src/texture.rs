//! [`Texture`]: images with mip levels, sampled with trilinear interpolation.
//!
//! Mip levels are chosen as in Mesa's software rasteriser, whose frames are the reference: by the larger derivative
//! of the coordinates, and two levels blend only in the second half of the interval between them.

use crate::scalar::{nearest, rounded};
use swm_simd::vectorize;

/// Number of texture samples that are looked up together.
pub(crate) const MANY: usize = 128;

/// A flat texture, or the six faces of a cube (+x, -x, +y, -y, +z, -z, in OpenGL's order and orientation).
#[derive(Clone, Debug)]
pub struct Texture {
    width: u32,
    height: u32,
    /// Index of the first texel of each mip level within a face, from fine to coarse. Levels are row-major, with a
    /// border of one texel that repeats the texture or continues its edge.
    levels: Vec<usize>,
    /// Texels per face.
    face: usize,
    /// RGBA texels in a word each, face after face.
    texels: Vec<u32>,
}

/// An image while its mip levels are made.
struct MipLevel {
    width: usize,
    height: usize,
    texels: Vec<u32>,
}

/// Texture samples to look up: coordinates from 0 to 1 on a face, and texels per pixel.
pub(crate) struct TextureLookup<'a> {
    pub s: &'a [f32],
    pub t: &'a [f32],
    pub texels_per_pixel: &'a [f32],
    pub faces: &'a [u32],
}

/// Mask of every other byte of a word: two channels that are multiplied by up to 256 at once.
const TWO: u32 = 0x00ff_00ff;

/// Returns the mean of words, channel by channel, with weights that sum to 256 modulo 2³².
#[inline(always)]
fn weighted<const N: usize>(words: [u32; N], weights: [u32; N]) -> u32 {
    let (mut even, mut odd) = (0x0080_0080_u32, 0x0080_0080_u32);
    for (word, weight) in words.into_iter().zip(weights) {
        even = even.wrapping_add((word & TWO).wrapping_mul(weight));
        odd = odd.wrapping_add((word >> 8 & TWO).wrapping_mul(weight));
    }
    (even >> 8 & TWO) | (odd & !TWO)
}

impl MipLevel {
    /// Reads an image of 3 or 4 `channels`; `None` if the sizes do not match.
    fn new(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Option<Self> {
        let texels = width.checked_mul(height)?;
        // Coordinates are counted in 256ths of texels.
        let fits = (1..=1 << 14).contains(&width) && (1..=1 << 14).contains(&height) && (3..=4).contains(&channels);
        if !fits || texels.checked_mul(channels)? != bytes.len() {
            return None;
        }
        let word = |c: &[u8]| u32::from_le_bytes([c[0], c[1], c[2], c.get(3).copied().unwrap_or(255)]);
        Some(Self { width, height, texels: bytes.chunks_exact(channels).map(word).collect() })
    }

    /// Returns the next mip level: half the width and height, at least 1.
    fn halved(&self) -> Self {
        let (width, height) = ((self.width / 2).max(1), (self.height / 2).max(1));
        let at = |x: usize, y: usize| self.texels[y.min(self.height - 1) * self.width + x.min(self.width - 1)];
        let texels = (0..width * height).map(|index| {
            let (x, y) = (2 * (index % width), 2 * (index / width));
            weighted([at(x, y), at(x + 1, y), at(x, y + 1), at(x + 1, y + 1)], [64; 4])
        });
        Self { width, height, texels: texels.collect() }
    }

    /// Returns the texels with their border.
    fn with_border(&self, repeat: bool) -> impl Iterator<Item = u32> + '_ {
        let inside = move |i: usize, n: usize| match repeat {
            true => (i + n - 1) % n,
            false => i.saturating_sub(1).min(n - 1),
        };
        let row = move |y: usize| (0..self.width + 2).map(move |x| (x, y));
        (0..self.height + 2)
            .flat_map(row)
            .map(move |(x, y)| self.texels[inside(y, self.height) * self.width + inside(x, self.width)])
    }
}

impl Texture {
    /// Makes a flat texture of 3 or 4 `channels`; `None` if the sizes do not match.
    pub fn flat(width: usize, height: usize, channels: usize, bytes: &[u8]) -> Option<Self> {
        Some(Self::new(vec![MipLevel::new(width, height, channels, bytes)?], true))
    }

    /// Makes a cube texture of six square images in sequence, or of one image for all faces; `None` if the sizes do not
    /// match.
    pub fn cube(side: usize, channels: usize, bytes: &[u8]) -> Option<Self> {
        let face = side.checked_mul(side)?.checked_mul(channels)?;
        let image = |bytes| MipLevel::new(side, side, channels, bytes);
        let images = match bytes.len() {
            one if one == face && face > 0 => [bytes; 6].into_iter().map(image).collect::<Option<_>>()?,
            six if face.checked_mul(6) == Some(six) && face > 0 => {
                bytes.chunks_exact(face).map(image).collect::<Option<_>>()?
            }
            _ => return None,
        };
        Some(Self::new(images, false))
    }

    /// Returns a white texture, which serves as a flat and as a cube texture.
    pub fn white() -> Self {
        let white = || MipLevel { width: 1, height: 1, texels: vec![u32::MAX] };
        Self::new((0..6).map(|_| white()).collect(), false)
    }

    /// Builds the mip levels of faces of one size, down to one texel.
    fn new(faces: Vec<MipLevel>, repeat: bool) -> Self {
        let (width, height) = faces.first().map_or((1, 1), |face| (face.width, face.height));
        let (mut levels, mut texels) = (vec![], vec![]);
        let count = faces.len().max(1);
        for mut image in faces {
            levels.clear();
            let begin = texels.len();
            loop {
                levels.push(texels.len() - begin);
                texels.extend(image.with_border(repeat));
                if image.width == 1 && image.height == 1 {
                    break;
                }
                image = image.halved();
            }
        }
        Self { width: width as u32, height: height as u32, levels, face: texels.len() / count, texels }
    }

    /// Whether this is a cube texture.
    pub fn is_cube(&self) -> bool {
        self.texels.len() == 6 * self.face
    }

    /// Returns the texels per pixel for the change of coordinates from one pixel to the next.
    #[inline(always)]
    pub(crate) fn texels_per_pixel(&self, change: [f32; 2]) -> f32 {
        (change[0] * self.width as f32).max(change[1] * self.height as f32)
    }

    /// Returns the face that a direction meets, the coordinates on this face, and the texels per pixel. `right` and
    /// `down` are the change of the direction to the neighbouring pixels. The faces are those of OpenGL's table.
    #[inline(always)]
    pub(crate) fn face_in(&self, d: [f32; 3], right: [f32; 3], down: [f32; 3]) -> (u32, [f32; 2], f32) {
        let [x, y, z] = [d[0].abs(), d[1].abs(), d[2].abs()];
        let on_x = (x >= y) & (x >= z);
        let on_y = !on_x & (z <= y);
        let main = if on_x {
            d[0]
        } else if on_y {
            d[1]
        } else {
            d[2]
        };
        let sign = if main < 0.0 { -1.0 } else { 1.0 };
        let face = if on_x {
            0
        } else if on_y {
            2
        } else {
            4
        } + u32::from(main < 0.0);
        // The components along s, along t, and along the major axis.
        let across = |v: [f32; 3]| {
            if on_x {
                -sign * v[2]
            } else if on_y {
                v[0]
            } else {
                sign * v[0]
            }
        };
        let along = |v: [f32; 3]| if on_y { sign * v[2] } else { -v[1] };
        let away = |v: [f32; 3]| {
            sign * if on_x {
                v[0]
            } else if on_y {
                v[1]
            } else {
                v[2]
            }
        };
        let major = 1.0 / main.abs().max(1e-20);
        let (s, t) = (across(d) * major, along(d) * major);
        let slope = |v: [f32; 3]| (across(v) - s * away(v)).abs().max((along(v) - t * away(v)).abs());
        let texels_per_pixel = slope(right).max(slope(down)) * major * 0.5 * self.width as f32;
        (if self.is_cube() { face } else { 0 }, [0.5 * s + 0.5, 0.5 * t + 0.5], texels_per_pixel)
    }

    /// Looks up colours, 0 to 1, at up to [`MANY`] samples.
    pub(crate) fn colours(&self, lookup: &TextureLookup<'_>, sampler: &mut Sampler, [r, g, b]: [&mut [f32]; 3]) {
        let (n, Sampler { level, next }) = (lookup.s.len().min(MANY), sampler);
        choose(self, &lookup.s[..n], &lookup.t[..n], &lookup.texels_per_pixel[..n], level);
        level.faces[..n].copy_from_slice(&lookup.faces[..n]);
        level.context(self, n);
        level.mix(next, self, n);
        split(&level.words[..n], r, g, b);
    }

    /// Looks up one colour: face, coordinates and texels per pixel.
    #[cfg(test)]
    fn colour(&self, sampler: &mut Sampler, (face, [s, t], texels_per_pixel): (u32, [f32; 2], f32)) -> [f32; 3] {
        let (mut r, mut g, mut b) = ([0.0], [0.0], [0.0]);
        let lookup = TextureLookup { s: &[s], t: &[t], texels_per_pixel: &[texels_per_pixel], faces: &[face] };
        self.colours(&lookup, sampler, [&mut r, &mut g, &mut b]);
        [r[0], g[0], b[0]]
    }

    /// Returns four texels: two neighbours at `at`, and the two texels below them.
    #[inline(always)]
    fn four(&self, at: usize, stride: usize) -> [u32; 4] {
        let two = |at: usize| self.texels.get(at..at + 2).map_or([0; 2], |two| [two[0], two[1]]);
        let ([a, b], [c, d]) = (two(at), two(at + stride));
        [a, b, c, d]
    }
}

/// The memory of texture lookups.
#[derive(Default)]
pub(crate) struct Sampler {
    level: LevelSample,
    next: LevelSample,
}

/// Texture samples, each of one mip level.
struct LevelSample {
    s: [f32; MANY],
    t: [f32; MANY],
    faces: [u32; MANY],
    /// The mip level.
    levels: [u32; MANY],
    /// The weight of the next mip level, in 256ths.
    shares: [u32; MANY],
    /// The index of the upper left of four texels, within the level and its border.
    indices: [u32; MANY],
    /// The number of texels per row of the level, including its border.
    strides: [u32; MANY],
    /// The horizontal position between the centres of the four texels, in 256ths.
    right: [u32; MANY],
    /// The vertical position between the centres of the four texels, in 256ths.
    below: [u32; MANY],
    four: [[u32; MANY]; 4],
    words: [u32; MANY],
}

impl Default for LevelSample {
    fn default() -> Self {
        const NONE: [u32; MANY] = [0; MANY];
        Self {
            s: [0.0; MANY],
            t: [0.0; MANY],
            faces: NONE,
            levels: NONE,
            shares: NONE,
            indices: NONE,
            strides: NONE,
            right: NONE,
            below: NONE,
            four: [NONE; 4],
            words: NONE,
        }
    }
}

impl LevelSample {
    /// Looks up the chosen mip levels.
    fn context(&mut self, texture: &Texture, n: usize) {
        let Self { s, t, faces, levels, indices, strides, right, below, four, words, .. } = self;
        find(texture.width, texture.height, &s[..n], &t[..n], &levels[..n], indices, strides, right, below);
        let [a, b, c, d] = four;
        for i in 0..n {
            let Some(begin) = texture.levels.get(levels[i] as usize) else { continue };
            let at = faces[i] as usize * texture.face + begin + indices[i] as usize;
            [a[i], b[i], c[i], d[i]] = texture.four(at, strides[i] as usize);
        }
        between(&right[..n], &below[..n], a, b, c, d, words);
    }

    /// Blends every sample with the next mip level, if this level has weight.
    fn mix(&mut self, next: &mut Self, texture: &Texture, n: usize) {
        let (mut count, mut from) = (0, [0; MANY]);
        for i in 0..n {
            // The entry is always written, but counted only if the next level has weight.
            (next.s[count], next.t[count], next.faces[count]) = (self.s[i], self.t[i], self.faces[i]);
            (next.levels[count], from[count]) = (self.levels[i] + 1, i);
            count += usize::from(self.shares[i] > 0);
        }
        next.context(texture, count);
        for (&i, &word) in from[..count].iter().zip(&next.words) {
            self.words[i] = weighted([self.words[i], word], [256 - self.shares[i], self.shares[i]]);
        }
    }
}

vectorize! {
    /// Chooses mip levels and wraps coordinates to 0 ..= 1.
    fn choose(texture: &Texture, s: &[f32], t: &[f32], texels_per_pixel: &[f32], level: &mut LevelSample) {
        let n = s.len().min(MANY);
        let (s, t, texels_per_pixel) = (&s[..n], &t[..n], &texels_per_pixel[..n]);
        let LevelSample { s: inside_s, t: inside_t, levels, shares, .. } = level;
        let last = texture.levels.len() as i32 - 1;
        let wrap = |x: f32| {
            let fraction = x - rounded(x);
            let fraction = if fraction < 0.0 { fraction + 1.0 } else { fraction };
            // NaN, and values too large to have a fraction, become 0.
            if fraction <= 1.0 { fraction } else { 0.0 }
        };
        for i in 0..n {
            // 3.5 / sqrt(8): one texel per pixel still gives the finest level.
            let scaled = if texels_per_pixel[i] > 1.0 { (texels_per_pixel[i] * 1.237_436_9).min(1e9) } else { 1.0 };
            let exponent = (scaled.to_bits() >> 23) as i32 - 127;
            let mantissa = f32::from_bits(scaled.to_bits() & 0x007f_ffff | 0x3f80_0000);
            let between = if exponent < last { (2.0 * mantissa - 3.0) * 256.0 } else { 0.0 };
            // Within a few 256ths of a level, that level alone is used.
            levels[i] = (exponent.min(last) + i32::from(between > 240.0)) as u32;
            shares[i] = nearest(if (between > 16.0) & (between <= 240.0) { between } else { 0.0 });
            (inside_s[i], inside_t[i]) = (wrap(s[i]), wrap(t[i]));
        }
    }

    /// Computes the indices of texels within their levels, and the strides of the levels.
    fn find(
        width: u32, height: u32, s: &[f32], t: &[f32], levels: &[u32], indices: &mut [u32; MANY],
        strides: &mut [u32; MANY], right: &mut [u32; MANY], below: &mut [u32; MANY],
    ) {
        let n = s.len().min(MANY);
        let (s, t, levels) = (&s[..n], &t[..n], &levels[..n]);
        for i in 0..n {
            let (w, h) = ((width >> levels[i]).max(1), (height >> levels[i]).max(1));
            // Coordinates in 256ths of a texel, from the centre of the first texel of the border.
            let x = nearest(s[i] * (256 * w) as i32 as f32) + 128;
            let y = nearest(t[i] * (256 * h) as i32 as f32) + 128;
            strides[i] = w + 2;
            indices[i] = (y >> 8) * (w + 2) + (x >> 8);
            (right[i], below[i]) = (x & 255, y & 255);
        }
    }

    /// Interpolates between four texels.
    fn between(
        right: &[u32], below: &[u32], a: &[u32; MANY], b: &[u32; MANY], c: &[u32; MANY], d: &[u32; MANY],
        words: &mut [u32; MANY],
    ) {
        let n = right.len().min(MANY);
        let (right, below) = (&right[..n], &below[..n]);
        for i in 0..n {
            let both = right[i] * below[i];
            // The weights sum to 256. Rounding can make the sum of three weights 257; the first weight is then -1.
            let q = (256 * right[i] - both + 128) >> 8;
            let r = (256 * below[i] - both + 128) >> 8;
            let s = (both + 128) >> 8;
            words[i] = weighted([a[i], b[i], c[i], d[i]], [256_u32.wrapping_sub(q + r + s), q, r, s]);
        }
    }

    /// Converts words to colours.
    fn split(words: &[u32], r: &mut [f32], g: &mut [f32], b: &mut [f32]) {
        let n = words.len();
        let (r, g, b) = (&mut r[..n], &mut g[..n], &mut b[..n]);
        for i in 0..n {
            let channel = |shift: u32| (words[i] >> shift & 255) as i32 as f32 * (1.0 / 255.0);
            (r[i], g[i], b[i]) = (channel(0), channel(8), channel(16));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texels_are_at_their_coordinates() {
        let texture = Texture::flat(2, 1, 3, &[255, 0, 0, 0, 0, 255]).expect("creating the texture");
        let mut sampler = Sampler::default();
        assert_eq!(texture.colour(&mut sampler, (0, [0.25, 0.5], 0.0)), [1.0, 0.0, 0.0]);
        assert_eq!(texture.colour(&mut sampler, (0, [1.75, 0.5], 0.0)), [0.0, 0.0, 1.0]);
        // A pixel that covers the whole texture gets its mean.
        let mean = texture.colour(&mut sampler, (0, [0.25, 0.5], 8.0));
        assert!((mean[0] - 0.5).abs() < 0.01 && (mean[2] - 0.5).abs() < 0.01, "{mean:?}");
    }

    #[test]
    fn cube_directions_select_faces() {
        let bytes: Vec<u8> = (0..6u8).flat_map(|face| [face * 40, 0, 0]).collect();
        let texture = Texture::cube(1, 3, &bytes).expect("creating the texture");
        let directions =
            [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]];
        let mut sampler = Sampler::default();
        for (face, direction) in (0..6u8).zip(directions) {
            let level = texture.colour(&mut sampler, texture.face_in(direction, [0.0; 3], [0.0; 3]));
            assert!((level[0] * 255.0 - f32::from(face * 40)).abs() < 0.01);
        }
    }

    #[test]
    fn textures_of_mismatched_sizes_are_refused() {
        assert!(Texture::flat(2, 2, 3, &[0; 11]).is_none());
        assert!(Texture::flat(0, 2, 3, &[]).is_none());
        assert!(Texture::cube(2, 3, &[0; 13]).is_none());
    }
}
