//! A baseline JPEG encoder for pictures of simulated worlds.
//!
//! Most of such a picture is flat: a 16 × 16 square of one colour needs no transform, only the difference of its
//! brightness from the square before, a few bits. Finding such squares first makes encoding several times
//! faster than the general encoders we measured, which transform every block. The output is ordinary: ITU-T T.81
//! baseline, JFIF, colour at half resolution (4:2:0), the example tables of Annex K scaled by quality as libjpeg
//! does. Equal pictures give equal bytes on every machine: arithmetic is IEEE single precision in a fixed order.

use super::ZIGZAG;

/// Quantisation tables of Annex K (K.1, K.2), row by row.
const LUMINANCE: [u8; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56, 14, 17, 22, 29, 51,
    87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92, 49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
];
/// See [`LUMINANCE`].
const CHROMINANCE: [u8; 64] = [
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99, 47, 66, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99,
];

/// A Huffman table of Annex K.3: how many codes of each length from 1 to 16, and the symbols in their order.
struct Table {
    counts: [u8; 16],
    symbols: &'static [u8],
}

const DC_LUMINANCE: Table = Table {
    counts: [0, 1, 5, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0],
    symbols: &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
};
const DC_CHROMINANCE: Table = Table {
    counts: [0, 3, 1, 1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0],
    symbols: &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11],
};
const AC_LUMINANCE: Table = Table {
    counts: [0, 2, 1, 3, 3, 2, 4, 3, 5, 5, 4, 4, 0, 0, 1, 125],
    symbols: &[
        0x01, 0x02, 0x03, 0x00, 0x04, 0x11, 0x05, 0x12, 0x21, 0x31, 0x41, 0x06, 0x13, 0x51, 0x61, 0x07, 0x22, 0x71,
        0x14, 0x32, 0x81, 0x91, 0xa1, 0x08, 0x23, 0x42, 0xb1, 0xc1, 0x15, 0x52, 0xd1, 0xf0, 0x24, 0x33, 0x62, 0x72,
        0x82, 0x09, 0x0a, 0x16, 0x17, 0x18, 0x19, 0x1a, 0x25, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x34, 0x35, 0x36, 0x37,
        0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58, 0x59,
        0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a, 0x83,
        0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a, 0xa2, 0xa3,
        0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba, 0xc2, 0xc3,
        0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda, 0xe1, 0xe2,
        0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf1, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    ],
};
const AC_CHROMINANCE: Table = Table {
    counts: [0, 2, 1, 2, 4, 4, 3, 4, 7, 5, 4, 4, 0, 1, 2, 119],
    symbols: &[
        0x00, 0x01, 0x02, 0x03, 0x11, 0x04, 0x05, 0x21, 0x31, 0x06, 0x12, 0x41, 0x51, 0x07, 0x61, 0x71, 0x13, 0x22,
        0x32, 0x81, 0x08, 0x14, 0x42, 0x91, 0xa1, 0xb1, 0xc1, 0x09, 0x23, 0x33, 0x52, 0xf0, 0x15, 0x62, 0x72, 0xd1,
        0x0a, 0x16, 0x24, 0x34, 0xe1, 0x25, 0xf1, 0x17, 0x18, 0x19, 0x1a, 0x26, 0x27, 0x28, 0x29, 0x2a, 0x35, 0x36,
        0x37, 0x38, 0x39, 0x3a, 0x43, 0x44, 0x45, 0x46, 0x47, 0x48, 0x49, 0x4a, 0x53, 0x54, 0x55, 0x56, 0x57, 0x58,
        0x59, 0x5a, 0x63, 0x64, 0x65, 0x66, 0x67, 0x68, 0x69, 0x6a, 0x73, 0x74, 0x75, 0x76, 0x77, 0x78, 0x79, 0x7a,
        0x82, 0x83, 0x84, 0x85, 0x86, 0x87, 0x88, 0x89, 0x8a, 0x92, 0x93, 0x94, 0x95, 0x96, 0x97, 0x98, 0x99, 0x9a,
        0xa2, 0xa3, 0xa4, 0xa5, 0xa6, 0xa7, 0xa8, 0xa9, 0xaa, 0xb2, 0xb3, 0xb4, 0xb5, 0xb6, 0xb7, 0xb8, 0xb9, 0xba,
        0xc2, 0xc3, 0xc4, 0xc5, 0xc6, 0xc7, 0xc8, 0xc9, 0xca, 0xd2, 0xd3, 0xd4, 0xd5, 0xd6, 0xd7, 0xd8, 0xd9, 0xda,
        0xe2, 0xe3, 0xe4, 0xe5, 0xe6, 0xe7, 0xe8, 0xe9, 0xea, 0xf2, 0xf3, 0xf4, 0xf5, 0xf6, 0xf7, 0xf8, 0xf9, 0xfa,
    ],
};

