//! The fast decoder of baseline JPEG. The pixels equal the pixels that libjpeg (and therefore Pillow, OpenCV and
//! torchvision) decodes, bit for bit.
//!
//! Frames of simulations have large areas of one colour, which are fast to decode: an MCU (minimum coded unit) that
//! repeats the last MCU is recognised by its code alone, and an MCU of a single colour whose neighbours have the same
//! chroma is filled without inverse transform or upsampling. The decoder supports ITU-T T.81 baseline in YCbCr, with
//! chroma at full (4:4:4) or half resolution (4:2:0), without restart intervals. The general decoder handles all other
//! files, including damaged files.

use super::bit_reader::BitReader;
use super::header::{Header, Tables};
use super::huffman::{END_OF_BLOCK, Entry, HuffmanTable, INDEX_BITS};
use super::inverse_dct::inverse_dct;
use super::planes::{MARGIN, Mcu, Planes};
use std::cell::RefCell;
use swm_simd::{Kernel, Level, dispatch_avx2};

/// Memory and Huffman tables that are reused for the next image. Most images have equal tables.
#[derive(Default)]
struct Scratch {
    tables: Tables,
    planes: Planes,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// Decodes an image of `height` by `width` into `out`, `[height, width, 3]` RGB bytes.
///
/// Returns `false`, with unspecified bytes in `out`, when the image has another size, is of an unsupported
/// kind, or is damaged.
pub fn decode(bytes: &[u8], height: usize, width: usize, out: &mut [u8]) -> bool {
    if out.len() != height * width * 3 || out.is_empty() {
        return false;
    }
    SCRATCH.with_borrow_mut(|Scratch { tables, planes }| {
        let Some((header, scan)) = Header::read(bytes, tables) else { return false };
        (header.height, header.width) == (height, width)
            && dispatch_avx2(DecodeScan { header: &header, scan, tables, planes, out }).is_some()
    })
}

/// Decodes a scan into planes and the planes to RGB. The result is `None` when the scan is damaged.
struct DecodeScan<'a> {
    header: &'a Header,
    scan: &'a [u8],
    tables: &'a Tables,
    planes: &'a mut Planes,
    out: &'a mut [u8],
}

impl Kernel for DecodeScan<'_> {
    type Output = Option<()>;

    #[inline(always)]
    fn run<L: Level>(self) -> Option<()> {
        let Self { header, scan, tables, planes, out } = self;
        decode_planes::<L>(header, scan, tables, planes)?;
        planes.write_rgb::<L>(header, out)
    }
}

/// Huffman tables of the three planes, `[DC, AC]` each.
type PlaneTables<'a> = [[&'a HuffmanTable; 2]; 3];

/// Decodes the coefficients of a scan and transforms them into the planes.
#[allow(clippy::too_many_lines, reason = "the state of the scan is shared by the whole loop")]
#[inline(always)]
fn decode_planes<L: Level>(header: &Header, scan: &[u8], tables: &Tables, planes: &mut Planes) -> Option<()> {
    let (rows, columns) = header.mcu_grid();
    let steps = header.plane_steps()?;
    let [[Some((_, dc0)), Some((_, ac0))], [Some((_, dc1)), Some((_, ac1))]] = tables else { return None };
    let tables = [[&**dc0, &**ac0], [&**dc1, &**ac1], [&**dc1, &**ac1]];
    let luma_blocks = header.subsampling * header.subsampling;
    let side = 8 * header.subsampling;
    let strides = planes.start(header);
    let repeated = repeated_mcu(&tables, luma_blocks);
    let mut bits = BitReader::new(scan);
    let mut last_dc = [0_i32; 3];
    let mut coefficients = [0; 64];
    let mut last = Mcu::default();
    for row in 0..rows {
        for column in 0..columns {
            bits.refill();
            if let (Some(code), Mcu { luma: Some(y_value), chroma: Some([u_value, v_value]) }) = (repeated, last)
                && bits.starts_with(code)
            {
                bits.skip(code.1);
                let [y, u, v] = &mut planes.samples;
                let at = (row * strides[0] + column) * side;
                if side == 16 {
                    fill::<16>(&mut y[at..], strides[0], y_value);
                } else {
                    fill::<8>(&mut y[at..], strides[0], y_value);
                }
                let at = row * 8 * strides[1] + MARGIN + column * 8;
                fill::<8>(&mut u[at..], strides[1], u_value);
                fill::<8>(&mut v[at..], strides[2], v_value);
                planes.mcus.push(last);
                continue;
            }
            // For each block, the value of the samples if all samples are equal.
            let mut flat = [None; 6];
            for (block, flat) in flat.iter_mut().enumerate().take(luma_blocks + 2) {
                let plane = block.saturating_sub(luma_blocks - 1);
                let [dc, ac] = tables[plane];
                let entry = bits.entry(dc, false)?;
                last_dc[plane] = i32::from((last_dc[plane] + bits.value(entry)) as i16);
                let first = (last_dc[plane] * i32::from(steps[plane][0].size)) as i16;
                let has_ac = bits.ac_coefficients(ac, steps[plane], &mut coefficients)?;
                let stride = strides[plane];
                let at = match plane {
                    0 => {
                        (row * header.subsampling + block / header.subsampling) * 8 * stride
                            + (column * header.subsampling + block % header.subsampling) * 8
                    }
                    _ => row * 8 * stride + MARGIN + column * 8,
                };
                let to = &mut planes.samples[plane][at..];
                if !has_ac {
                    let value = (((i32::from(first) + 4) >> 3) + 128).clamp(0, 255) as u8;
                    *flat = Some(value);
                    fill::<8>(to, stride, value);
                } else {
                    coefficients[0] = first;
                    inverse_dct::<L>(&coefficients, to, stride);
                    coefficients = [0; 64];
                }
            }
            let luma = flat[0].filter(|_| flat[..luma_blocks].iter().all(|value| *value == flat[0]));
            let chroma = flat[luma_blocks].zip(flat[luma_blocks + 1]).map(|(u, v)| [u, v]);
            last = Mcu { luma, chroma };
            planes.mcus.push(last);
        }
        if bits.is_past_end() {
            return None;
        }
    }
    // A file without an end marker after the scan has another scan or is damaged.
    bits.is_at_end_of_image().then_some(())
}

/// Returns the code of an MCU that repeats the last MCU, as `(bits, number of bits)`. Every block of such an MCU has a
/// DC difference of 0 and no AC coefficients. Returns `None` if the code has more than 32 bits.
fn repeated_mcu(tables: &PlaneTables<'_>, luma_blocks: usize) -> Option<(u64, u32)> {
    let code = |table: &HuffmanTable, run: u32| {
        let matches = |entry: &Entry| (1..=INDEX_BITS).any(|length| *entry == Entry::new(length, 0, run, 0));
        let index = table.entries.iter().position(matches)?;
        let length = table.entries[index].length();
        Some((index as u64 >> (INDEX_BITS - length), length))
    };
    let (mut all, mut bits) = (0_u64, 0);
    for plane in std::iter::repeat_n(0, luma_blocks).chain([1, 2]) {
        for (table, run) in tables[plane].iter().zip([0, END_OF_BLOCK]) {
            let (code, length) = code(table, run)?;
            all = all << length | code;
            bits += length;
            if bits > 32 {
                return None;
            }
        }
    }
    Some((all, bits))
}

/// Fills `N` × `N` samples with a value.
#[inline(always)]
fn fill<const N: usize>(to: &mut [u8], stride: usize, value: u8) {
    for i in 0..N {
        to[i * stride..][..N].copy_from_slice(&[value; N]);
    }
}
