//! The decoded planes of a JPEG image, and their conversion to RGB.

use super::header::Header;
use super::ycbcr::{Samples, convert, convert_halved};
use swm_simd::Level;

/// Number of extra samples at the sides of a row. In chroma planes they repeat the outermost samples, so that every
/// sample has neighbours.
pub const MARGIN: usize = 8;

/// A minimum coded unit (MCU), a square of blocks that are coded together. Holds the value of each plane whose samples
/// are all equal.
#[derive(Clone, Copy, Default, PartialEq, Eq)]
pub struct Mcu {
    pub luma: Option<u8>,
    pub chroma: Option<[u8; 2]>,
}

/// Samples of luma and both chroma planes.
#[derive(Default)]
pub struct Planes {
    pub samples: [Vec<u8>; 3],
    /// The MCUs that were decoded, row-major.
    pub mcus: Vec<Mcu>,
}

impl Planes {
    /// Allocates memory for an image, clears the list of MCUs, and returns the strides of the planes.
    pub fn start(&mut self, header: &Header) -> [usize; 3] {
        let (rows, columns) = header.mcu_grid();
        let side = 8 * header.subsampling;
        let strides = [columns * side + MARGIN, MARGIN + columns * 8 + MARGIN, MARGIN + columns * 8 + MARGIN];
        for ((plane, stride), side) in self.samples.iter_mut().zip(strides).zip([side, 8, 8]) {
            plane.resize(rows * side * stride, 0);
        }
        self.mcus.clear();
        strides
    }

    /// Converts the planes to RGB, MCU by MCU, into `out`, `[height, width, 3]`.
    #[inline(always)]
    pub fn write_rgb<L: Level>(&mut self, header: &Header, out: &mut [u8]) -> Option<()> {
        let (rows, columns) = header.mcu_grid();
        let (height, width) = (header.height, header.width);
        let (chroma_height, chroma_width) = (height.div_ceil(header.subsampling), width.div_ceil(header.subsampling));
        let (side, stride) = (8 * header.subsampling, MARGIN + columns * 8 + MARGIN);
        for plane in &mut self.samples[1..] {
            for line in plane.chunks_exact_mut(stride) {
                line[MARGIN - 1] = line[MARGIN];
                line[MARGIN + chroma_width] = line[MARGIN + chroma_width - 1];
            }
        }
        let [y, u, v] = &self.samples;
        for row in 0..rows {
            let lines = row * side..((row + 1) * side).min(height);
            for column in 0..columns {
                let n = side.min(width - column * side) * 3;
                let mut pixels = [0; 48];
                let single_colour = self.single_colour(header, row, column);
                if let Some([y, u, v]) = single_colour {
                    convert::<L>(&[y; 16], &[u; 16], &[v; 16], &mut pixels);
                }
                for line in lines.clone() {
                    let to = &mut out[(line * width + column * side) * 3..][..n];
                    if single_colour.is_none() {
                        let y: &Samples = y[line * (columns * side + MARGIN) + column * side..].first_chunk()?;
                        if header.subsampling == 1 {
                            let at = line * stride + column * 8 + MARGIN;
                            convert::<L>(y, u[at..].first_chunk()?, v[at..].first_chunk()?, &mut pixels);
                        } else {
                            let near = line / 2;
                            let next =
                                if line % 2 == 0 { near.saturating_sub(1) } else { (near + 1).min(chroma_height - 1) };
                            let near = near * stride + column * 8 + MARGIN - 1;
                            let next = next * stride + column * 8 + MARGIN - 1;
                            let us = [u[near..].first_chunk()?, u[next..].first_chunk()?];
                            let vs = [v[near..].first_chunk()?, v[next..].first_chunk()?];
                            if let Ok(to) = <&mut [u8; 48]>::try_from(&mut *to) {
                                convert_halved::<L>(y, us, vs, to);
                                continue;
                            }
                            convert_halved::<L>(y, us, vs, &mut pixels);
                        }
                    }
                    if let Ok(to) = <&mut [u8; 48]>::try_from(&mut *to) {
                        *to = pixels;
                    } else {
                        to.copy_from_slice(&pixels[..n]);
                    }
                }
            }
        }
        Some(())
    }

    /// Returns the luma and chroma of an MCU whose pixels all have the same colour.
    #[inline(always)]
    fn single_colour(&self, header: &Header, row: usize, column: usize) -> Option<[u8; 3]> {
        let (rows, columns) = header.mcu_grid();
        let mcu = self.mcus[row * columns + column];
        let (luma, chroma) = (mcu.luma?, mcu.chroma?);
        // Chroma at half resolution is interpolated with the chroma of neighbouring MCUs.
        if header.subsampling == 2 {
            for row in row.saturating_sub(1)..(row + 2).min(rows) {
                for column in column.saturating_sub(1)..(column + 2).min(columns) {
                    if self.mcus[row * columns + column].chroma != Some(chroma) {
                        return None;
                    }
                }
            }
        }
        Some([luma, chroma[0], chroma[1]])
    }
}
