//! A baseline JPEG encoder for frames of simulations.
//!
//! Frames of simulations have large areas of one colour. An MCU (minimum coded unit, 16 × 16 pixels) of one colour
//! needs no transform, only a few bits for the difference between its value and the value of the last MCU. The encoder
//! finds these MCUs first, which makes it several times faster than general encoders, which transform every block. The
//! output is ITU-T T.81 baseline, JFIF, with chroma at half resolution (4:2:0) and the example tables of Annex K,
//! scaled by quality as in libjpeg.

use super::ZIGZAG;
use super::annex_k::{AC_CHROMA, AC_LUMA, CHROMA, CODES, DC_CHROMA, DC_LUMA, LUMA};
use super::forward_dct::{Block, forward_dct};

/// Side of an MCU in pixels. An MCU consists of four luma blocks and one block of each chroma plane.
const MCU: usize = 16;
/// Bytes in a row of an MCU.
const LINE: usize = MCU * 3;

/// Encodes an RGB image, `[height, width, 3]` with sides from 1 to 65535, with quality 1 to 100, and appends it to
/// `out`.
///
/// # Panics
/// When the length of `rgb` is not `height * width * 3`; the caller checks it.
pub fn encode(rgb: &[u8], height: u16, width: u16, quality: u8, out: &mut Vec<u8>) {
    let (h, w) = (usize::from(height), usize::from(width));
    assert!(
        rgb.len() == h * w * 3 && !rgb.is_empty(),
        "an RGB image of {h} x {w} has {} bytes, not {}",
        h * w * 3,
        rgb.len()
    );
    let tables = [scaled(&LUMA, quality), scaled(&CHROMA, quality)];
    write_headers(height, width, &tables, out);
    let mut scan =
        Scan { bits: 0, free: 64, out, last_dc: [0; 3], reciprocals: tables.map(|table| reciprocals(&table)) };
    let mut mcu = [0; MCU * LINE];
    for top in (0..h).step_by(MCU) {
        for left in (0..w).step_by(MCU) {
            gather(rgb, (h, w), (top, left), &mut mcu);
            // An MCU that equals itself shifted by a pixel has one colour.
            if mcu[3..] == mcu[..mcu.len() - 3] {
                scan.flat([mcu[0], mcu[1], mcu[2]]);
            } else {
                scan.mixed(&mcu);
            }
        }
    }
    scan.finish();
}

/// Scales a quantisation table for a quality as libjpeg does.
fn scaled(table: &[u8; 64], quality: u8) -> [u8; 64] {
    let quality = u32::from(quality.clamp(1, 100));
    let scale = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
    table.map(|value| ((u32::from(value) * scale + 50) / 100).clamp(1, 255) as u8)
}

/// Copies an MCU out of an image; beyond the edges the last row and column are repeated.
fn gather(rgb: &[u8], (h, w): (usize, usize), (top, left): (usize, usize), mcu: &mut [u8; MCU * LINE]) {
    let columns = MCU.min(w - left);
    for (row, line) in mcu.chunks_exact_mut(LINE).enumerate() {
        let from = ((top + row).min(h - 1) * w + left) * 3;
        line[..columns * 3].copy_from_slice(&rgb[from..][..columns * 3]);
        for column in columns..MCU {
            line.copy_within((columns - 1) * 3..columns * 3, column * 3);
        }
    }
}

/// Returns whether one quarter of an MCU (0 and 1 in the upper half, 2 and 3 in the lower half) has one colour.
fn quarter_is_flat(mcu: &[u8; MCU * LINE], quarter: usize) -> bool {
    let start = quarter / 2 * 8 * LINE + quarter % 2 * (LINE / 2);
    let row = |row: usize| &mcu[start + row * LINE..][..LINE / 2];
    let first = row(0);
    first[3..] == first[..LINE / 2 - 3] && (1..8).all(|i| row(i) == first)
}

/// Converts RGB to luma and both chroma values (JFIF), all centred on 0.
fn to_ycbcr([r, g, b]: [f32; 3]) -> [f32; 3] {
    [
        0.299 * r + 0.587 * g + 0.114 * b - 128.0,
        -0.168_736 * r - 0.331_264 * g + 0.5 * b,
        0.5 * r - 0.418_688 * g - 0.081_312 * b,
    ]
}

