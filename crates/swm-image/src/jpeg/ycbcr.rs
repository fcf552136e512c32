//! YCbCr to RGB, sixteen pixels at a time, bit for bit as libjpeg converts.

use swm_simd::{CpuLevel, Level};

/// Samples of sixteen neighbouring pixels of a row.
pub type Samples = [u8; 16];

/// Converts sixteen pixels whose chroma is at half resolution.
///
/// Chroma is interpolated with weights 3/4 (nearest sample) and 1/4 (next sample) in both directions. `us` and `vs` are
/// the nearest row and the next row. Samples 1 to 8 belong to the pixels; samples 0 and 9 are neighbours.
#[inline(always)]
pub fn convert_halved<L: Level>(ys: &Samples, us: [&Samples; 2], vs: [&Samples; 2], out: &mut [u8; 48]) {
    #[cfg(target_arch = "x86_64")]
    if L::CPU >= CpuLevel::Avx2 {
        // SAFETY: the CPU supports AVX2, because it runs this level.
        #[allow(unsafe_code, reason = "calls a function that is compiled for a feature of the CPU")]
        return unsafe { avx2::convert_halved(ys, us, vs, out) };
    }
    let interpolate = |[near, next]: [&Samples; 2]| -> Samples {
        let sum = |i: usize| 3 * u16::from(near[i]) + u16::from(next[i]);
        std::array::from_fn(|i| {
            let middle = 3 * sum(i / 2 + 1);
            let value = if i % 2 == 0 { middle + sum(i / 2) + 8 } else { middle + sum(i / 2 + 2) + 7 };
            (value >> 4) as u8
        })
    };
    convert::<L>(ys, &interpolate(us), &interpolate(vs), out);
}

