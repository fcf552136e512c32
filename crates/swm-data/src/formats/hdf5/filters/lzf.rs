//! LZF, Marc Lehmann's fast codec. It is part of h5py, which therefore reads LZF without plugins.
//!
//! The format is a stream of instructions. A byte `n` below 32 is followed by `n + 1` literals. Any other byte starts a
//! match, a copy of earlier output. The upper three bits of that byte are the length less 2 (7 means that the next byte
//! is added to the length). The lower five bits, followed by the last byte of the match, are the distance less 1.

use super::copy_match;

const MAX_LITERALS: usize = 32;
const MAX_DISTANCE: usize = 1 << 13;
const MAX_LENGTH: usize = 264;
/// Length in bytes up to which a match is copied with a constant length.
const SHORT: usize = 16;
/// Number of bits of the hash that addresses the table of positions. The hash covers the three bytes at a position.
const TABLE_BITS: u32 = 14;

/// Decodes a chunk into `out`, which has the decoded length of the chunk.
pub fn decode(from: &[u8], out: &mut [u8]) -> Result<(), String> {
    let cut = || "LZF: the chunk is truncated".to_owned();
    let (mut i, mut at) = (0, 0);
    while let Some(&control) = from.get(i) {
        let control = usize::from(control);
        i += 1;
        if control < MAX_LITERALS {
            let length = control + 1;
            let literals = from.get(i..i + length).ok_or_else(cut)?;
            if length > out.len() - at {
                return Err("LZF: the data exceeds the chunk".to_owned());
            }
            // If both buffers have space, copies the maximum length, because a constant length compiles to two moves
            // instead of a call.
            match (from[i..].first_chunk::<MAX_LITERALS>(), out[at..].first_chunk_mut::<MAX_LITERALS>()) {
                (Some(literals), Some(target)) => *target = *literals,
                _ => out[at..at + length].copy_from_slice(literals),
            }
            (i, at) = (i + length, at + length);
        } else {
            let mut length = control >> 5;
            if length == 7 {
                length += usize::from(*from.get(i).ok_or_else(cut)?);
                i += 1;
            }
            let distance = ((control & 31) << 8 | usize::from(*from.get(i).ok_or_else(cut)?)) + 1;
            i += 1;
            length += 2;
            // Most matches are short, and are also copied with a constant length.
            match out.split_at_mut_checked(at) {
                Some((before, target))
                    if length <= SHORT && (SHORT..=at).contains(&distance) && target.len() >= SHORT =>
                {
                    target[..SHORT].copy_from_slice(&before[at - distance..at - distance + SHORT]);
                }
                _ => copy_match(out, at, distance, length)?,
            }
            at += length;
        }
    }
    if at == out.len() { Ok(()) } else { Err(format!("LZF: the data ends after {at} of {} bytes", out.len())) }
}

/// The state of an encoder, reused between chunks.
pub struct Encoder(Box<[u32; 1 << TABLE_BITS]>);

impl Default for Encoder {
    fn default() -> Self {
        Self(Box::new([0; 1 << TABLE_BITS]))
    }
}

impl Encoder {
    /// Appends the encoded bytes to `out` and returns `true`, if encoding saves at least a third. Otherwise appends
    /// nothing and returns `false`, because uncompressed bytes are read faster.
    pub fn encode(&mut self, bytes: &[u8], out: &mut Vec<u8>) -> bool {
        let begin = out.len();
        let most = bytes.len() / 3 * 2;
        self.0.fill(0);
        let (mut at, mut literals) = (0, 0);
        while at + 2 < bytes.len() {
            let key = [bytes[at], bytes[at + 1], bytes[at + 2]];
            let hash = (u32::from_le_bytes([key[0], key[1], key[2], 0]).wrapping_mul(0x9e37_79b1)) >> (32 - TABLE_BITS);
            // The table stores positions plus one; 0 means that there is no position.
            let slot = &mut self.0[hash as usize];
            let before = (*slot as usize).checked_sub(1);
            *slot = at as u32 + 1;
            let found = before.filter(|&before| at - before <= MAX_DISTANCE && bytes[before..before + 3] == key);
            let Some(before) = found else {
                at += 1;
                continue;
            };
            let longest = MAX_LENGTH.min(bytes.len() - at);
            let length = common_prefix(&bytes[before..], &bytes[at..at + longest]);
            write_literals(&bytes[literals..at], out);
            write_match(at - before, length, out);
            at += length;
            literals = at;
            if out.len() - begin > most {
                break;
            }
        }
        write_literals(&bytes[literals..], out);
        let smaller = out.len() - begin <= most;
        if !smaller {
            out.truncate(begin);
        }
        smaller
    }
}

/// Length of the common prefix of `a` and `b`. Compares eight bytes at a time.
fn common_prefix(a: &[u8], b: &[u8]) -> usize {
    let words = a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0);
    for (i, (x, y)) in words.enumerate() {
        let differ = u64::from_le_bytes(*x) ^ u64::from_le_bytes(*y);
        if differ != 0 {
            return i * 8 + differ.trailing_zeros() as usize / 8;
        }
    }
    let whole = a.len().min(b.len()) / 8 * 8;
    whole + a[whole..].iter().zip(&b[whole..]).take_while(|(x, y)| x == y).count()
}

fn write_literals(literals: &[u8], out: &mut Vec<u8>) {
    for run in literals.chunks(MAX_LITERALS) {
        out.push(run.len() as u8 - 1);
        out.extend(run);
    }
}

fn write_match(distance: usize, length: usize, out: &mut Vec<u8>) {
    let (distance, length) = (distance - 1, length - 2);
    if length < 7 {
        out.push((length << 5 | distance >> 8) as u8);
    } else {
        out.extend([(7 << 5 | distance >> 8) as u8, (length - 7) as u8]);
    }
    out.push(distance as u8);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn encoded_chunks_round_trip(
            seed in prop::collection::vec(any::<u8>(), 1..40),
            repeats in 0_usize..300,
            noise in prop::collection::vec(any::<u8>(), 0..9000),
            tail in prop::collection::vec(0_u8..3, 0..600),
        ) {
            let mut bytes: Vec<u8> = seed.iter().copied().cycle().take(seed.len() * repeats).collect();
            bytes.extend(&noise);
            bytes.extend(&tail);
            bytes.extend(seed.iter().copied().cycle().take(1000));
            let mut encoder = Encoder::default();
            let mut encoded = vec![9];
            if encoder.encode(&bytes, &mut encoded) {
                let mut out = vec![0; bytes.len()];
                prop_assert_eq!(decode(&encoded[1..], &mut out), Ok(()));
                prop_assert_eq!(out, bytes);
            } else {
                prop_assert_eq!(encoded, [9]);
            }
        }
    }

    #[test]
    fn short_input_is_not_encoded_and_damaged_chunks_are_rejected() {
        let mut encoder = Encoder::default();
        let mut out = vec![];
        assert!(!encoder.encode(&[1, 2, 3, 4], &mut out) && out.is_empty());
        assert!(encoder.encode(&[7; 1000], &mut out) && out.len() < 20, "{out:?}");
        for cut in 0..out.len() {
            assert!(decode(&out[..cut], &mut [0; 1000]).is_err());
        }
        assert!(decode(&out, &mut [0; 999]).is_err() && decode(&out, &mut [0; 1001]).is_err());
        assert!(decode(&[0x20, 0], &mut [0; 3]).expect_err("a match before the start").contains("before"));
    }
}
