//! Soft discs, whose opacity is a Gaussian, at positions in the reference's 224-pixel frame, drawn at any frame size.
//!
//! Two-Room and Piecewise draw the agent and the target as soft discs.

use super::Rgb;
use swm_image::resize::TriangleResizer;

/// Side of the frame in which positions are given, in pixels.
const NATIVE: f64 = 224.0;

/// A soft disc: a Gaussian whose standard deviation is the radius.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SoftDisc {
    /// The centre, x and y, in pixels of the 224-pixel frame. Integers are centres of pixels.
    pub center: [f32; 2],
    /// The standard deviation, in pixels of the 224-pixel frame.
    pub radius: f64,
    /// The colour.
    pub color: Rgb,
}

/// Blends soft discs into images. It reuses its scratch memory.
#[derive(Default)]
pub struct Brush {
    /// Opacity along x in 1/65535, one element per byte of a row.
    across: Vec<u16>,
    /// The disc's colour, one element per byte of a row.
    tones: Vec<i16>,
    /// Opacity along y in 1/65535.
    down: Vec<u16>,
    /// Opacity along one side of the 224-pixel frame.
    profile: Vec<f32>,
}

/// Extent of a disc, in standard deviations. Beyond it no byte changes: exp(-REACH² / 2) * 255 < 1/2.
const REACH: f64 = 3.54;

/// Converts an opacity from 0 ..= 1 to 1/65535.
fn quantized(opacity: f64) -> u16 {
    (opacity * f64::from(u16::MAX)).round() as u16
}

impl Brush {
    /// Blends one disc into an image, `[height, width, 3]`. Only the pixels within its extent are written.
    pub fn blend(&mut self, disc: &SoftDisc, width: usize, height: usize, rgb: &mut [u8]) {
        let [x, y] = [Profile::new(disc, 0, width), Profile::new(disc, 1, height)];
        self.clear(width, height);
        self.across.extend(x.pixels().flat_map(|i| [quantized(x.at(i)); 3]));
        self.down.extend(y.pixels().map(|j| quantized(y.at(j))));
        self.blend_profiles(disc.color, width, [x.pixels().start, y.pixels().start], rgb);
    }

    /// Blends one disc into an image, `[height, width, 3]`, that `resizer` made from a 224-pixel frame. Where the
    /// image has one colour, the result equals blending before resizing.
    pub fn blend_resized(&mut self, disc: &SoftDisc, resizer: &TriangleResizer, rgb: &mut [u8]) {
        let mut start = [0; 2];
        self.clear(resizer.size().0, resizer.size().1);
        for (axis, resized) in resizer.axes().into_iter().enumerate() {
            let profile = Profile::new(disc, axis, NATIVE as usize);
            self.profile.clear();
            self.profile.reserve(NATIVE as usize);
            self.profile.extend(profile.pixels().map(|i| profile.at(i) as f32));
            let touched = resized.touched(&profile.pixels());
            start[axis] = touched.start;
            let opacities =
                touched.map(|i| quantized(f64::from(resized.mean(i, &self.profile, profile.pixels().start).min(1.0))));
            if axis == 0 {
                self.across.extend(opacities.flat_map(|opacity| [opacity; 3]));
            } else {
                self.down.extend(opacities);
            }
        }
        self.blend_profiles(disc.color, resizer.size().0, start, rgb);
    }

    /// Empties the scratch memory and reserves enough for discs as large as the image.
    fn clear(&mut self, width: usize, height: usize) {
        self.across.clear();
        self.across.reserve(3 * width);
        self.tones.clear();
        self.tones.reserve(3 * width);
        self.down.clear();
        self.down.reserve(height);
    }

    /// Blends a colour into the pixels from `[left, top]` on; the opacity is the product of `across` and `down`.
    ///
    /// The arithmetic stays within 16 bits, so that SIMD code blends eight bytes at a time.
    fn blend_profiles(&mut self, color: Rgb, width: usize, [left, top]: [usize; 2], rgb: &mut [u8]) {
        self.tones.extend(color.map(i16::from).iter().cycle().take(self.across.len()));
        for (y, &down) in self.down.iter().enumerate() {
            let row = &mut rgb[3 * ((top + y) * width + left)..][..self.across.len()];
            for ((byte, &across), &tone) in row.iter_mut().zip(&self.across).zip(&self.tones) {
                let opacity = (((u32::from(across) * u32::from(down)) >> 16) as u16 >> 1) as i16;
                let difference = (tone - i16::from(*byte)) << 7;
                let change = ((i32::from(difference) * i32::from(opacity)) >> 16) as i16;
                *byte = (i16::from(*byte) + ((change + 32) >> 6)) as u8;
            }
        }
    }
}

/// The opacity of a disc along one axis; the disc is the product of its two profiles.
struct Profile {
    center: f64,
    scale: f64,
    pixels: usize,
    radius: f64,
    /// Squared distance from the centre to the nearest pixel of the 224-pixel frame, in pixels: the reference scales
    /// discs to be opaque at this pixel.
    nearest: f64,
}

impl Profile {
    fn new(disc: &SoftDisc, axis: usize, pixels: usize) -> Self {
        let center = f64::from(disc.center[axis]);
        let nearest = (center - center.round().clamp(0.0, NATIVE - 1.0)).powi(2);
        Self { center: center + 0.5, scale: NATIVE / pixels as f64, pixels, radius: disc.radius, nearest }
    }

    /// The pixels within the extent of the disc.
    fn pixels(&self) -> std::ops::Range<usize> {
        let reach = REACH * self.radius;
        let end = (((self.center + reach) / self.scale).ceil().max(0.0) as usize).min(self.pixels);
        let start = (((self.center - reach) / self.scale).max(0.0) as usize).min(end);
        start..end
    }

    /// Opacity at the centre of a pixel, 0 to 1.
    fn at(&self, pixel: usize) -> f64 {
        let off = (pixel as f64 + 0.5) * self.scale - self.center;
        let exponent = (self.nearest - off * off) / (2.0 * self.radius * self.radius);
        exponent.min(0.0).exp()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn disc_is_opaque_at_its_centre_and_clipped_to_the_image() {
        let disc = SoftDisc { center: [50.0, 222.5], radius: 7.0, color: [1, 2, 3] };
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
    fn blending_after_resizing_equals_resizing_a_blended_disc() {
        let disc = SoftDisc { center: [101.3, 6.0], radius: 8.2, color: [250, 0, 90] };
        let mut native = vec![120; 224 * 224 * 3];
        Brush::default().blend(&disc, 224, 224, &mut native);
        for (w, h) in [(64, 64), (100, 37), (300, 224), (5, 3)] {
            let mut resizer = TriangleResizer::new(224, w, h);
            let mut expected = vec![0; w * h * 3];
            resizer.resize_part(&native, 0..224, 0..224, &mut expected);
            let mut rgb = vec![120; w * h * 3];
            Brush::default().blend_resized(&disc, &resizer, &mut rgb);
            let difference = rgb.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(difference <= Some(1), "{w} x {h}: {difference:?}");
        }
    }
}