/// Returns the nearest integer of a value below 2^22. Adding 1.5 * 2^23 leaves the integer in the lowest bits of the
/// sum, which costs less than a conversion and vectorises.
fn round(value: f32) -> i32 {
    const SHIFT: f32 = 12_582_912.0;
    (value + SHIFT).to_bits() as i32 - SHIFT.to_bits() as i32
}

/// The entropy-coded part of an image.
struct Scan<'a> {
    /// Bits that are not written yet; the lowest bit is the newest.
    bits: u64,
    /// The number of bits that still fit into `bits`.
    free: u32,
    out: &'a mut Vec<u8>,
    /// The last DC coefficient of each component.
    last_dc: [i32; 3],
    /// Reciprocals of the quantisation steps of luma and chroma.
    reciprocals: [[f32; 64]; 2],
}

impl Scan<'_> {
    /// Writes an MCU of one colour.
    fn flat(&mut self, color: [u8; 3]) {
        let [y, cb, cr] = to_ycbcr(color.map(f32::from));
        for _ in 0..4 {
            self.flat_block(0, y);
        }
        self.flat_block(1, cb);
        self.flat_block(2, cr);
    }

    /// Writes an MCU of several colours.
    fn mixed(&mut self, mcu: &[u8; MCU * LINE]) {
        let mut luma: [Block; 4] = [[[0.0; 8]; 8]; 4];
        let mut chroma: [Block; 2] = [[[0.0; 8]; 8]; 2];
        for (pair, lines) in mcu.chunks_exact(2 * LINE).enumerate() {
            let [mut cb_sums, mut cr_sums] = [[0.0; MCU]; 2];
            for (row, line) in (2 * pair..).zip(lines.chunks_exact(LINE)) {
                let [mut r, mut g, mut b] = [[0.0; MCU]; 3];
                for (column, pixel) in line.as_chunks::<3>().0.iter().enumerate() {
                    [r[column], g[column], b[column]] = pixel.map(f32::from);
                }
                let mut luma_row = [0.0; MCU];
                for column in 0..MCU {
                    let [y, cb, cr] = to_ycbcr([r[column], g[column], b[column]]);
                    luma_row[column] = y;
                    cb_sums[column] += cb;
                    cr_sums[column] += cr;
                }
                let (left, right) = luma_row.split_at(8);
                luma[row / 8 * 2][row % 8].copy_from_slice(left);
                luma[row / 8 * 2 + 1][row % 8].copy_from_slice(right);
            }
            for (block, sums) in chroma.iter_mut().zip([cb_sums, cr_sums]) {
                block[pair] = std::array::from_fn(|column| 0.25 * (sums[2 * column] + sums[2 * column + 1]));
            }
        }
        for (quarter, block) in luma.iter().enumerate() {
            if quarter_is_flat(mcu, quarter) {
                self.flat_block(0, block[0][0]);
            } else {
                self.block(0, block);
            }
        }
        self.block(1, &chroma[0]);
        self.block(2, &chroma[1]);
    }

    /// Writes a block whose samples are all equal.
    fn flat_block(&mut self, component: usize, value: f32) {
        let kind = usize::from(component > 0);
        // The DC coefficient is 8 times the value. `forward_dct` keeps another factor of 8.
        self.dc(component, round(64.0 * value * self.reciprocals[kind][0]));
        self.symbol(kind, 1, 0);
    }

    /// Writes a block.
    fn block(&mut self, component: usize, block: &Block) {
        let kind = usize::from(component > 0);
        let coefficients = quantise(&forward_dct(block), &self.reciprocals[kind]);
        self.dc(component, coefficients[0]);
        let mut left = (1..64).fold(0u64, |mask, k| mask | u64::from(coefficients[k] != 0) << k);
        let mut last = 0;
        while left != 0 {
            let k = left.trailing_zeros();
            let mut zeros = k - last - 1;
            while zeros > 15 {
                self.symbol(kind, 1, 0xf0);
                zeros -= 16;
            }
            let value = coefficients[k as usize];
            let size = size(value);
            let (code, length) = CODES[kind][1][(zeros << 4 | size) as usize];
            self.push_bits(u32::from(code) << size | magnitude(value, size), u32::from(length) + size);
            last = k;
            left &= left - 1;
        }
        if last != 63 {
            self.symbol(kind, 1, 0);
        }
    }

    /// Writes the difference between the DC coefficients of a block and of the component's last block.
    fn dc(&mut self, component: usize, value: i32) {
        let difference = value - self.last_dc[component];
        self.last_dc[component] = value;
        let size = size(difference);
        let (code, length) = CODES[usize::from(component > 0)][0][size as usize];
        self.push_bits(u32::from(code) << size | magnitude(difference, size), u32::from(length) + size);
    }

    fn symbol(&mut self, kind: usize, class: usize, symbol: usize) {
        let (code, length) = CODES[kind][class][symbol];
        self.push_bits(code.into(), length.into());
    }

    /// Appends at most 32 bits.
    fn push_bits(&mut self, bits: u32, length: u32) {
        if self.free < length {
            self.flush();
        }
        self.bits = self.bits << length | u64::from(bits);
        self.free -= length;
    }

    /// Writes whole bytes. A zero follows each byte 0xff, which would otherwise start a marker.
    fn flush(&mut self) {
        while self.free <= 56 {
            let byte = (self.bits >> (56 - self.free)) as u8;
            self.out.push(byte);
            if byte == 0xff {
                self.out.push(0);
            }
            self.free += 8;
        }
    }

    fn finish(mut self) {
        self.flush();
        let rest = 64 - self.free;
        if rest > 0 {
            // Fills the last byte with ones.
            self.push_bits((1 << (8 - rest)) - 1, 8 - rest);
            self.flush();
        }
        self.out.extend([0xff, 0xd9]);
    }
}

