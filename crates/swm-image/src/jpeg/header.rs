//! The segments of a JPEG file before its scan.

use super::ZIGZAG;
use super::bit_reader::Step;
use super::huffman::HuffmanTable;

/// Bodies of DHT segments and the tables built from them, `[luma, chroma][DC, AC]`.
pub type Tables = [[Option<(Vec<u8>, Box<HuffmanTable>)>; 2]; 2];

/// Size, sampling and quantisation of an image.
#[derive(Default)]
pub struct Header {
    pub height: usize,
    pub width: usize,
    /// Luma samples per chroma sample, in both directions: 1 (4:4:4) or 2 (4:2:0); 0 before the frame segment.
    pub subsampling: usize,
    /// Quantisation steps in scan order.
    steps: [Option<[Step; 64]>; 4],
    /// For each plane, the index of its quantisation steps.
    steps_of_plane: [usize; 3],
}

impl Header {
    /// Reads the segments up to the scan. Returns the header and the bytes of the scan; Huffman tables go to `tables`.
    /// Returns `None` for files that the fast decoder does not support.
    pub fn read<'a>(bytes: &'a [u8], tables: &mut Tables) -> Option<(Self, &'a [u8])> {
        let mut header = Self::default();
        let mut rest = bytes.strip_prefix(&[0xff, 0xd8])?;
        let mut given = [[false; 2]; 2];
        loop {
            let (&[0xff, marker, high, low], _) = rest.split_first_chunk::<4>()? else { return None };
            let length = usize::from(u16::from_be_bytes([high, low]));
            let body = rest.get(4..2 + length)?;
            rest = &rest[2 + length..];
            match marker {
                0xc0 => header.read_frame(body)?,
                0xc4 => read_huffman_tables(body, tables, &mut given)?,
                0xda if header.subsampling > 0 && given == [[true; 2]; 2] => {
                    // Luma uses the first tables, both chroma planes use the second tables.
                    return (body == [3, 1, 0x00, 2, 0x11, 3, 0x11, 0, 63, 0]).then_some((header, rest));
                }
                0xdb => header.read_quantisation(body)?,
                // Skips JFIF, other application segments and comments. Adobe's segment is unsupported, because it may
                // change the colour space.
                0xe0..=0xed | 0xef | 0xfe => {}
                _ => return None,
            }
        }
    }

    fn read_frame(&mut self, body: &[u8]) -> Option<()> {
        let &[8, h1, h0, w1, w0, 3, 1, sampling, y, 2, 0x11, u, 3, 0x11, v] = body else { return None };
        self.subsampling = match sampling {
            0x11 => 1,
            0x22 => 2,
            _ => return None,
        };
        self.height = u16::from_be_bytes([h1, h0]).into();
        self.width = u16::from_be_bytes([w1, w0]).into();
        self.steps_of_plane = [y, u, v].map(usize::from);
        // Rejects narrow images, because libjpeg repeats their chroma instead of interpolating it.
        (self.height > 0 && self.width > if self.subsampling == 2 { 4 } else { 0 }).then_some(())
    }

    fn read_quantisation(&mut self, mut body: &[u8]) -> Option<()> {
        while let Some((&[id], rest)) = body.split_first_chunk() {
            let (values, rest) = rest.split_first_chunk::<64>()?;
            // The upper half of the id is 0 for steps of one byte.
            let table = self.steps.get_mut(usize::from(id))?.insert([Step::default(); 64]);
            for ((&size, position), step) in values.iter().zip(ZIGZAG).zip(table) {
                *step = Step { position, size };
            }
            body = rest;
        }
        Some(())
    }

    /// Returns the quantisation steps of the three planes.
    pub fn plane_steps(&self) -> Option<[&[Step; 64]; 3]> {
        let [Some(y), Some(u), Some(v)] = self.steps_of_plane.map(|i| self.steps.get(i).and_then(Option::as_ref))
        else {
            return None;
        };
        Some([y, u, v])
    }

    /// Returns the rows and columns of MCUs (squares of blocks that are coded together).
    pub const fn mcu_grid(&self) -> (usize, usize) {
        (self.height.div_ceil(8 * self.subsampling), self.width.div_ceil(8 * self.subsampling))
    }
}

/// Reads Huffman tables. Tables that equal the tables of the last image are not rebuilt.
fn read_huffman_tables(mut body: &[u8], tables: &mut Tables, given: &mut [[bool; 2]; 2]) -> Option<()> {
    while let Some((&id, rest)) = body.split_first() {
        let (class, plane_kind) = (usize::from(id >> 4), usize::from(id & 15));
        let counts = rest.first_chunk::<16>()?;
        let total: usize = counts.iter().map(|&n| usize::from(n)).sum();
        let all = rest.get(..16 + total)?;
        let slot = tables.get_mut(plane_kind)?.get_mut(class)?;
        if slot.as_ref().is_none_or(|(known, _)| known != all) {
            *slot = Some((all.to_vec(), Box::new(HuffmanTable::new(counts, &all[16..], class == 1)?)));
        }
        given[plane_kind][class] = true;
        body = &rest[16 + total..];
    }
    Some(())
}
