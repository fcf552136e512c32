//! Soft discs in a world of 224 pixels, drawn at any size.

use super::{Area, Point, Rgb};

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

impl Disc {
    /// The pixels it changes in a picture of 224 pixels.
    #[allow(clippy::cast_possible_truncation)]
    pub fn area(&self) -> Area {
        let [x, y] = self.center.map(f64::from);
        Area::EMPTY.with(Point::nearest(x, y), (REACH * self.radius).ceil() as i32 + 1)
    }
}

/// Blends discs; keeps its scratch memory.
#[derive(Default)]
pub struct Brush {
    /// Opacity along x in 1/65536, once a byte of a row of pixels, and the colour beside it.
    across: Vec<(i32, i32)>,
}

/// Full opacity.
const OPAQUE: f64 = 65536.0;
/// In standard deviations: beyond this a disc changes no byte, exp(-REACH^2 / 2) * 255 < 1/2.
const REACH: f64 = 3.54;

impl Brush {
    /// Blends one disc into a picture. Only the square it changes is touched.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn blend(&mut self, disc: &Disc, width: usize, height: usize, rgb: &mut [u8]) {
        let [x, y] = [Profile::new(disc, 0, width), Profile::new(disc, 1, height)];
        let columns = x.pixels();
        self.across.clear();
        self.across.extend(columns.clone().flat_map(|i| {
            let opacity = x.at(i) as i32;
            disc.color.map(|c| (opacity, i32::from(c)))
        }));
        for j in y.pixels() {
            let down = y.at(j) as i64;
            let row = &mut rgb[(j * width + columns.start) * 3..(j * width + columns.end) * 3];
            for (byte, &(opacity, color)) in row.iter_mut().zip(&self.across) {
                let opacity = ((i64::from(opacity) * down) >> 16) as i32;
                let under = i32::from(*byte);
                *byte = (under + (((color - under) * opacity + (1 << 15)) >> 16)) as u8;
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

    /// Opacity at the middle of a pixel, 0 to [`OPAQUE`].
    #[allow(clippy::cast_precision_loss)]
    fn at(&self, pixel: usize) -> f64 {
        let off = (pixel as f64 + 0.5) * self.scale - self.center;
        let exponent = (self.nearest - off * off) / (2.0 * self.radius * self.radius);
        (exponent.min(0.0).exp() * OPAQUE).round()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
}
