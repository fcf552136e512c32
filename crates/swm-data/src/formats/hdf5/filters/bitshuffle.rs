//! Bitshuffle: stores the first bits of all elements, then their second bits, and so on, in blocks that may be
//! compressed.

use super::{Input, lz4_block, zstd_frame};

/// Compression of bitshuffled blocks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Codec {
    None,
    Lz4,
    Zstd,
}

impl Codec {
    /// The codec that a setting of the filter selects.
    pub fn new(setting: u32) -> Result<Self, String> {
        match setting {
            0 => Ok(Self::None),
            2 => Ok(Self::Lz4),
            3 => Ok(Self::Zstd),
            _ => Err(format!("its chunks are bitshuffled and compressed with the unsupported codec {setting}")),
        }
    }
}

/// Default block size of the filter, in bytes, for elements of `size` bytes.
fn default_block(size: usize) -> usize {
    (8192 / size / 8 * 8).max(128) * size
}

/// Decodes a chunk into `out`, which has the decoded length of the chunk.
pub fn decode(from: &[u8], size: usize, codec: Codec, out: &mut [u8]) -> Result<(), String> {
    let mut input = Input(from);
    let block = if codec == Codec::None {
        default_block(size)
    } else {
        let (total, block) = (input.u64_be()?, input.u32_be()? as usize);
        if total != out.len() as u64 || block == 0 {
            return Err(format!(
                "bitshuffle: the header declares {total} bytes in blocks of {block} instead of {}",
                out.len()
            ));
        }
        block
    };
    // Eight elements share a byte for each bit; the remaining elements are stored unshuffled.
    let group_bytes = 8 * size;
    let block = (block / group_bytes * group_bytes).max(group_bytes);
    let whole = out.len() / group_bytes * group_bytes;
    let (blocks, rest) = out.split_at_mut(whole);
    let mut bits = vec![];
    for target in blocks.chunks_mut(block) {
        bits.resize(target.len(), 0);
        match codec {
            Codec::None => bits.copy_from_slice(input.take(target.len())?),
            Codec::Lz4 | Codec::Zstd => {
                let length = input.u32_be()? as usize;
                let bytes = input.take(length)?;
                if codec == Codec::Lz4 { lz4_block(bytes, &mut bits)? } else { zstd_frame(bytes, &mut bits)? }
            }
        }
        undo(&bits, size, target);
    }
    rest.copy_from_slice(input.take(rest.len())?);
    Ok(())
}

/// Unshuffles the bits of elements of `size` bytes. The number of elements is a multiple of eight.
pub fn undo(from: &[u8], size: usize, out: &mut [u8]) {
    // Each row holds one bit of all elements, with the first element in the lowest bit.
    let row = out.len() / size / 8;
    for byte in 0..size {
        let rows: [&[u8]; 8] = std::array::from_fn(|bit| &from[(byte * 8 + bit) * row..(byte * 8 + bit + 1) * row]);
        for group in 0..row {
            let bits = transpose(u64::from_le_bytes(std::array::from_fn(|bit| rows[bit][group])));
            for (i, value) in bits.to_le_bytes().into_iter().enumerate() {
                out[(group * 8 + i) * size + byte] = value;
            }
        }
    }
}

/// Transposes an 8 x 8 bit matrix (Hacker's Delight, 7-3).
fn transpose(mut x: u64) -> u64 {
    let mut swap = |mask: u64, shift: u32| {
        let t = (x ^ x >> shift) & mask;
        x ^= t ^ t << shift;
    };
    swap(0x00aa_00aa_00aa_00aa, 7);
    swap(0x0000_cccc_0000_cccc, 14);
    swap(0x0000_0000_f0f0_f0f0, 28);
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn undo_reverses_the_bit_shuffle() {
        for size in [1, 2, 4, 8] {
            let bytes: Vec<u8> = (0..size * 24).map(|i| (i * 37 + 11) as u8).collect();
            let mut bits = vec![0_u8; bytes.len()];
            for index in 0..24 {
                for bit in 0..size * 8 {
                    let set = bytes[index * size + bit / 8] >> (bit % 8) & 1;
                    bits[bit * 3 + index / 8] |= set << (index % 8);
                }
            }
            let mut out = vec![0; bytes.len()];
            undo(&bits, size, &mut out);
            assert_eq!(out, bytes);
        }
    }
}
