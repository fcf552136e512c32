//! Blosc (version 1): shuffled blocks, compressed with one of several codecs.
//!
//! A chunk is a header of 16 bytes (versions, flags, element size, total length, block length, chunk length), the
//! offset of every block, then the blocks. A block is one stream, or one stream per byte of an element. Each stream has
//! a length prefix; if the prefix equals the decoded length, the stream is stored uncompressed.

use super::{Input, bitshuffle, copy_match, inflate, lz4_block, shuffle, zstd_frame};

/// Bits of the flags in the header.
mod flag {
    pub const SHUFFLE: u8 = 1;
    pub const STORED: u8 = 2;
    pub const BITSHUFFLE: u8 = 4;
    pub const ONE_STREAM: u8 = 16;
}

/// Size of the header in bytes.
const HEADER: usize = 16;

/// Decodes a chunk into `out`, which has the decoded length of the chunk.
pub fn decode(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let mut input = Input(from);
    let [version, _, flags, size] = input.array()?;
    let mut next_size = || input.array().map(u32::from_le_bytes).map(|n| n as usize);
    let (total, block, length) = (next_size()?, next_size()?, next_size()?);
    let size = usize::from(size).max(1);
    if !(1..=2).contains(&version) || total != out.len() || length != from.len() || block == 0 && total > 0 {
        return Err(format!(
            "Blosc: the header declares version {version}, {total} decoded and {length} encoded bytes; expected version 1 \
             or 2, {} decoded and {} encoded bytes",
            out.len(),
            from.len()
        ));
    }
    if flags & flag::STORED != 0 {
        let bytes = from.get(HEADER..HEADER + total).ok_or("Blosc: the chunk is truncated")?;
        out.copy_from_slice(bytes);
        return Ok(());
    }
    let blocks = total.div_ceil(block.max(1));
    let starts = Input(input.take(4 * blocks)?).0;
    let mut scratch = vec![];
    for (decoded, start) in out.chunks_mut(block).zip(starts.as_chunks::<4>().0) {
        let start = u32::from_le_bytes(*start) as usize;
        let mut input = Input(from.get(start..).ok_or("Blosc: a block is outside the chunk")?);
        // A shorter last block is one stream.
        let streams = if flags & flag::ONE_STREAM != 0 || decoded.len() < block { 1 } else { size };
        let shuffled = (flags & flag::SHUFFLE != 0 && size > 1) || flags & flag::BITSHUFFLE != 0;
        scratch.resize(decoded.len(), 0);
        let target = if shuffled { &mut *scratch } else { &mut *decoded };
        let part = target.len() / streams;
        if part * streams != target.len() || part == 0 {
            return Err(format!("Blosc: a block of {} bytes in {streams} streams", target.len()));
        }
        for stream in target.chunks_exact_mut(part) {
            let length = u32::from_le_bytes(input.array()?) as usize;
            let bytes = input.take(length)?;
            if length == part {
                stream.copy_from_slice(bytes);
                continue;
            }
            match flags >> 5 {
                0 => blosclz(bytes, stream)?,
                1 => lz4_block(bytes, stream)?,
                2 => snappy(bytes, stream)?,
                3 => inflate(bytes, stream)?,
                4 => zstd_frame(bytes, stream)?,
                codec => return Err(format!("Blosc: there is no codec {codec}")),
            }
        }
        if flags & flag::BITSHUFFLE != 0 {
            // A block is shuffled only if it consists of whole groups of eight elements.
            if decoded.len().is_multiple_of(8 * size) {
                bitshuffle::undo(&scratch, size, decoded);
            } else {
                decoded.copy_from_slice(&scratch);
            }
        } else if shuffled {
            shuffle::undo(&scratch, size, decoded)?;
        }
    }
    Ok(())
}

/// Decodes a raw Snappy block, which must be exactly as long as `out`.
fn snappy(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let decoded = snap::raw::Decoder::new().decompress(from, out).map_err(|error| format!("Snappy: {error}"))?;
    if decoded == out.len() { Ok(()) } else { Err(format!("Snappy: {decoded} bytes instead of {}", out.len())) }
}

/// Decodes BloscLZ, a descendant of FastLZ. It differs from LZF in two ways: a length may have any number of bytes, and
/// two more bytes follow the largest distance.
fn blosclz(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    const FAR: usize = 8191;
    let mut input = Input(from);
    let mut at = 0;
    // The first instruction is always a run of literals.
    let mut control = usize::from(input.array::<1>()?[0] & 31);
    loop {
        if control < 32 {
            let literals = input.take(control + 1)?;
            let target = out.get_mut(at..at + literals.len()).ok_or("BloscLZ: the data exceeds the chunk")?;
            target.copy_from_slice(literals);
            at += literals.len();
        } else {
            let mut length = (control >> 5) + 2;
            if length == 7 + 2 {
                loop {
                    let [more] = input.array()?;
                    length = length.checked_add(usize::from(more)).ok_or("BloscLZ: a length overflows")?;
                    if more != 255 {
                        break;
                    }
                }
            }
            let [low] = input.array()?;
            let mut distance = (control & 31) << 8 | usize::from(low);
            if distance == FAR {
                distance += usize::from(u16::from_be_bytes(input.array()?));
            }
            copy_match(out, at, distance + 1, length)?;
            at += length;
        }
        let Ok([next]) = input.array() else { break };
        control = usize::from(next);
    }
    if at == out.len() { Ok(()) } else { Err(format!("BloscLZ: the data ends after {at} of {} bytes", out.len())) }
}