/// The code of every symbol: bits, and how many.
type Codes = [(u16, u8); 256];

const fn codes(table: &Table) -> Codes {
    let mut codes = [(0, 0); 256];
    let (mut code, mut next, mut length) = (0, 0, 0);
    while length < 16 {
        let mut n = 0;
        while n < table.counts[length] {
            codes[table.symbols[next] as usize] = (code, length as u8 + 1);
            code += 1;
            next += 1;
            n += 1;
        }
        code <<= 1;
        length += 1;
    }
    codes
}

static CODES: [[Codes; 2]; 2] =
    [[codes(&DC_LUMINANCE), codes(&AC_LUMINANCE)], [codes(&DC_CHROMINANCE), codes(&AC_CHROMINANCE)]];

/// Side of a square that is coded together: 4 blocks of luminance, one of each chrominance.
const MCU: usize = 16;
/// Bytes in a row of such a square.
const LINE: usize = MCU * 3;

/// Encodes an RGB picture of `height` by `width`, 1 to 65535 each, with quality 1 to 100, appending to `out`.
///
/// # Panics
/// When `rgb` is not of that size: the caller checks it.
pub fn encode(rgb: &[u8], height: u16, width: u16, quality: u8, out: &mut Vec<u8>) {
    let (h, w) = (usize::from(height), usize::from(width));
    assert!(rgb.len() == h * w * 3 && !rgb.is_empty(), "a {h} x {w} RGB picture");
    let tables = [scaled(&LUMINANCE, quality), scaled(&CHROMINANCE, quality)];
    write_headers(height, width, &tables, out);
    let mut scan = Scan { bits: 0, free: 64, out, previous: [0; 3], divisors: tables.map(|table| divisors(&table)) };
    let mut square = [0; MCU * LINE];
    for top in (0..h).step_by(MCU) {
        for left in (0..w).step_by(MCU) {
            gather(rgb, (h, w), (top, left), &mut square);
            // Equal to itself moved by a pixel: one colour.
            if square[3..] == square[..square.len() - 3] {
                scan.flat([square[0], square[1], square[2]]);
            } else {
                scan.mixed(&square);
            }
        }
    }
    scan.finish();
}

/// A table for a quality, as libjpeg scales it.
fn scaled(table: &[u8; 64], quality: u8) -> [u8; 64] {
    let quality = u32::from(quality.clamp(1, 100));
    let scale = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
    #[allow(clippy::cast_possible_truncation)]
    table.map(|value| ((u32::from(value) * scale + 50) / 100).clamp(1, 255) as u8)
}

/// Copies a square out of a picture; beyond its edges the last row and column repeat.
fn gather(rgb: &[u8], (h, w): (usize, usize), (top, left): (usize, usize), square: &mut [u8; MCU * LINE]) {
    let columns = MCU.min(w - left);
    for (row, line) in square.chunks_exact_mut(LINE).enumerate() {
        let from = ((top + row).min(h - 1) * w + left) * 3;
        line[..columns * 3].copy_from_slice(&rgb[from..][..columns * 3]);
        for column in columns..MCU {
            line.copy_within((columns - 1) * 3..columns * 3, column * 3);
        }
    }
}

/// Whether one quarter of a square (0 and 1 above, 2 and 3 below) is of one colour.
fn quarter_is_flat(square: &[u8; MCU * LINE], quarter: usize) -> bool {
    let start = quarter / 2 * 8 * LINE + quarter % 2 * (LINE / 2);
    let row = |row: usize| &square[start + row * LINE..][..LINE / 2];
    let first = row(0);
    first[3..] == first[..LINE / 2 - 3] && (1..8).all(|i| row(i) == first)
}

/// Luminance and both chrominances (JFIF), all around 0.
fn convert([r, g, b]: [f32; 3]) -> [f32; 3] {
    [
        0.299 * r + 0.587 * g + 0.114 * b - 128.0,
        -0.168_736 * r - 0.331_264 * g + 0.5 * b,
        0.5 * r - 0.418_688 * g - 0.081_312 * b,
    ]
}