/// Returns the lowest `size` bits of a value, or of the value minus 1 if the value is negative.
fn magnitude(value: i32, size: u32) -> u32 {
    (value + (value >> 31)) as u32 & ((1 << size) - 1)
}

/// Returns the number of bits of a value's magnitude.
fn size(value: i32) -> u32 {
    32 - value.unsigned_abs().leading_zeros()
}

/// Returns 1 / (step × factor) for each quantisation step of a table and the factor that [`forward_dct`] keeps, in the
/// transposed order of [`forward_dct`].
fn reciprocals(table: &[u8; 64]) -> [f32; 64] {
    // 1, and sqrt 2 times cos(k pi / 16).
    const SCALE: [f64; 8] =
        [1.0, 1.387_039_845, 1.306_562_965, 1.175_875_602, 1.0, 0.785_694_958, 0.541_196_100, 0.275_899_379];
    std::array::from_fn(|i| {
        let (row, column) = (i / 8, i % 8);
        (1.0 / (f64::from(table[column * 8 + row]) * SCALE[row] * SCALE[column] * 8.0)) as f32
    })
}

/// Divides coefficients by their quantisation steps and rounds them. Returns them in zigzag order.
fn quantise(transformed: &Block, reciprocals: &[f32; 64]) -> [i32; 64] {
    let mut quantised = [0; 64];
    for ((level, value), reciprocal) in quantised.iter_mut().zip(transformed.as_flattened()).zip(reciprocals) {
        *level = round(value * reciprocal);
    }
    // The transform leaves coefficients transposed.
    std::array::from_fn(|k| {
        let position = usize::from(ZIGZAG[k]);
        quantised[position % 8 * 8 + position / 8]
    })
}