/// Converts sixteen pixels from YCbCr to RGB, as JFIF defines it and libjpeg rounds it.
#[inline(always)]
pub fn convert<L: Level>(ys: &Samples, us: &Samples, vs: &Samples, out: &mut [u8; 48]) {
    #[cfg(target_arch = "x86_64")]
    if L::CPU >= CpuLevel::Avx2 {
        // SAFETY: the CPU supports AVX2, because it runs this level.
        #[allow(unsafe_code, reason = "calls a function that is compiled for a feature of the CPU")]
        return unsafe { avx2::convert(ys, us, vs, out) };
    }
    for (i, pixel) in out.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let (y, u, v) = (i32::from(ys[i]), i32::from(us[i]) - 128, i32::from(vs[i]) - 128);
        // 1.402, 0.34414, 0.71414 and 1.772, times 2¹⁶.
        let red = (91881 * v + 32768) >> 16;
        let green = (-22554 * u - 46802 * v + 32768) >> 16;
        let blue = (116_130 * u + 32768) >> 16;
        *pixel = [red, green, blue].map(|difference| (y + difference).clamp(0, 255) as u8);
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    //! The conversions of the parent module with AVX2 intrinsics.

    use super::Samples;
    #[allow(clippy::wildcard_imports, reason = "the list of intrinsics would be longer than the code")]
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx2")]
    fn load(bytes: &Samples) -> __m128i {
        let (halves, _) = bytes.as_chunks::<8>();
        _mm_set_epi64x(i64::from_le_bytes(halves[1]), i64::from_le_bytes(halves[0]))
    }

    #[target_feature(enable = "avx2")]
    fn store(value: __m128i, to: &mut [u8]) {
        to[..8].copy_from_slice(&_mm_cvtsi128_si64(value).to_le_bytes());
        to[8..].copy_from_slice(&_mm_extract_epi64::<1>(value).to_le_bytes());
    }

    /// Computes the same result as [`super::convert_halved`].
    #[target_feature(enable = "avx2")]
    pub fn convert_halved(ys: &Samples, us: [&Samples; 2], vs: [&Samples; 2], out: &mut [u8; 48]) {
        pixels(load(ys), interpolate(us), interpolate(vs), out);
    }

    /// Computes the same result as [`super::convert`].
    #[target_feature(enable = "avx2")]
    pub fn convert(ys: &Samples, us: &Samples, vs: &Samples, out: &mut [u8; 48]) {
        pixels(load(ys), load(us), load(vs), out);
    }

    #[target_feature(enable = "avx2")]
    fn interpolate([near, next]: [&Samples; 2]) -> __m128i {
        let (near, next) = (_mm256_cvtepu8_epi16(load(near)), _mm256_cvtepu8_epi16(load(next)));
        let sums = _mm256_add_epi16(_mm256_mullo_epi16(near, _mm256_set1_epi16(3)), next);
        let (left, more) = (_mm256_castsi256_si128(sums), _mm256_extracti128_si256::<1>(sums));
        let middle = _mm_mullo_epi16(_mm_alignr_epi8::<2>(more, left), _mm_set1_epi16(3));
        let right = _mm_alignr_epi8::<4>(more, left);
        let even = _mm_srli_epi16::<4>(_mm_add_epi16(_mm_add_epi16(middle, left), _mm_set1_epi16(8)));
        let odd = _mm_srli_epi16::<4>(_mm_add_epi16(_mm_add_epi16(middle, right), _mm_set1_epi16(7)));
        _mm_or_si128(even, _mm_slli_epi16::<8>(odd))
    }

    #[target_feature(enable = "avx2")]
    fn pixels(y: __m128i, u: __m128i, v: __m128i, out: &mut [u8; 48]) {
        let y = _mm256_cvtepu8_epi16(y);
        let u = _mm256_sub_epi16(_mm256_cvtepu8_epi16(u), _mm256_set1_epi16(128));
        let v = _mm256_sub_epi16(_mm256_cvtepu8_epi16(v), _mm256_set1_epi16(128));
        // 1.402 v = v + 0.402 v and 1.772 u = 2 u − 0.228 u, so that the factors fit 16 bits.
        let scaled = |value: __m256i, factor: i16| {
            let twice = _mm256_mulhi_epi16(_mm256_add_epi16(value, value), _mm256_set1_epi16(factor));
            _mm256_srai_epi16::<1>(_mm256_add_epi16(twice, _mm256_set1_epi16(1)))
        };
        let red = _mm256_add_epi16(_mm256_add_epi16(y, v), scaled(v, 26345));
        let blue = _mm256_add_epi16(_mm256_add_epi16(y, _mm256_add_epi16(u, u)), scaled(u, -14942));
        // 0.34414 u + 0.71414 v = 0.34414 u − 0.28586 v + v.
        let factors = _mm256_set1_epi32((18734 << 16) | (-22554 & 0xffff));
        let green = |pairs: __m256i| {
            _mm256_srai_epi32::<16>(_mm256_add_epi32(_mm256_madd_epi16(pairs, factors), _mm256_set1_epi32(32768)))
        };
        let green = _mm256_packs_epi32(green(_mm256_unpacklo_epi16(u, v)), green(_mm256_unpackhi_epi16(u, v)));
        let green = _mm256_add_epi16(y, _mm256_sub_epi16(green, v));
        let bytes =
            |value: __m256i| _mm_packus_epi16(_mm256_castsi256_si128(value), _mm256_extracti128_si256::<1>(value));
        let (red, green, blue) = (bytes(red), bytes(green), bytes(blue));
        for (part, to) in out.as_chunks_mut::<16>().0.iter_mut().enumerate() {
            let [r, g, b] = SHUFFLES[part];
            let red = _mm_shuffle_epi8(red, _mm_set_epi64x(r[1], r[0]));
            let green = _mm_shuffle_epi8(green, _mm_set_epi64x(g[1], g[0]));
            let blue = _mm_shuffle_epi8(blue, _mm_set_epi64x(b[1], b[0]));
            let pixels = _mm_or_si128(_mm_or_si128(red, green), blue);
            store(pixels, to);
        }
    }

    /// For each third of the output of sixteen pixels, and each channel, the shuffle that moves the channel's bytes to
    /// their positions in the output.
    const SHUFFLES: [[[i64; 2]; 3]; 3] = {
        let mut shuffles = [[[0; 2]; 3]; 3];
        let mut i = 0;
        while i < 3 * 48 {
            let (part, channel, byte) = (i / 48, i / 16 % 3, i % 16);
            let at = part * 16 + byte;
            // An index with its upper bit set gives 0.
            let index = if at % 3 == channel { at as i64 / 3 } else { 0x80 };
            shuffles[part][channel][byte / 8] |= index << (byte % 8 * 8);
            i += 1;
        }
        shuffles
    };
}