/// The nearest whole number, for numbers below 2^22. Adding 1.5 * 2^23 leaves it in the lowest bits of the sum,
/// which costs less than a conversion and works in every lane at once.
#[allow(clippy::cast_possible_wrap)]
fn round(value: f32) -> i32 {
    const SHIFT: f32 = 12_582_912.0;
    (value + SHIFT).to_bits() as i32 - SHIFT.to_bits() as i32
}

/// The entropy-coded part of a picture.
struct Scan<'a> {
    /// Bits not yet written, at the low end, and how many more fit.
    bits: u64,
    free: u32,
    out: &'a mut Vec<u8>,
    /// The last mean of each component.
    previous: [i32; 3],
    /// What transformed luminance and chrominance are multiplied with.
    divisors: [[f32; 64]; 2],
}

impl Scan<'_> {
    /// A square of one colour.
    fn flat(&mut self, color: [u8; 3]) {
        let [y, cb, cr] = convert(color.map(f32::from));
        for _ in 0..4 {
            self.flat_block(0, y);
        }
        self.flat_block(1, cb);
        self.flat_block(2, cr);
    }

    /// A square of several colours.
    fn mixed(&mut self, square: &[u8; MCU * LINE]) {
        let mut luminance: [Block; 4] = [[[0.0; 8]; 8]; 4];
        let mut chrominance: [Block; 2] = [[[0.0; 8]; 8]; 2];
        for (pair, lines) in square.chunks_exact(2 * LINE).enumerate() {
            let [mut cb_sums, mut cr_sums] = [[0.0; MCU]; 2];
            for (row, line) in (2 * pair..).zip(lines.chunks_exact(LINE)) {
                let [mut r, mut g, mut b] = [[0.0; MCU]; 3];
                for (column, pixel) in line.as_chunks::<3>().0.iter().enumerate() {
                    [r[column], g[column], b[column]] = pixel.map(f32::from);
                }
                let mut brightness = [0.0; MCU];
                for column in 0..MCU {
                    let [y, cb, cr] = convert([r[column], g[column], b[column]]);
                    brightness[column] = y;
                    cb_sums[column] += cb;
                    cr_sums[column] += cr;
                }
                let (left, right) = brightness.split_at(8);
                luminance[row / 8 * 2][row % 8].copy_from_slice(left);
                luminance[row / 8 * 2 + 1][row % 8].copy_from_slice(right);
            }
            for (block, sums) in chrominance.iter_mut().zip([cb_sums, cr_sums]) {
                block[pair] = std::array::from_fn(|column| 0.25 * (sums[2 * column] + sums[2 * column + 1]));
            }
        }
        for (quarter, block) in luminance.iter().enumerate() {
            if quarter_is_flat(square, quarter) {
                self.flat_block(0, block[0][0]);
            } else {
                self.block(0, block);
            }
        }
        self.block(1, &chrominance[0]);
        self.block(2, &chrominance[1]);
    }

    /// A block of one value.
    fn flat_block(&mut self, component: usize, value: f32) {
        let kind = usize::from(component > 0);
        // Its first coefficient is 8 times the value, and 64 times as the transform scales it.
        self.first(component, round(64.0 * value * self.divisors[kind][0]));
        self.symbol(kind, 1, 0);
    }

    fn block(&mut self, component: usize, block: &Block) {
        let kind = usize::from(component > 0);
        let coefficients = quantise(&transform(block), &self.divisors[kind]);
        self.first(component, coefficients[0]);
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
            self.put(u32::from(code) << size | magnitude(value, size), u32::from(length) + size);
            last = k;
            left &= left - 1;
        }
        if last != 63 {
            self.symbol(kind, 1, 0);
        }
    }

    /// The first coefficient of a block, as its difference from the last block's.
    fn first(&mut self, component: usize, value: i32) {
        let difference = value - self.previous[component];
        self.previous[component] = value;
        let size = size(difference);
        let (code, length) = CODES[usize::from(component > 0)][0][size as usize];
        self.put(u32::from(code) << size | magnitude(difference, size), u32::from(length) + size);
    }

    fn symbol(&mut self, kind: usize, class: usize, symbol: usize) {
        let (code, length) = CODES[kind][class][symbol];
        self.put(code.into(), length.into());
    }

    /// At most 32 bits.
    fn put(&mut self, bits: u32, length: u32) {
        if self.free < length {
            self.flush();
        }
        self.bits = self.bits << length | u64::from(bits);
        self.free -= length;
    }

    /// Writes whole bytes; a byte of ones is followed by one of zeros, so that it is no marker.
    fn flush(&mut self) {
        while self.free <= 56 {
            #[allow(clippy::cast_possible_truncation)]
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
            // Ones fill the last byte.
            self.put((1 << (8 - rest)) - 1, 8 - rest);
            self.flush();
        }
        self.out.extend([0xff, 0xd9]);
    }
}

