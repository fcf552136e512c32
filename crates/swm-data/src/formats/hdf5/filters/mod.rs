//! Decoders for HDF5 filters.
//!
//! This module supports the filters of the HDF5 library (deflate, shuffle, Fletcher's checksum), h5py's LZF, and LZ4,
//! Zstandard, bitshuffle and Blosc (with all codecs) of the package hdf5plugin. Other filters are errors that name them.

mod bitshuffle;
mod blosc;
pub(super) mod fletcher32;
pub(super) mod lzf;
mod shuffle;

use std::mem;

/// Ids in the registry of HDF5 filters.
pub(super) mod id {
    pub const DEFLATE: u16 = 1;
    pub const SHUFFLE: u16 = 2;
    pub const FLETCHER32: u16 = 3;
    pub const LZF: u16 = 32_000;
    pub const BLOSC: u16 = 32_001;
    pub const LZ4: u16 = 32_004;
    pub const BITSHUFFLE: u16 = 32_008;
    pub const ZSTD: u16 = 32_015;
}

/// Names of registered filters that this module does not decode.
const UNSUPPORTED: &[(u16, &str)] = &[
    (4, "SZIP"),
    (5, "N-bit"),
    (6, "scale-offset"),
    (307, "BZIP2"),
    (32_003, "Snappy"),
    (32_013, "ZFP"),
    (32_017, "SZ"),
    (32_024, "SZ3"),
    (32_026, "Blosc2"),
];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Filter {
    Deflate,
    Shuffle { size: usize },
    Fletcher32,
    Lzf,
    Lz4,
    Zstd,
    Blosc,
    Bitshuffle { size: usize, codec: bitshuffle::Codec },
}

/// The filters of a dataset, in the order in which they were applied.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Pipeline(Vec<Filter>);

/// Buffers for data between two filters, reused for every chunk.
#[derive(Default)]
pub(super) struct Scratch {
    from: Vec<u8>,
    to: Vec<u8>,
}

impl Pipeline {
    /// The filters of a dataset whose elements have `size` bytes.
    ///
    /// # Errors
    /// If a filter is not supported; the error names the filter.
    pub fn new(filters: &[hdf5_pure::Filter], size: usize) -> Result<Self, String> {
        let parse = |filter: &hdf5_pure::Filter| {
            let value = |at: usize| filter.client_data.get(at).copied().unwrap_or(0);
            let element = |at: usize| usize::try_from(value(at)).ok().filter(|&n| n > 0).unwrap_or(size);
            Ok(match filter.id {
                id::DEFLATE => Filter::Deflate,
                id::SHUFFLE => Filter::Shuffle { size: element(0) },
                id::FLETCHER32 => Filter::Fletcher32,
                id::LZF => Filter::Lzf,
                id::LZ4 => Filter::Lz4,
                id::ZSTD => Filter::Zstd,
                id::BLOSC => Filter::Blosc,
                id::BITSHUFFLE => Filter::Bitshuffle { size: element(2), codec: bitshuffle::Codec::new(value(4))? },
                unknown => {
                    let stored = filter.name.as_deref().map(str::trim).filter(|name| !name.is_empty());
                    let known = UNSUPPORTED.iter().find(|(id, _)| *id == unknown).map(|(_, name)| *name);
                    return Err(format!(
                        "its chunks use the unsupported filter {unknown} ({}); `h5repack -f GZIP=4 IN OUT` writes a copy \
                         without it",
                        known.or(stored).unwrap_or("no name")
                    ));
                }
            })
        };
        filters.iter().map(parse).collect::<Result<_, _>>().map(Self)
    }

    /// Whether chunks are stored without filters.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Reverses all filters except those whose bit is set in `skipped`. `out` is as long as the decoded chunk.
    ///
    /// # Errors
    /// If the chunk is damaged.
    pub fn decode(&self, stored: &[u8], skipped: u32, scratch: &mut Scratch, out: &mut [u8]) -> Result<(), String> {
        let applied = |at: usize| at >= 32 || skipped & 1 << at == 0;
        let Scratch { from, to } = scratch;
        // The data that is still encoded is in `stored` at first, then in `from`.
        let mut first = true;
        let mut end = stored.len();
        for at in (0..self.0.len()).rev().filter(|&at| applied(at)) {
            let input = if first { &stored[..end] } else { &from[..end] };
            if self.0[at] == Filter::Fletcher32 {
                end = fletcher32::check(input)?;
                continue;
            }
            let earlier = (0..at).filter(|&at| applied(at));
            let sums = earlier.clone().filter(|&at| self.0[at] == Filter::Fletcher32).count();
            if earlier.count() == 0 {
                return self.0[at].undo(input, out);
            }
            end = out.len() + sums * fletcher32::SIZE;
            to.resize(end, 0);
            self.0[at].undo(input, to)?;
            mem::swap(from, to);
            first = false;
        }
        let rest = if first { &stored[..end] } else { &from[..end] };
        if rest.len() != out.len() {
            return Err(format!("a chunk has {} bytes instead of {}", rest.len(), out.len()));
        }
        out.copy_from_slice(rest);
        Ok(())
    }
}

