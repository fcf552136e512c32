//! Soft discs in a world of 224 pixels, drawn at any size.

use super::{Rgb, Tent};

/// Side of the world, in pixels of its own picture.
const WORLD: f64 = 224.0;

/// A soft disc: a Gaussian with its radius as standard deviation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// Where its middle is; whole numbers are middles of pixels of the 224-pixel picture.
    pub center: [f32; 2],
    /// Its standard deviation in pixels of the 224-pixel picture.
    pub radius: f64,
    /// Its colour.
    pub color: Rgb,
}

/// Blends discs; keeps its scratch memory.
#[derive(Default)]
pub struct Brush {
    /// Opacity along x, once for each byte of a row of pixels, and the disc's colour beside it.
    across: Vec<u16>,
    tones: Vec<i16>,
    /// Opacity along y.
    down: Vec<u16>,
    /// Opacity along one side of the world's own picture.
    profile: Vec<f32>,
}

/// In standard deviations: beyond this a disc changes no byte, exp(-REACH^2 / 2) * 255 < 1/2.
const REACH: f64 = 3.54;

/// An opacity in 1/65535.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn share(opacity: f64) -> u16 {
    (opacity * f64::from(u16::MAX)).round() as u16
}

impl Brush {
    /// Blends one disc into a picture. Only the square it changes is touched.
    pub fn blend(&mut self, disc: &Disc, width: usize, height: usize, rgb: &mut [u8]) {
        let [x, y] = [Profile::new(disc, 0, width), Profile::new(disc, 1, height)];
        self.clear(width, height);
        self.across.extend(x.pixels().flat_map(|i| [share(x.at(i)); 3]));
        self.down.extend(y.pixels().map(|j| share(y.at(j))));
        self.lay(disc.color, width, [x.pixels().start, y.pixels().start], rgb);
    }

    /// Blends one disc as it shows up in a picture of the world that was resized. Where the picture below is of one
    /// colour, this equals blending before resizing.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn blend_resized(&mut self, disc: &Disc, tent: &Tent, rgb: &mut [u8]) {
        let mut start = [0; 2];
        self.clear(tent.size().0, tent.size().1);
        for (axis, resized) in tent.axes().into_iter().enumerate() {
            let profile = Profile::new(disc, axis, WORLD as usize);
            self.profile.clear();
            self.profile.reserve(WORLD as usize);
            self.profile.extend(profile.pixels().map(|i| profile.at(i) as f32));
            let touched = resized.touched(&profile.pixels());
            start[axis] = touched.start;
            let shares =
                touched.map(|i| share(f64::from(resized.mean(i, &self.profile, profile.pixels().start).min(1.0))));
            if axis == 0 {
                self.across.extend(shares.flat_map(|share| [share; 3]));
            } else {
                self.down.extend(shares);
            }
        }
        self.lay(disc.color, tent.size().0, start, rgb);
    }

    /// Empties the scratch memory, and makes room for discs as large as the picture.
    fn clear(&mut self, width: usize, height: usize) {
        self.across.clear();
        self.across.reserve(3 * width);
        self.tones.clear();
        self.tones.reserve(3 * width);
        self.down.clear();
        self.down.reserve(height);
    }

    /// Blends a colour into the pixels from `start` (column and row) on, as much as `across` and `down` together say.
    ///
    /// In 16 bits throughout, so that eight bytes are blended at a time.
    #[allow(clippy::cast_possible_truncation, clippy::cast_possible_wrap, clippy::cast_sign_loss)]
    fn lay(&mut self, color: Rgb, width: usize, [left, top]: [usize; 2], rgb: &mut [u8]) {
        self.tones.extend(color.map(i16::from).iter().cycle().take(self.across.len()));
        for (y, &down) in self.down.iter().enumerate() {
            let row = &mut rgb[3 * ((top + y) * width + left)..][..self.across.len()];
            for ((byte, &across), &tone) in row.iter_mut().zip(&self.across).zip(&self.tones) {
                let opacity = (((u32::from(across) * u32::from(down)) >> 16) as u16 >> 1) as i16;
                let away = (tone - i16::from(*byte)) << 7;
                let part = ((i32::from(away) * i32::from(opacity)) >> 16) as i16;
                *byte = (i16::from(*byte) + ((part + 32) >> 6)) as u8;
            }
        }
    }
}

/// The opacity of a disc along one axis; the product of both is the disc.
struct Profile {
    center: f64,
    scale: f64,
    pixels: usize,
    radius: f64,
    /// The square of the distance from the middle to the nearest pixel of the 224-pixel picture: the reference
    /// scales its discs to be opaque there.
    nearest: f64,
}

impl Profile {
    #[allow(clippy::cast_precision_loss)]
    fn new(disc: &Disc, axis: usize, pixels: usize) -> Self {
        let center = f64::from(disc.center[axis]);
        let nearest = (center - center.round().clamp(0.0, WORLD - 1.0)).powi(2);
        Self { center: center + 0.5, scale: WORLD / pixels as f64, pixels, radius: disc.radius, nearest }
    }

    /// The pixels it reaches.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn pixels(&self) -> std::ops::Range<usize> {
        let reach = REACH * self.radius;
        let end = (((self.center + reach) / self.scale).ceil().max(0.0) as usize).min(self.pixels);
        let start = (((self.center - reach) / self.scale).max(0.0) as usize).min(end);
        start..end
    }

    /// Opacity at the middle of a pixel, 0 to 1.
    #[allow(clippy::cast_precision_loss)]
    fn at(&self, pixel: usize) -> f64 {
        let off = (pixel as f64 + 0.5) * self.scale - self.center;
        let exponent = (self.nearest - off * off) / (2.0 * self.radius * self.radius);
        exponent.min(0.0).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::draw::Area;

    #[test]
    fn a_disc_is_opaque_in_the_middle_and_stays_in_the_picture() {
        let disc = Disc { center: [50.0, 222.5], radius: 7.0, color: [1, 2, 3] };
        for (w, h) in [(224, 224), (64, 48), (1, 1)] {
            let mut rgb = vec![200; w * h * 3];
            Brush::default().blend(&disc, w, h, &mut rgb);
            if w == 224 {
                assert_eq!(rgb[(222 * w + 50) * 3..][..3], disc.color);
                assert_eq!(rgb[0], 200);
            }
        }
    }
    #[test]
    fn a_resized_disc_is_what_resizing_makes_of_it() {
        let disc = Disc { center: [101.3, 6.0], radius: 8.2, color: [250, 0, 90] };
        let mut native = vec![120; 224 * 224 * 3];
        Brush::default().blend(&disc, 224, 224, &mut native);
        for (w, h) in [(64, 64), (100, 37), (300, 224), (5, 3)] {
            let mut tent = Tent::new(224, w, h);
            let mut wanted = vec![0; w * h * 3];
            tent.draw(&native, Area::square(224), &mut wanted);
            let mut rgb = vec![120; w * h * 3];
            Brush::default().blend_resized(&disc, &tent, &mut rgb);
            let apart = rgb.iter().zip(&wanted).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(apart <= Some(1), "{w} x {h}: {apart:?}");
        }
    }
}