/// The bits that tell a number of `size` bits: itself, or one less than itself if negative.
#[allow(clippy::cast_sign_loss)]
fn magnitude(value: i32, size: u32) -> u32 {
    (value + (value >> 31)) as u32 & ((1 << size) - 1)
}

/// Bits of a number's magnitude.
fn size(value: i32) -> u32 {
    32 - value.unsigned_abs().leading_zeros()
}

/// Eight numbers, each in a lane of its own.
type Lanes = [f32; 8];
/// An 8 × 8 block, row by row.
type Block = [Lanes; 8];

/// The two-dimensional cosine transform, transposed, each coefficient scaled as [`divisors`] undoes.
fn transform(block: &Block) -> Block {
    let mut rows = *block;
    cosine(&mut rows);
    rows = std::array::from_fn(|row| std::array::from_fn(|column| rows[column][row]));
    cosine(&mut rows);
    rows
}

/// The one-dimensional transform down the rows, in every lane (Arai, Agui and Nakajima 1988: 5 multiplications).
#[allow(clippy::needless_range_loop)] // The loop is over lanes, each of which crosses all rows.
fn cosine(r: &mut Block) {
    for i in 0..8 {
        let (s07, d07, s16, d16) = (r[0][i] + r[7][i], r[0][i] - r[7][i], r[1][i] + r[6][i], r[1][i] - r[6][i]);
        let (s25, d25, s34, d34) = (r[2][i] + r[5][i], r[2][i] - r[5][i], r[3][i] + r[4][i], r[3][i] - r[4][i]);
        let (even0, even3, even1, even2) = (s07 + s34, s07 - s34, s16 + s25, s16 - s25);
        let turned = (even2 + even3) * std::f32::consts::FRAC_1_SQRT_2;
        let (a, b, c) = (d34 + d25, d25 + d16, d16 + d07);
        // sin(pi / 8), and cos(pi / 8) less and plus it.
        let shared = (a - c) * 0.382_683_43;
        let (low, high) = (a * 0.541_196_1 + shared, c * 1.306_563 + shared);
        let middle = b * std::f32::consts::FRAC_1_SQRT_2;
        let (plus, minus) = (d07 + middle, d07 - middle);
        (r[0][i], r[4][i]) = (even0 + even1, even0 - even1);
        (r[2][i], r[6][i]) = (even3 + turned, even3 - turned);
        (r[5][i], r[3][i]) = (minus + low, minus - low);
        (r[1][i], r[7][i]) = (plus + high, plus - high);
    }
}

/// Reciprocals of a table's steps, with the scale [`transform`] leaves, in its transposed order.
fn divisors(table: &[u8; 64]) -> [f32; 64] {
    // 1, and sqrt 2 times cos(k pi / 16).
    const SCALE: [f64; 8] =
        [1.0, 1.387_039_845, 1.306_562_965, 1.175_875_602, 1.0, 0.785_694_958, 0.541_196_100, 0.275_899_379];
    #[allow(clippy::cast_possible_truncation)]
    std::array::from_fn(|i| {
        let (row, column) = (i / 8, i % 8);
        (1.0 / (f64::from(table[column * 8 + row]) * SCALE[row] * SCALE[column] * 8.0)) as f32
    })
}

/// The nearest whole steps, in the order of a scan.
fn quantise(transformed: &Block, divisors: &[f32; 64]) -> [i32; 64] {
    let mut steps = [0; 64];
    for ((step, value), divisor) in steps.iter_mut().zip(transformed.as_flattened()).zip(divisors) {
        *step = round(value * divisor);
    }
    // Coefficient (row, column) lies transposed.
    std::array::from_fn(|k| {
        let place = usize::from(ZIGZAG[k]);
        steps[place % 8 * 8 + place / 8]
    })
}

