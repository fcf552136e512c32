//! The inverse cosine transform of 8 × 8 blocks: the algorithm of Loeffler, Ligtenberg and Moschytz (1989) in integers.
//! The results equal the results of libjpeg's accurate method (`islow`), bit for bit.

use swm_simd::{CpuLevel, Level};

/// The coefficients of a block, times their quantisation steps, `[8, 8]` row-major.
pub type Block = [i16; 64];

/// A row of eight values.
type Row<T> = [T; 8];

/// Factors of the products `a·x + b·y` of two rows that make up the transform, in units of 2⁻¹³. They follow
/// from figure 1 of the paper, with the three-multiplication rotations multiplied out, which is exact in integers.
mod factors {
    pub type Pair = (i16, i16);
    pub const SUM: Pair = (8192, 8192);
    pub const DIFFERENCE: Pair = (8192, -8192);
    /// Factors of rows 2 and 6.
    pub const E2: Pair = (4433, -10704);
    pub const E3: Pair = (10703, 4433);
    /// Factors of two sums: of rows 7 and 3, and of rows 5 and 1.
    pub const Z3: Pair = (-6436, 9633);
    pub const Z4: Pair = (9633, 6437);
    /// Factors of rows 7 and 1.
    pub const O0: Pair = (-4927, -7373);
    pub const O3: Pair = (-7373, 4926);
    /// Factors of rows 5 and 3.
    pub const O1: Pair = (-4176, -20995);
    pub const O2: Pair = (-20995, 4177);
}

/// Number of bits that the first pass rounds away: all fraction bits of the factors except two.
const FIRST: i32 = 11;
/// Number of bits that the second pass rounds away: 13 fraction bits of the factors, 2 fraction bits of the first pass,
/// and 3 bits of the transform's factor of 8.
const SECOND: i32 = 18;

/// Writes the 8 × 8 samples of a block, 128 added, as rows that are `stride` apart.
///
/// # Panics
/// When `to` is shorter than `7 * stride + 8`.
#[inline(always)]
pub fn inverse_dct<L: Level>(block: &Block, to: &mut [u8], stride: usize) {
    #[cfg(target_arch = "x86_64")]
    if L::CPU >= CpuLevel::Avx2 {
        // SAFETY: the CPU supports AVX2, because it runs this level.
        #[allow(unsafe_code, reason = "calls a function that is compiled for a feature of the CPU")]
        return unsafe { avx2::inverse_dct(block, to, stride) };
    }
    portable(block, to, stride);
}

/// [`inverse_dct`] without intrinsics.
fn portable(block: &Block, to: &mut [u8], stride: usize) {
    let mut rows = [[0; 8]; 8];
    rows.as_flattened_mut().copy_from_slice(block);
    let rows = transpose(pass::<SECOND>(transpose(pass::<FIRST>(rows))));
    for (i, row) in rows.iter().enumerate() {
        to[i * stride..][..8].copy_from_slice(&row.map(|value| (value.clamp(-128, 127) + 128) as u8));
    }
}

fn transpose(rows: [Row<i16>; 8]) -> [Row<i16>; 8] {
    std::array::from_fn(|i| rows.map(|row| row[i]))
}

