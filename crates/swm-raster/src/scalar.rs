//! Scalar functions that the compiler can vectorise: plain arithmetic with the same bits on every CPU.

/// Returns the nearest integer of a value from 0 to 2^22; the result is arbitrary for other values. Unlike a conversion
/// by `as`, this function vectorises.
#[inline(always)]
pub(crate) fn nearest(x: f32) -> u32 {
    // The sum with 2^23 has the integer in its lowest bits.
    (x + 8_388_608.0).to_bits() & 0x007f_ffff
}

/// Returns the nearest integer as a float, for values from -2^22 to 2^22; a value outside is returned up to rounding.
#[inline(always)]
pub(crate) fn rounded(x: f32) -> f32 {
    (x + 12_582_912.0) - 12_582_912.0
}

/// Returns the largest integer that is not greater than `x`, for values from -2^22 to 2^22.
#[inline(always)]
pub(crate) fn floor(x: f32) -> f32 {
    let near = rounded(x);
    if near > x { near - 1.0 } else { near }
}

/// Returns `base` to the power of `exponent`, for bases from 0 to 1 and exponents from 0 up, with an error of about
/// 1e-5. The function uses plain arithmetic, which gives the same bits on every CPU and vectorises.
#[inline(always)]
pub(crate) fn power(base: f32, exponent: f32) -> f32 {
    let bits = base.max(1e-30).to_bits() as i32;
    // Exponent, and mantissa in [sqrt(1/2), sqrt(2)).
    let shifted = bits - 0x3f35_04f3;
    let integer = (shifted >> 23) as f32;
    let mantissa = f32::from_bits(((shifted & 0x007f_ffff) + 0x3f35_04f3) as u32);
    // ln m = 2 artanh((m - 1) / (m + 1)), by the series of artanh.
    let u = (mantissa - 1.0) / (mantissa + 1.0);
    let v = u * u;
    let log2 = integer + u * (2.885_39 + v * (0.961_796_7 + v * (0.577_078 + v * 0.412_198_6)));
    let x = (exponent * log2).clamp(-126.0, 0.0);
    // Integer part, and fraction from -1/2 to 1/2.
    let integer = rounded(x);
    let f = (x - integer) * std::f32::consts::LN_2;
    let exp =
        1.0 + f * (1.0 + f * (0.5 + f * (0.166_666_67 + f * (0.041_666_67 + f * (0.008_333_334 + f * 0.001_388_889)))));
    exp * f32::from_bits(nearest(integer + 127.0) << 23)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Canvas;
    use crate::scenes::{assets, drawn, scene};
    use proptest::prelude::*;
    use swm_simd::{CpuLevel, limit_cpu_level};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(1000))]
        #[test]
        fn frames_are_equal_with_and_without_avx2(scene in scene()) {
            let with_avx2 = drawn(&mut Canvas::new(), &scene, &assets());
            limit_cpu_level(CpuLevel::Baseline);
            let baseline = drawn(&mut Canvas::new(), &scene, &assets());
            limit_cpu_level(CpuLevel::Avx512);
            prop_assert_eq!(with_avx2, baseline);
        }
    }

    #[test]
    fn rounding_equals_the_standard_library() {
        for x in [0.0, 0.25, 0.75, 1.0, 2.5, 99.9, 4_000_000.0_f32] {
            assert_eq!(f64::from(nearest(x)), f64::from(x.round_ties_even()));
            assert_eq!((rounded(-x), floor(-x), floor(x)), (-x.round_ties_even(), (-x).floor(), x.floor()));
        }
    }

    #[test]
    fn power_is_close_to_powf() {
        for i in 0..=1000u16 {
            let base = f32::from(i) / 1000.0;
            for exponent in [0.0, 0.5, 1.0, 10.0, 64.0, 128.0] {
                let (ours, theirs) = (power(base, exponent), base.powf(exponent));
                assert!((ours - theirs).abs() < 2e-5, "{base}^{exponent}: {ours}, not {theirs}");
            }
        }
    }
}
