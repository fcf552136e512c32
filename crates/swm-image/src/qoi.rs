//! The QOI image format (specification 1.0, qoiformat.org): lossless, and the fastest to decode of the lossless
//! formats that other programs read as well.
//!
//! An image is a sequence of operations. Each operation repeats the last pixel, takes one of 64 earlier pixels, changes
//! the last pixel a little, or gives a new pixel. Frames of simulations consist mostly of runs of equal pixels. The
//! encoder finds runs, and the decoder fills runs, many bytes at a time.

use swm_core::{Error, Result};

/// Size of the header in bytes.
const HEADER: usize = 14;
/// The bytes after the last operation.
const END: [u8; 8] = [0, 0, 0, 0, 0, 0, 0, 1];

// Tags of the operations, in the first byte. The tags from `INDEX` to `RUN` are the two upper bits; the six lower bits
// are payload.
const INDEX: u8 = 0x00;
const DIFF: u8 = 0x40;
const LUMA: u8 = 0x80;
const RUN: u8 = 0xc0;
const RGB: u8 = 0xfe;
const RGBA: u8 = 0xff;

/// The longest run of one operation, in pixels.
const LONGEST: usize = 62;
const LONGEST_RUN: u8 = RUN | (LONGEST as u8 - 1);

/// A pixel: red, green, blue, opacity.
type Pixel = [u8; 4];

/// The pixel before the first pixel.
const START: Pixel = [0, 0, 0, 255];

/// Returns the slot of a pixel in the table of earlier pixels: (3 r + 5 g + 7 b + 11 a) mod 64.
fn slot(pixel: Pixel) -> usize {
    // One multiplication sums all four products in the top byte. The lower sums do not carry into the top byte: they
    // are at most 4590 · 2^40.
    let bytes = u64::from(u32::from_le_bytes(pixel));
    let spread = (bytes & 0xff00_ff00) << 32 | bytes & 0x00ff_00ff;
    (spread.wrapping_mul(0x0300_0700_0005_000b) >> 56) as usize % 64
}

/// Encodes an RGB image, `[height, width, 3]`, and appends it to `out`.
pub fn encode(rgb: &[u8], height: u16, width: u16, out: &mut Vec<u8>) {
    out.extend_from_slice(b"qoif");
    out.extend_from_slice(&u32::from(width).to_be_bytes());
    out.extend_from_slice(&u32::from(height).to_be_bytes());
    out.extend_from_slice(&[3, 0]);
    let mut seen = [[0; 4]; 64];
    let mut last = START;
    let mut at = 0;
    while let Some(&[r, g, b]) = rgb[at..].first_chunk() {
        let pixel = [r, g, b, 255];
        if pixel == last {
            let mut run = 1 + repeats(rgb, at + 3);
            at += 3 * run;
            while run >= LONGEST {
                out.push(LONGEST_RUN);
                run -= LONGEST;
            }
            if run > 0 {
                out.push(RUN | (run as u8 - 1));
            }
            continue;
        }
        at += 3;
        let slot = slot(pixel);
        if seen[slot] == pixel {
            out.push(INDEX | slot as u8);
        } else {
            seen[slot] = pixel;
            let [dr, dg, db] = std::array::from_fn(|i| pixel[i].wrapping_sub(last[i]));
            let small = |d: u8| d.wrapping_add(2) < 4;
            let (dr_dg, db_dg) = (dr.wrapping_sub(dg).wrapping_add(8), db.wrapping_sub(dg).wrapping_add(8));
            if small(dr) && small(dg) && small(db) {
                let two = |d: u8| d.wrapping_add(2);
                out.push(DIFF | two(dr) << 4 | two(dg) << 2 | two(db));
            } else if dg.wrapping_add(32) < 64 && dr_dg < 16 && db_dg < 16 {
                out.extend_from_slice(&[LUMA | dg.wrapping_add(32), dr_dg << 4 | db_dg]);
            } else {
                out.extend_from_slice(&[RGB, r, g, b]);
            }
        }
        last = pixel;
    }
    out.extend_from_slice(&END);
}