fn write_headers(height: u16, width: u16, tables: &[[u8; 64]; 2], out: &mut Vec<u8>) {
    out.extend([0xff, 0xd8]);
    segment(out, 0xe0, &[b"JFIF\0\x01\x01\0\0\x01\0\x01\0\0"]);
    for (i, table) in (0..).zip(tables) {
        segment(out, 0xdb, &[&[i], &ZIGZAG.map(|place| table[usize::from(place)])]);
    }
    let ([h1, h0], [w1, w0]) = (height.to_be_bytes(), width.to_be_bytes());
    // 8 bits, 3 components: luminance at twice the rate in both directions.
    segment(out, 0xc0, &[&[8, h1, h0, w1, w0, 3, 1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1]]);
    for (id, table) in [(0x00, DC_LUMINANCE), (0x10, AC_LUMINANCE), (0x01, DC_CHROMINANCE), (0x11, AC_CHROMINANCE)] {
        segment(out, 0xc4, &[&[id], &table.counts, table.symbols]);
    }
    segment(out, 0xda, &[&[3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]]);
}

/// A marker and what belongs to it.
fn segment(out: &mut Vec<u8>, marker: u8, parts: &[&[u8]]) {
    let length: usize = 2 + parts.iter().map(|part| part.len()).sum::<usize>();
    #[allow(clippy::cast_possible_truncation)]
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
        assert_eq!(bytes[0], 7, "appends");
        let options = DecoderOptions::default().jpeg_set_out_colorspace(ColorSpace::RGB).set_strict_mode(true);
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(&bytes[1..]), options);
        let picture = decoder.decode().expect("a JPEG picture");
        let info = decoder.info().expect("a header");
        assert_eq!((info.height, info.width), (height, width));
        picture
    }

    /// The signal to noise ratio, in dB.
    fn fidelity(a: &[u8], b: &[u8]) -> f64 {
        let squares: f64 = a.iter().zip(b).map(|(&a, &b)| (f64::from(a) - f64::from(b)).powi(2)).sum();
        10.0 * (255.0 * 255.0 * a.len() as f64 / squares.max(1e-9)).log10()
    }

    fn picture(height: u16, width: u16, color: impl Fn(i32, i32) -> [u8; 3]) -> Vec<u8> {
        let at = |y, x| color(i32::from(y), i32::from(x));
        (0..height).flat_map(|y| (0..width).map(move |x| (y, x))).flat_map(|(y, x)| at(y, x)).collect()
    }

    #[test]
    fn flat_pictures_keep_their_colour() {
        for color in [[0, 0, 0], [255, 255, 255], [255, 0, 0], [0, 0, 255], [144, 238, 144], [12, 200, 77]] {
            let flat = picture(40, 33, |_, _| color);
            let worst = decoded(&flat, 40, 33, 95).iter().zip(&flat).map(|(&a, &b)| a.abs_diff(b)).max();
            assert!(worst <= Some(2), "{color:?} is off by {worst:?}");
        }
    }

    #[test]
    fn pictures_of_every_size_and_kind_come_back() {
        // A disc on a plain, which mixes flat and mixed squares, and smooth gradients.
        let disc =
            |y: i32, x: i32| if (y - 30).pow(2) + (x - 20).pow(2) < 150 { [30, 60, 250] } else { [250, 240, 230] };
        let gradient = |y: i32, x: i32| [x * 3, y * 3, x + y].map(|v| v.min(255) as u8);
        for (height, width) in [(1, 1), (7, 9), (16, 16), (17, 31), (64, 64), (65, 70)] {
            let smooth = picture(height, width, gradient);
            assert!(fidelity(&decoded(&smooth, height, width, 95), &smooth) > 40.0, "{height} x {width}");
            let drawn = picture(height, width, disc);
            assert!(fidelity(&decoded(&drawn, height, width, 95), &drawn) > 30.0, "{height} x {width}");
        }
    }

    #[test]
    fn extremes_stay_within_the_code() {
        // Black and white noise at the finest steps has the largest coefficients and most bytes of ones.
        let noise = picture(64, 48, |y, x| [if (x * 7919 + y * 104_729 + x * y * 31) % 5 < 2 { 255 } else { 0 }; 3]);
        assert!(fidelity(&decoded(&noise, 64, 48, 100), &noise) > 40.0);
        for quality in [1, 50] {
            assert!(fidelity(&decoded(&noise, 64, 48, quality), &noise) > 3.0, "quality {quality}");
        }
    }
}
