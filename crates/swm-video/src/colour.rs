//! Conversion of decoded planes to RGB and back.
//!
//! Pixels that share a chroma sample use the sample unchanged, as in FFmpeg's own converter for frames that keep their
//! size. The converted frames therefore equal the frames of PyAV, torchcodec and decord.

use ffmpeg_next::color::{Range, Space};
use ffmpeg_next::format::Pixel;
use ffmpeg_next::frame;
use swm_simd::vectorize;

/// Fraction bits of the factors. All values have 16 bits, so that a vector register holds many of them.
const FACTOR: u32 = 13;

/// Fraction bits of products. Where pixels share chroma samples, products have no fraction bits and are truncated,
/// because FFmpeg's converter for these formats does so and frames must equal its frames bit for bit.
const fn fraction(shared: bool) -> u32 {
    if shared { 0 } else { 4 }
}

/// Factors from YUV to RGB: `R = y·(Y − black) + rv·V`, and so on, with U and V counted from 128.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Matrix {
    black: i16,
    y: i16,
    rv: i16,
    gu: i16,
    gv: i16,
    bu: i16,
}

/// Returns the weights of red and blue in luma. An unspecified space is taken as BT.601, as in FFmpeg.
fn luma_weights(space: Space) -> (f64, f64) {
    match space {
        Space::BT709 => (0.2126, 0.0722),
        Space::FCC => (0.30, 0.11),
        Space::SMPTE240M => (0.212, 0.087),
        Space::BT2020NCL | Space::BT2020CL => (0.2627, 0.0593),
        _ => (0.299, 0.114),
    }
}

impl Matrix {
    fn new(space: Space, full_range: bool) -> Self {
        let (red, blue) = luma_weights(space);
        let green = 1.0 - red - blue;
        // Luma has 219 steps and chroma has 224 steps, unless the frame uses the full range.
        let (black, luma, difference) = if full_range { (0, 1.0, 1.0) } else { (16, 255.0 / 219.0, 255.0 / 224.0) };
        let fixed = |factor: f64| (factor * f64::from(1 << FACTOR)).round() as i16;
        Self {
            black,
            y: fixed(luma),
            rv: fixed(2.0 * (1.0 - red) * difference),
            gu: fixed(-2.0 * blue * (1.0 - blue) / green * difference),
            gv: fixed(-2.0 * red * (1.0 - red) / green * difference),
            bu: fixed(2.0 * (1.0 - blue) * difference),
        }
    }
}

/// The layout of the planes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Planes {
    /// One U and V sample for `1 << .0` columns and `1 << .1` rows.
    Yuv(usize, usize),
    Grey,
    /// Green, blue and red planes.
    Gbr,
    /// One plane of pixels of four bytes: blue, green, red and an unused one.
    Bgrz,
}

/// Returns the layout of the 8-bit formats that are converted directly, and whether samples use the full range. Frames
/// of other formats are converted to [`Pixel::YUV444P`] first.
fn planes(format: Pixel) -> Option<(Planes, bool)> {
    Some(match format {
        Pixel::YUV420P => (Planes::Yuv(1, 1), false),
        Pixel::YUVJ420P => (Planes::Yuv(1, 1), true),
        Pixel::YUV422P => (Planes::Yuv(1, 0), false),
        Pixel::YUVJ422P => (Planes::Yuv(1, 0), true),
        Pixel::YUV444P => (Planes::Yuv(0, 0), false),
        Pixel::YUVJ444P => (Planes::Yuv(0, 0), true),
        Pixel::GRAY8 => (Planes::Grey, false),
        Pixel::GBRP => (Planes::Gbr, true),
        Pixel::BGRZ => (Planes::Bgrz, true),
        _ => return None,
    })
}

/// Returns whether [`to_rgb`] supports frames of a format.
pub fn is_native(format: Pixel) -> bool {
    planes(format).is_some()
}

/// Converts a frame of a native format to RGB, `[height, width, 3]`.
///
/// Returns `false` and writes nothing when the frame has another format or size.
pub fn to_rgb(frame: &frame::Video, width: usize, height: usize, out: &mut [u8]) -> bool {
    let Some((planes, full)) = planes(frame.format()) else { return false };
    if (frame.width() as usize, frame.height() as usize, out.len()) != (width, height, width * height * 3) {
        return false;
    }
    // Grey frames that state no range have the full one, as FFmpeg takes them.
    let full = match frame.color_range() {
        Range::JPEG => true,
        Range::Unspecified => full || planes == Planes::Grey,
        Range::MPEG => full,
    };
    let matrix = Matrix::new(frame.color_space(), full);
    let plane = |i: usize| Plane { bytes: frame.data(i), stride: frame.stride(i) };
    let chroma_step = if matches!(planes, Planes::Grey | Planes::Bgrz) { 0 } else { 1 };
    convert(&matrix, planes, &[plane(0), plane(chroma_step), plane(2 * chroma_step)], width, out);
    true
}