/// Returns the number of pixels from byte `at` on that equal the pixel before byte `at`.
fn repeats(rgb: &[u8], at: usize) -> usize {
    const WIDE: usize = 32;
    let mut end = at;
    // If a chunk equals the bytes one pixel before the chunk, all pixels of the chunk have one colour.
    while let (Some(a), Some(b)) = (rgb[end - 3..].first_chunk::<WIDE>(), rgb[end..].first_chunk::<WIDE>()) {
        if a != b {
            break;
        }
        end += WIDE;
    }
    while end < rgb.len() && rgb[end] == rgb[end - 3] {
        end += 1;
    }
    (end - at) / 3
}

/// Returns the height and width that the header states.
///
/// # Errors
/// When the header is damaged.
pub fn size(bytes: &[u8]) -> Result<(usize, usize)> {
    let header = bytes.first_chunk::<HEADER>();
    let Some(&[b'q', b'o', b'i', b'f', w0, w1, w2, w3, h0, h1, h2, h3, 3 | 4, 0 | 1]) = header else {
        let start = &bytes[..bytes.len().min(HEADER)];
        return Err(Error::mismatch("reading a QOI header", format!("{start:02x?}"), "qoif, a size, 3 or 4 channels"));
    };
    let side = |bytes| u32::from_be_bytes(bytes) as usize;
    Ok((side([h0, h1, h2, h3]), side([w0, w1, w2, w3])))
}

/// Decodes an image into `out`, `[height, width, 3]`, whose size the caller has compared with the header. Opacity is
/// dropped.
///
/// # Errors
/// When the operations do not fill the image exactly.
#[allow(clippy::too_many_lines, reason = "one match over the operations")]
pub fn decode(bytes: &[u8], out: &mut [u8]) -> Result<()> {
    let damaged = |problem| Error::mismatch("decoding a QOI image", problem, "operations for every pixel, and an end");
    let Some(mut rest) = bytes.get(HEADER..).and_then(|rest| rest.strip_suffix(&END)) else {
        return Err(damaged("a file that is cut off"));
    };
    let mut seen = [[0; 4]; 64];
    let mut pixel = START;
    let mut at = 0;
    while at < out.len() {
        let Some((&op, after)) = rest.split_first() else { return Err(damaged("too few operations")) };
        rest = after;
        match op {
            ..DIFF => pixel = seen[usize::from(op)],
            DIFF..LUMA => {
                let change = |shift: u8| (op >> shift & 3).wrapping_sub(2);
                let [r, g, b, a] = pixel;
                pixel = [r.wrapping_add(change(4)), g.wrapping_add(change(2)), b.wrapping_add(change(0)), a];
                seen[slot(pixel)] = pixel;
            }
            LUMA..RUN => {
                let Some((&nibbles, after)) = rest.split_first() else { return Err(damaged("too few operations")) };
                rest = after;
                let green = (op & 63).wrapping_sub(32);
                let [r, g, b, a] = pixel;
                let red_or_blue = |nibble: u8| green.wrapping_add(nibble).wrapping_sub(8);
                pixel = [
                    r.wrapping_add(red_or_blue(nibbles >> 4)),
                    g.wrapping_add(green),
                    b.wrapping_add(red_or_blue(nibbles & 15)),
                    a,
                ];
                seen[slot(pixel)] = pixel;
            }
            RUN..RGB => {
                // A long run consists of several operations, which are filled at once.
                let mut run = usize::from(op - RUN) + 1;
                while let Some((&more @ RUN..RGB, after)) = rest.split_first() {
                    rest = after;
                    run += usize::from(more - RUN) + 1;
                }
                let Some(target) = out.get_mut(at..at + 3 * run) else { return Err(damaged("too long a run")) };
                fill(target, pixel);
                at += target.len();
                continue;
            }
            RGB => {
                let Some((&[r, g, b], after)) = rest.split_first_chunk() else {
                    return Err(damaged("too few operations"));
                };
                rest = after;
                pixel = [r, g, b, pixel[3]];
                seen[slot(pixel)] = pixel;
            }
            RGBA => {
                let Some((&rgba, after)) = rest.split_first_chunk() else {
                    return Err(damaged("too few operations"));
                };
                rest = after;
                pixel = rgba;
                seen[slot(pixel)] = pixel;
            }
        }
        // Writing four bytes is faster than three; the next pixel overwrites the fourth.
        match out[at..].first_chunk_mut() {
            Some(target) => *target = pixel,
            None => out[at..].copy_from_slice(&pixel[..3]),
        }
        at += 3;
    }
    if rest.is_empty() { Ok(()) } else { Err(damaged("too many operations")) }
}

