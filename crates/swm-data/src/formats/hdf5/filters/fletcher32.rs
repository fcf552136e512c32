//! The 32-bit Fletcher checksum over big-endian 16-bit words, as HDF5 defines it. The checksum is stored after the
//! data.

/// Size of a checksum in bytes.
pub const SIZE: usize = 4;

/// Number of words between two reductions. The weighted sum of this many words is below 2^32.
const BLOCK: usize = 256;

/// The checksum of `bytes`.
pub fn sum(bytes: &[u8]) -> u32 {
    const MODULUS: u64 = 65_535;
    let (mut plain, mut weighted) = (0_u64, 0_u64);
    let (words, odd) = bytes.as_chunks::<2>();
    for block in words.chunks(BLOCK) {
        // Over a block of n words, the weighted sum grows by n times the previous plain sum, and by n - i times word i
        // of the block, counted from 0.
        let n = block.len() as u32;
        let (mut sum, mut sums) = (0_u32, 0_u32);
        for (&word, weight) in block.iter().zip((1..=n).rev()) {
            let word = u32::from(u16::from_be_bytes(word));
            sum += word;
            sums += word * weight;
        }
        weighted = (weighted + plain * u64::from(n) + u64::from(sums)) % MODULUS;
        plain = (plain + u64::from(sum)) % MODULUS;
    }
    if let [last] = odd {
        plain = (plain + (u64::from(*last) << 8)) % MODULUS;
        weighted = (weighted + plain) % MODULUS;
    }
    // HDF5 folds carries instead of dividing, so the result is the modulus instead of 0, unless all words are 0.
    let fold = |sum: u64, any: bool| if sum == 0 && any { MODULUS } else { sum };
    let any = bytes.iter().any(|&byte| byte != 0);
    (fold(weighted, any) << 16 | fold(plain, any)) as u32
}

/// Verifies the checksum at the end of `bytes`, and returns the length of the data.
pub fn check(bytes: &[u8]) -> Result<usize, String> {
    let Some((summed, stored)) = bytes.split_last_chunk::<SIZE>() else {
        return Err("a chunk is too short for its checksum".to_owned());
    };
    let (stored, found) = (u32::from_le_bytes(*stored), sum(summed));
    if stored == found {
        return Ok(summed.len());
    }
    Err(format!("a chunk's checksum is {found:#010x} instead of {stored:#010x}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computes the checksum word by word, as HDF5's documentation defines it.
    fn word_by_word(bytes: &[u8]) -> u32 {
        let (mut a, mut b) = (0_u32, 0_u32);
        let fold = |sum: u32| (sum & 0xffff) + (sum >> 16);
        for block in bytes.chunks(720) {
            for word in block.chunks(2) {
                a += u32::from(word[0]) << 8 | u32::from(*word.get(1).unwrap_or(&0));
                b += a;
            }
            (a, b) = (fold(a), fold(b));
        }
        (a, b) = (fold(a), fold(b));
        b << 16 | a
    }

    #[test]
    fn checksum_equals_the_word_by_word_sum_and_detects_flipped_bits() {
        for length in [0, 1, 2, 3, 511, 512, 513, 719, 720, 721, 5000, 150_528] {
            let bytes: Vec<u8> = (0..length).map(|i| (i * i / 7 + i) as u8).collect();
            assert_eq!(sum(&bytes), word_by_word(&bytes), "{length}");
            assert_eq!(sum(&vec![255; length]), word_by_word(&vec![255; length]), "{length}");
            assert_eq!(sum(&vec![0; length]), 0);
        }
        let mut bytes = b"some bytes".to_vec();
        bytes.extend(sum(&bytes).to_le_bytes());
        assert_eq!(check(&bytes), Ok(10));
        bytes[3] ^= 1;
        assert!(check(&bytes).expect_err("a flipped bit").contains("checksum"));
        assert!(check(&[1]).is_err());
    }
}