impl Filter {
    /// Reverses the filter. The decoded data must be exactly as long as `out`.
    fn undo(self, from: &[u8], out: &mut [u8]) -> Result<(), String> {
        match self {
            Self::Deflate => inflate(from, out),
            Self::Shuffle { size } => shuffle::undo(from, size, out),
            Self::Lzf => lzf::decode(from, out),
            Self::Lz4 => lz4_blocks(from, out),
            Self::Zstd => zstd_frame(from, out),
            Self::Blosc => blosc::decode(from, out),
            Self::Bitshuffle { size, codec } => bitshuffle::decode(from, size, codec, out),
            // The data in front of a checksum needs no conversion.
            Self::Fletcher32 => Ok(()),
        }
    }
}

/// Decodes a zlib stream.
fn inflate(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    use flate2::{Decompress, FlushDecompress, Status};
    let mut state = Decompress::new(true);
    let status = state.decompress(from, out, FlushDecompress::Finish).map_err(|e| format!("deflate: {e}"))?;
    if status == Status::StreamEnd && state.total_out() == out.len() as u64 {
        return Ok(());
    }
    Err(format!("deflate: the data ends after {} of {} bytes", state.total_out(), out.len()))
}

/// Decodes an LZ4 block.
fn lz4_block(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let size = lz4_flex::block::decompress_into(from, out).map_err(|e| format!("LZ4: {e}"))?;
    if size == out.len() { Ok(()) } else { Err(format!("LZ4: the data ends after {size} of {} bytes", out.len())) }
}

/// Decodes a Zstandard frame.
fn zstd_frame(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let size = zstd::bulk::decompress_to_buffer(from, out).map_err(|e| format!("Zstandard: {e}"))?;
    if size == out.len() {
        Ok(())
    } else {
        Err(format!("Zstandard: the data ends after {size} of {} bytes", out.len()))
    }
}

/// Decodes the output of the LZ4 filter: total length, block length, then blocks with length prefixes. A block that
/// compression does not shrink is stored uncompressed.
fn lz4_blocks(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let mut input = Input(from);
    let (total, block) = (input.u64_be()?, input.u32_be()? as usize);
    if total != out.len() as u64 || block == 0 {
        return Err(format!("LZ4: the header declares {total} bytes in blocks of {block} instead of {}", out.len()));
    }
    for target in out.chunks_mut(block) {
        let size = input.u32_be()? as usize;
        let bytes = input.take(size)?;
        if size == target.len() { target.copy_from_slice(bytes) } else { lz4_block(bytes, target)? }
    }
    Ok(())
}

/// A reader of consecutive bytes.
struct Input<'a>(&'a [u8]);

impl<'a> Input<'a> {
    fn take(&mut self, size: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self
            .0
            .split_at_checked(size)
            .ok_or_else(|| format!("a chunk ends {} bytes too early", size - self.0.len()))?;
        self.0 = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    fn u64_be(&mut self) -> Result<u64, String> {
        self.array().map(u64::from_be_bytes)
    }

    fn u32_be(&mut self) -> Result<u32, String> {
        self.array().map(u32::from_be_bytes)
    }
}

/// Copies `length` bytes that start `distance` bytes before `at` to `at`. If the ranges overlap, the bytes repeat.
fn copy_match(out: &mut [u8], at: usize, distance: usize, length: usize) -> Result<(), String> {
    if distance > at || distance == 0 || length > out.len() - at {
        return Err(format!("a chunk refers to {distance} bytes before byte {at}, for {length} bytes"));
    }
    if distance >= length {
        out.copy_within(at - distance..at - distance + length, at);
        return Ok(());
    }
    // The repeated part doubles with every copy.
    let (mut done, mut period) = (0, distance);
    while done < length {
        let size = period.min(length - done);
        out.copy_within(at - distance..at - distance + size, at + done);
        done += size;
        period += size;
    }
    Ok(())
}