/// Fills bytes with a pixel.
fn fill(target: &mut [u8], [r, g, b, _]: Pixel) {
    const WIDE: usize = 48;
    let pattern: [u8; WIDE] = std::array::from_fn(|i| [r, g, b][i % 3]);
    let (chunks, rest) = target.as_chunks_mut::<WIDE>();
    chunks.fill(pattern);
    rest.copy_from_slice(&pattern[..rest.len()]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn round_trip(rgb: &[u8], height: u16, width: u16) -> Vec<u8> {
        let mut bytes = vec![7];
        encode(rgb, height, width, &mut bytes);
        assert_eq!(bytes.remove(0), 7, "the encoder appends to the vector");
        assert_eq!(size(&bytes).expect("a header"), (height.into(), width.into()));
        let mut back = vec![0; rgb.len()];
        decode(&bytes, &mut back).expect("decoding the image");
        assert!(back == rgb, "{height} x {width} differs after a round trip");
        bytes
    }

    #[test]
    fn encoder_chooses_the_qoi_operations_of_the_specification() {
        // Two pixels of the colour of `START`, a pixel with a small difference, a pixel with a larger difference, an
        // unrelated pixel, an earlier pixel, a new pixel, and 63 repetitions of the new pixel.
        let mut pixels = vec![[0, 0, 0], [0, 0, 0], [1, 255, 1], [11, 9, 9], [200, 0, 7], [1, 255, 1]];
        pixels.extend([[9, 9, 9]; 64]);
        let bytes = round_trip(pixels.as_flattened(), 7, 10);
        let luma = [LUMA | 42, (8 << 4) | 6];
        // 3 · 1 + 5 · 255 + 7 · 1 + 11 · 255 = 4090 = 63 · 64 + 58.
        let expected = [&[RUN | 1, DIFF | 0b11_01_11][..], &luma, &[RGB, 200, 0, 7, INDEX | 58]].concat();
        assert_eq!(bytes[HEADER..HEADER + expected.len()], expected);
        assert_eq!(bytes[bytes.len() - 10..], [&[LONGEST_RUN, RUN][..], &END].concat());
    }

    #[test]
    fn qoi_files_with_four_channels_decode() {
        let mut bytes = [&b"qoif"[..], &2_u32.to_be_bytes(), &1_u32.to_be_bytes(), &[4, 1]].concat();
        bytes.extend([RGBA, 10, 20, 30, 40, DIFF | 0b11_10_01]);
        bytes.extend(END);
        let mut out = [0; 6];
        decode(&bytes, &mut out).expect("decoding the image");
        assert_eq!(out, [10, 20, 30, 11, 20, 29]);
    }

    #[test]
    fn qoi_files_with_missing_or_extra_bytes_or_pixels_are_rejected() {
        let rgb: Vec<u8> = (0..300_u32).map(|i| (i * i / 7) as u8).collect();
        let bytes = round_trip(&rgb, 10, 10);
        let fails = |bytes: &[u8], pixels: usize| decode(bytes, &mut vec![0; 3 * pixels]).is_err();
        assert!((0..bytes.len()).all(|end| fails(&bytes[..end], 100)));
        assert!(fails(&bytes, 99) && fails(&bytes, 101) && !fails(&bytes, 100));
        assert!(fails(&[&bytes[..], &[0]].concat(), 100));
        let flat = round_trip(&[7; 300], 10, 10);
        assert!(fails(&flat, 40), "a run beyond the end must be an error");
    }

    proptest! {
        #[test]
        fn qoi_round_trip_restores_every_image(
            seed in prop::collection::vec((any::<[u8; 3]>(), 1_usize..150), 1..40),
            noise in prop::collection::vec((0_usize..2000, any::<u8>()), 0..200),
            width in 1_u16..90,
        ) {
            // Runs of colours, changed at random positions by a little or by much.
            let mut rgb: Vec<u8> = seed.iter().flat_map(|(pixel, run)| pixel.repeat(*run)).collect();
            let len = rgb.len();
            for (at, value) in noise {
                rgb[at % len] = if value % 2 == 0 { rgb[at % len].wrapping_add(value % 5) } else { value };
            }
            let height = rgb.len() / 3 / usize::from(width) + 1;
            rgb.resize(height * usize::from(width) * 3, 77);
            round_trip(&rgb, height as u16, width);
        }
    }
}