/// One plane of a frame.
#[derive(Clone, Copy)]
struct Plane<'a> {
    bytes: &'a [u8],
    stride: usize,
}

impl<'a> Plane<'a> {
    fn row(self, row: usize, length: usize) -> &'a [u8] {
        &self.bytes[row * self.stride..][..length]
    }
}

vectorize! {
    /// Converts all rows. AVX2 interleaves the three planes four times as fast as the baseline.
    fn convert(matrix: &Matrix, kind: Planes, planes: &[Plane<'_>; 3], width: usize, out: &mut [u8]) {
        convert_rows(matrix, kind, planes, width, out);
    }
}

// The functions below are inlined into `convert`; they use loops instead of closures, which the compiler inlines less
// reliably.

#[inline(always)]
fn convert_rows(matrix: &Matrix, kind: Planes, planes: &[Plane<'_>; 3], width: usize, out: &mut [u8]) {
    let [first, second, third] = *planes;
    for (t, out) in out.chunks_exact_mut(width * 3).enumerate() {
        let row = first.row(t, if kind == Planes::Bgrz { width * 4 } else { width });
        match kind {
            Planes::Yuv(0, down) => {
                let (u, v) = (second.row(t >> down, width), third.row(t >> down, width));
                yuv_row::<false>(matrix, row, u, v, out);
            }
            Planes::Yuv(_, down) => {
                let n = width.div_ceil(2);
                yuv_row::<true>(matrix, row, second.row(t >> down, n), third.row(t >> down, n), out);
            }
            Planes::Grey => grey_row(matrix, row, out),
            Planes::Gbr => interleave(third.row(t, width), row, second.row(t, width), out),
            Planes::Bgrz => reorder(row, out),
        }
    }
}

#[inline(always)]
fn interleave(r: &[u8], g: &[u8], b: &[u8], out: &mut [u8]) {
    for (((out, r), g), b) in out.as_chunks_mut::<3>().0.iter_mut().zip(r).zip(g).zip(b) {
        *out = [*r, *g, *b];
    }
}

#[inline(always)]
fn reorder(bgrz: &[u8], out: &mut [u8]) {
    for (out, [b, g, r, _]) in out.as_chunks_mut::<3>().0.iter_mut().zip(bgrz.as_chunks::<4>().0) {
        *out = [*r, *g, *b];
    }
}

/// Number of pixels converted at a time. They fill several registers and fit in the first-level cache.
const PIECE: usize = 64;

/// Converts one row, with one U and one V sample for every pixel or, if `SHARED`, for every two pixels.
#[inline(always)]
fn yuv_row<const SHARED: bool>(matrix: &Matrix, y: &[u8], u: &[u8], v: &[u8], out: &mut [u8]) {
    // The upper half of a sample times a factor must have `fraction` bits.
    let sample = 16 - FACTOR + fraction(SHARED);
    let step = if SHARED { PIECE / 2 } else { PIECE };
    let pieces = y.chunks(PIECE).zip(u.chunks(step)).zip(v.chunks(step)).zip(out.chunks_mut(PIECE * 3));
    for (((y, u), v), out) in pieces {
        // The last piece is padded, so that loops have a constant length.
        let (mut luma, mut differences) = ([0_u8; PIECE], [[0_u8; PIECE]; 2]);
        luma[..y.len()].copy_from_slice(y);
        for (to, from) in differences.iter_mut().zip([u, v]) {
            if SHARED {
                for (pair, &sample) in to.as_chunks_mut::<2>().0.iter_mut().zip(from) {
                    *pair = [sample; 2];
                }
            } else {
                to[..from.len()].copy_from_slice(from);
            }
        }
        let [us, vs] = &differences;
        let (mut r, mut g, mut b) = ([0_u8; PIECE], [0_u8; PIECE], [0_u8; PIECE]);
        for i in 0..PIECE {
            let l = times((i16::from(luma[i]) - matrix.black) << sample, matrix.y);
            let u = (i16::from(us[i]) - 128) << sample;
            let v = (i16::from(vs[i]) - 128) << sample;
            r[i] = clamp(l + times(v, matrix.rv), fraction(SHARED));
            g[i] = clamp(l + times(u, matrix.gu) + times(v, matrix.gv), fraction(SHARED));
            b[i] = clamp(l + times(u, matrix.bu), fraction(SHARED));
        }
        interleave(&r, &g, &b, out);
    }
}

#[inline(always)]
fn grey_row(matrix: &Matrix, y: &[u8], out: &mut [u8]) {
    let bits = fraction(false);
    for (out, &y) in out.as_chunks_mut::<3>().0.iter_mut().zip(y) {
        *out = [clamp(times((i16::from(y) - matrix.black) << (16 - FACTOR + bits), matrix.y), bits); 3];
    }
}

/// Returns the upper half of a product.
#[inline(always)]
fn times(a: i16, b: i16) -> i16 {
    ((i32::from(a) * i32::from(b)) >> 16) as i16
}

/// Converts a sum of products to a byte, rounded if products have fraction bits.
#[inline(always)]
fn clamp(value: i16, fraction: u32) -> u8 {
    let half = if fraction > 0 { 1 << (fraction - 1) } else { 0 };
    ((value + half) >> fraction).clamp(0, 255) as u8
}

/// Converts RGB pixels to a frame of [`Pixel::YUV420P`] (BT.601, 16 to 235) or [`Pixel::YUV444P`], or copies them to
/// a frame of [`Pixel::RGB24`] or [`Pixel::BGRZ`]. A shared chroma sample is the mean over its pixels.
pub fn from_rgb(rgb: &[u8], frame: &mut frame::Video) {
    let (width, height) = (frame.width() as usize, frame.height() as usize);
    let rows = rgb.chunks_exact(width * 3);
    if frame.format() == Pixel::RGB24 {
        let stride = frame.stride(0);
        frame.data_mut(0).chunks_mut(stride).zip(rows).for_each(|(to, from)| to[..from.len()].copy_from_slice(from));
        return;
    }
    if frame.format() == Pixel::BGRZ {
        let stride = frame.stride(0);
        for (to, from) in frame.data_mut(0).chunks_mut(stride).zip(rows) {
            let pixels = to.as_chunks_mut::<4>().0.iter_mut().zip(from.as_chunks::<3>().0);
            pixels.for_each(|(to, [r, g, b])| *to = [*b, *g, *r, 0]);
        }
        return;
    }
    let (red, blue) = luma_weights(Space::Unspecified);
    let luma = |p: &[u8; 3]| red * f64::from(p[0]) + (1.0 - red - blue) * f64::from(p[1]) + blue * f64::from(p[2]);
    let stride = frame.stride(0);
    for (to, from) in frame.data_mut(0).chunks_mut(stride).zip(rows) {
        for (to, p) in to.iter_mut().zip(from.as_chunks::<3>().0) {
            *to = (16.5 + luma(p) * 219.0 / 255.0) as u8;
        }
    }
    let shared = if frame.format() == Pixel::YUV420P { 2 } else { 1 };
    for (plane, colour, weight) in [(1, 2, blue), (2, 0, red)] {
        let stride = frame.stride(plane);
        let scale = 224.0 / 255.0 / (2.0 * (1.0 - weight)) / (shared * shared) as f64;
        for (y, to) in frame.data_mut(plane).chunks_mut(stride).enumerate().take(height / shared) {
            for (x, to) in to.iter_mut().enumerate().take(width / shared) {
                let mut difference = 0.0;
                for dy in 0..shared {
                    let pixels = &rgb[((y * shared + dy) * width + x * shared) * 3..][..shared * 3];
                    difference += pixels.as_chunks::<3>().0.iter().map(|p| f64::from(p[colour]) - luma(p)).sum::<f64>();
                }
                *to = (128.5 + difference * scale) as u8;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn test_image(width: usize, height: usize) -> Vec<u8> {
        (0..width * height)
            .flat_map(|i| [(i % width * 255 / width) as u8, (i / width * 255 / height) as u8, (i * 3 % 256) as u8])
            .collect()
    }

    #[test]
    fn colours_are_close_after_a_round_trip() {
        crate::link::load().expect("FFmpeg");
        for (format, width, height, tolerance) in
            [(Pixel::YUV444P, 71, 33, 2), (Pixel::YUV420P, 70, 34, 4), (Pixel::YUV444P, 1, 1, 2)]
        {
            // Squares of 2 × 2 equal pixels share a chroma sample without loss.
            let small = test_image(width / 2 + 1, height / 2 + 1);
            let rgb: Vec<u8> = (0..width * height)
                .flat_map(|i| small[(i / width / 2 * (width / 2 + 1) + i % width / 2) * 3..][..3].to_vec())
                .collect();
            let mut frame = frame::Video::new(format, width as u32, height as u32);
            from_rgb(&rgb, &mut frame);
            let mut back = vec![0; rgb.len()];
            assert!(to_rgb(&frame, width, height, &mut back));
            let worst = rgb.iter().zip(&back).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(worst <= Some(tolerance), "{format:?}: {worst:?}");
            assert!(!to_rgb(&frame, height + 1, width, &mut back));
        }
    }

    #[test]
    fn red_converts_as_in_bt601_and_bt709() {
        crate::link::load().expect("FFmpeg");
        // Red in BT.601 and BT.709, 16 to 235: ITU-R BT.601-7 and BT.709-6.
        for (space, [y, u, v]) in [(Space::Unspecified, [81, 90, 240]), (Space::BT709, [63, 102, 240])] {
            let mut frame = frame::Video::new(Pixel::YUV444P, 2, 1);
            frame.set_color_space(space);
            [y, u, v].iter().enumerate().for_each(|(plane, &value)| frame.data_mut(plane).fill(value));
            let mut out = [0; 6];
            assert!(to_rgb(&frame, 2, 1, &mut out));
            assert!(out[0] >= 253 && out[1] <= 2 && out[2] <= 2, "{space:?}: {out:?}");
        }
    }
}