/// Transforms along the first index.
fn pass<const BITS: i32>(x: [Row<i16>; 8]) -> [Row<i16>; 8] {
    use factors::{DIFFERENCE, E2, E3, O0, O1, O2, O3, SUM, Z3, Z4};
    let products = |x: Row<i16>, y: Row<i16>, (a, b): factors::Pair| -> Row<i32> {
        std::array::from_fn(|i| i32::from(x[i]) * i32::from(a) + i32::from(y[i]) * i32::from(b))
    };
    let plus = |a: Row<i32>, b: Row<i32>| -> Row<i32> { std::array::from_fn(|i| a[i].wrapping_add(b[i])) };
    let minus = |a: Row<i32>, b: Row<i32>| -> Row<i32> { std::array::from_fn(|i| a[i].wrapping_sub(b[i])) };
    let sum = |a: Row<i16>, b: Row<i16>| -> Row<i16> { std::array::from_fn(|i| a[i].wrapping_add(b[i])) };

    let (e0, e1) = (products(x[0], x[4], SUM), products(x[0], x[4], DIFFERENCE));
    let (e2, e3) = (products(x[2], x[6], E2), products(x[2], x[6], E3));
    let even = [plus(e0, e3), plus(e1, e2), minus(e1, e2), minus(e0, e3)];
    let (z3, z4) = (sum(x[7], x[3]), sum(x[5], x[1]));
    let (z3, z4) = (products(z3, z4, Z3), products(z3, z4, Z4));
    let odd = [
        plus(products(x[7], x[1], O3), z4),
        plus(products(x[5], x[3], O2), z3),
        plus(products(x[5], x[3], O1), z4),
        plus(products(x[7], x[1], O0), z3),
    ];
    let rounded = |value: Row<i32>| {
        value.map(|value| (value.wrapping_add(1 << (BITS - 1)) >> BITS).clamp(i16::MIN.into(), i16::MAX.into()) as i16)
    };
    std::array::from_fn(|i| rounded(if i < 4 { plus(even[i], odd[i]) } else { minus(even[7 - i], odd[7 - i]) }))
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    //! The transform with AVX2 intrinsics, eight values per register.

    use super::factors::{DIFFERENCE, E2, E3, O0, O1, O2, O3, Pair, SUM, Z3, Z4};
    use super::{Block, FIRST, SECOND};
    #[allow(clippy::wildcard_imports, reason = "the list of intrinsics would be longer than the code")]
    use std::arch::x86_64::*;

    type Rows = [__m128i; 8];

    /// Computes the same result as [`super::portable`].
    #[target_feature(enable = "avx2")]
    pub fn inverse_dct(block: &Block, to: &mut [u8], stride: usize) {
        let mut rows = [_mm_setzero_si128(); 8];
        for (row, from) in rows.iter_mut().zip(block.as_chunks::<8>().0) {
            let [a, b, c, d, e, f, g, h] = *from;
            *row = _mm_setr_epi16(a, b, c, d, e, f, g, h);
        }
        let rows = transpose(pass::<SECOND>(transpose(pass::<FIRST>(rows))));
        for (i, [upper, lower]) in rows.as_chunks::<2>().0.iter().enumerate() {
            // Saturates to -128 ..= 127 and adds 128.
            let both = _mm_xor_si128(_mm_packs_epi16(*upper, *lower), _mm_set1_epi8(-128));
            to[2 * i * stride..][..8].copy_from_slice(&_mm_cvtsi128_si64(both).to_le_bytes());
            to[(2 * i + 1) * stride..][..8].copy_from_slice(&_mm_extract_epi64::<1>(both).to_le_bytes());
        }
    }

    /// Interleaves two rows into eight pairs.
    #[target_feature(enable = "avx2")]
    fn pairs(x: __m128i, y: __m128i) -> __m256i {
        _mm256_set_m128i(_mm_unpackhi_epi16(x, y), _mm_unpacklo_epi16(x, y))
    }

    #[target_feature(enable = "avx2")]
    fn products(pairs: __m256i, (a, b): Pair) -> __m256i {
        let [[a0, a1], [b0, b1]] = [a.to_le_bytes(), b.to_le_bytes()];
        _mm256_madd_epi16(pairs, _mm256_set1_epi32(i32::from_le_bytes([a0, a1, b0, b1])))
    }

    #[target_feature(enable = "avx2")]
    fn pass<const BITS: i32>(x: Rows) -> Rows {
        let (first, second) = (pairs(x[0], x[4]), pairs(x[2], x[6]));
        let (e0, e1) = (products(first, SUM), products(first, DIFFERENCE));
        let (e2, e3) = (products(second, E2), products(second, E3));
        let even =
            [_mm256_add_epi32(e0, e3), _mm256_add_epi32(e1, e2), _mm256_sub_epi32(e1, e2), _mm256_sub_epi32(e0, e3)];
        let sums = pairs(_mm_add_epi16(x[7], x[3]), _mm_add_epi16(x[5], x[1]));
        let (z3, z4) = (products(sums, Z3), products(sums, Z4));
        let (outer, inner) = (pairs(x[7], x[1]), pairs(x[5], x[3]));
        let odd = [
            _mm256_add_epi32(products(outer, O3), z4),
            _mm256_add_epi32(products(inner, O2), z3),
            _mm256_add_epi32(products(inner, O1), z4),
            _mm256_add_epi32(products(outer, O0), z3),
        ];
        let half = _mm256_set1_epi32(1 << (BITS - 1));
        let mut out = x;
        for i in 0..4 {
            let even = _mm256_add_epi32(even[i], half);
            let upper = _mm256_srai_epi32::<BITS>(_mm256_add_epi32(even, odd[i]));
            let lower = _mm256_srai_epi32::<BITS>(_mm256_sub_epi32(even, odd[i]));
            // Packing works on each half of a register, which leaves the inner quarters swapped.
            let both = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_packs_epi32(upper, lower));
            out[i] = _mm256_castsi256_si128(both);
            out[7 - i] = _mm256_extracti128_si256::<1>(both);
        }
        out
    }

    #[target_feature(enable = "avx2")]
    fn transpose(x: Rows) -> Rows {
        let mut one = x;
        for i in 0..4 {
            one[2 * i] = _mm_unpacklo_epi16(x[i], x[i + 4]);
            one[2 * i + 1] = _mm_unpackhi_epi16(x[i], x[i + 4]);
        }
        let mut two = x;
        for i in 0..4 {
            two[2 * i] = _mm_unpacklo_epi16(one[i], one[i + 4]);
            two[2 * i + 1] = _mm_unpackhi_epi16(one[i], one[i + 4]);
        }
        let mut three = x;
        for i in 0..4 {
            three[2 * i] = _mm_unpacklo_epi16(two[i], two[i + 4]);
            three[2 * i + 1] = _mm_unpackhi_epi16(two[i], two[i + 4]);
        }
        three
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::{avx2, portable};

    #[test]
    fn avx2_and_portable_inverse_dct_agree() {
        if swm_simd::cpu_level() < swm_simd::CpuLevel::Avx2 {
            return;
        }
        let mut seed = 7_u32;
        for round in 0..3000 {
            let block = std::array::from_fn(|_| {
                seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                // Most values are 0. The largest values exceed the values of images.
                if seed >> 30 == 0 { (seed as i32 >> 15 >> (round % 16)) as i16 } else { 0 }
            });
            let (mut plain, mut fast) = ([0; 80], [0; 80]);
            portable(&block, &mut plain, 9);
            // SAFETY: the CPU supports AVX2.
            #[allow(unsafe_code, reason = "calls a function that is compiled for a feature of the CPU")]
            unsafe {
                avx2::inverse_dct(&block, &mut fast, 9);
            }
            assert_eq!(plain, fast, "{block:?}");
        }
    }
}