fn write_headers(height: u16, width: u16, tables: &[[u8; 64]; 2], out: &mut Vec<u8>) {
    out.extend([0xff, 0xd8]);
    segment(out, 0xe0, &[b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0"]);
    for (i, table) in (0..).zip(tables) {
        segment(out, 0xdb, &[&[i], &ZIGZAG.map(|position| table[usize::from(position)])]);
    }
    let ([h1, h0], [w1, w0]) = (height.to_be_bytes(), width.to_be_bytes());
    // Declares 8 bits and 3 components, with luma at twice the chroma rate in both directions.
    segment(out, 0xc0, &[&[8, h1, h0, w1, w0, 3, 1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1]]);
    for (id, table) in [(0x00, DC_LUMA), (0x10, AC_LUMA), (0x01, DC_CHROMA), (0x11, AC_CHROMA)] {
        segment(out, 0xc4, &[&[id], &table.counts, table.symbols]);
    }
    segment(out, 0xda, &[&[3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]]);
}

/// Writes a marker and its segment.
fn segment(out: &mut Vec<u8>, marker: u8, parts: &[&[u8]]) {
    let length: usize = 2 + parts.iter().map(|part| part.len()).sum::<usize>();
    let [high, low] = (length as u16).to_be_bytes();
    out.extend([0xff, marker, high, low]);
    parts.iter().for_each(|part| out.extend_from_slice(part));
}

#[cfg(test)]
mod tests {
    use super::encode;
    use zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

    fn decoded(rgb: &[u8], height: u16, width: u16, quality: u8) -> Vec<u8> {
        let mut bytes = vec![7];
        encode(rgb, height, width, quality, &mut bytes);
        assert_eq!(bytes[0], 7, "the encoder appends to the vector");
        let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB).set_strict_mode(true);
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(&bytes[1..]), options);
        let pixels = decoder.decode().expect("decoding the JPEG image");
        let info = decoder.info().expect("a header");
        assert_eq!((info.height, info.width), (height, width));
        pixels
    }

    /// The peak signal-to-noise ratio in dB.
    fn psnr(a: &[u8], b: &[u8]) -> f64 {
        let squares: f64 = a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
        10.0 * (255.0 * 255.0 * a.len() as f64 / squares.max(1e-9)).log10()
    }

    fn image(height: u16, width: u16, color: impl Fn(i32, i32) -> [u8; 3]) -> Vec<u8> {
        let at = |y, x| color(i32::from(y), i32::from(x));
        (0..height).flat_map(|y| (0..width).map(move |x| (y, x))).flat_map(|(y, x)| at(y, x)).collect()
    }

    #[test]
    fn images_of_one_colour_keep_their_colour() {
        for color in [[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 0, 255], [144, 238, 144], [12, 200, 77]] {
            let flat = image(40, 33, |_, _| color);
            let worst = decoded(&flat, 40, 33, 95).iter().zip(&flat).map(|(&a, &b)| a.abs_diff(b)).max();
            assert!(worst <= Some(2), "{color:?} is off by {worst:?}");
        }
    }

    #[test]
    fn images_of_many_sizes_are_close_after_decoding() {
        // The disc on a background of one colour has both kinds of MCU.
        let disc =
            |y: i32, x: i32| if (y - 30).pow(2) + (x - 20).pow(2) < 150 { [30, 60, 250] } else { [250, 240, 230] };
        let gradient = |y: i32, x: i32| [x * 3, y * 3, x + y].map(|v| v.min(255) as u8);
        for (height, width) in [(1, 1), (7, 9), (16, 16), (17, 31), (64, 64), (65, 70)] {
            let smooth = image(height, width, gradient);
            assert!(psnr(&decoded(&smooth, height, width, 95), &smooth) > 40.0, "{height} x {width}");
            let drawn = image(height, width, disc);
            assert!(psnr(&decoded(&drawn, height, width, 95), &drawn) > 30.0, "{height} x {width}");
        }
    }

    #[test]
    fn noise_with_the_largest_coefficients_is_encoded() {
        // Black and white noise with the finest steps has the largest coefficients and most bytes 0xff.
        let noise = image(64, 48, |y, x| [if (x * 7919 + y * 104_729 + x * y * 31) % 5 < 2 { 255 } else { 0 }; 3]);
        assert!(psnr(&decoded(&noise, 64, 48, 100), &noise) > 40.0);
        for quality in [1, 50] {
            assert!(psnr(&decoded(&noise, 64, 48, quality), &noise) > 3.0, "quality {quality}");
        }
    }
}
