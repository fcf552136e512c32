//! [`F32x8`]: eight floats at once, for loops that are too short for the compiler to vectorise.
//!
//! Every implementation computes the same bytes: each operation is IEEE single precision, rounded once.

/// Floats per vector.
pub const LANES: usize = 8;

/// Operations on eight floats. The existence of a value of such a type proves that the CPU supports the operations.
pub trait F32x8: Copy {
    /// Eight floats.
    type Vector: Copy;
    /// A boolean for each lane.
    type Mask: Copy;

    /// Loads eight floats.
    fn load(self, from: &[f32; LANES]) -> Self::Vector;
    /// Returns a vector with `value` in every lane.
    fn splat(self, value: f32) -> Self::Vector;
    /// Returns a + b.
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns a - b.
    fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns a * b.
    fn mul(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns a / b.
    fn div(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns the smaller of a and b, and b where either is NaN.
    fn min(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns a >= b, which is false for NaN.
    fn ge(self, a: Self::Vector, b: Self::Vector) -> Self::Mask;
    /// Returns a > b, which is false for NaN.
    fn gt(self, a: Self::Vector, b: Self::Vector) -> Self::Mask;
    /// Returns a & b.
    fn and(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Returns a | b.
    fn or(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Returns whether the mask is true in any lane.
    fn any(self, mask: Self::Mask) -> bool;
    /// Stores eight floats.
    fn store(self, values: Self::Vector, to: &mut [f32; LANES]);
    /// Stores the lanes of `values` where the mask is true.
    fn store_masked(self, mask: Self::Mask, values: Self::Vector, to: &mut [f32; LANES]);
    /// Stores `word` in the lanes where the mask is true.
    fn store_word_masked(self, mask: Self::Mask, word: u32, to: &mut [u32; LANES]);
}

/// Computes the lanes one after another, on every CPU.
#[derive(Clone, Copy, Debug)]
pub struct Portable;

#[inline(always)]
fn each<T>(lane: impl FnMut(usize) -> T) -> [T; LANES] {
    std::array::from_fn(lane)
}

impl F32x8 for Portable {
    type Vector = [f32; LANES];
    type Mask = [bool; LANES];

    #[inline(always)]
    fn load(self, from: &[f32; LANES]) -> [f32; LANES] {
        *from
    }
    #[inline(always)]
    fn splat(self, value: f32) -> [f32; LANES] {
        [value; LANES]
    }
    #[inline(always)]
    fn add(self, a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
        each(|i| a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
        each(|i| a[i] - b[i])
    }
    #[inline(always)]
    fn mul(self, a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
        each(|i| a[i] * b[i])
    }
    #[inline(always)]
    fn div(self, a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
        each(|i| a[i] / b[i])
    }
    #[inline(always)]
    fn min(self, a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
        each(|i| if a[i] < b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn ge(self, a: [f32; LANES], b: [f32; LANES]) -> [bool; LANES] {
        each(|i| a[i] >= b[i])
    }
    #[inline(always)]
    fn gt(self, a: [f32; LANES], b: [f32; LANES]) -> [bool; LANES] {
        each(|i| a[i] > b[i])
    }
    #[inline(always)]
    fn and(self, a: [bool; LANES], b: [bool; LANES]) -> [bool; LANES] {
        each(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn or(self, a: [bool; LANES], b: [bool; LANES]) -> [bool; LANES] {
        each(|i| a[i] | b[i])
    }
    #[inline(always)]
    fn any(self, mask: [bool; LANES]) -> bool {
        mask.contains(&true)
    }
    #[inline(always)]
    fn store(self, values: [f32; LANES], to: &mut [f32; LANES]) {
        *to = values;
    }
    #[inline(always)]
    fn store_masked(self, mask: [bool; LANES], values: [f32; LANES], to: &mut [f32; LANES]) {
        *to = each(|i| if mask[i] { values[i] } else { to[i] });
    }
    #[inline(always)]
    fn store_word_masked(self, mask: [bool; LANES], word: u32, to: &mut [u32; LANES]) {
        *to = each(|i| if mask[i] { word } else { to[i] });
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use avx2::Avx2Lanes;

#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code, reason = "AVX2 intrinsics, where the CPU supports them")]
mod avx2 {
    use super::{F32x8, LANES};
    use std::arch::x86_64::{
        __m256, __m256i, _CMP_GE_OQ, _CMP_GT_OQ, _mm256_add_ps, _mm256_and_ps, _mm256_blendv_epi8, _mm256_blendv_ps,
        _mm256_castps_si256, _mm256_cmp_ps, _mm256_div_ps, _mm256_loadu_ps, _mm256_loadu_si256, _mm256_min_ps,
        _mm256_movemask_ps, _mm256_mul_ps, _mm256_or_ps, _mm256_set1_epi32, _mm256_set1_ps, _mm256_storeu_ps,
        _mm256_storeu_si256, _mm256_sub_ps,
    };

    /// Proves that the CPU supports AVX2.
    #[derive(Clone, Copy, Debug)]
    pub struct Avx2Lanes(());

    impl Avx2Lanes {
        /// Returns the operations.
        ///
        /// # Safety
        /// The CPU must support AVX2.
        #[inline(always)]
        pub const unsafe fn new() -> Self {
            Self(())
        }
    }

    impl F32x8 for Avx2Lanes {
        type Vector = __m256;
        type Mask = __m256;

        #[inline(always)]
        fn load(self, from: &[f32; LANES]) -> __m256 {
            // SAFETY: the CPU supports AVX2; the reference is valid, and the access need not be aligned.
            unsafe { _mm256_loadu_ps(from.as_ptr()) }
        }
        #[inline(always)]
        fn splat(self, value: f32) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_set1_ps(value) }
        }
        #[inline(always)]
        fn add(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_add_ps(a, b) }
        }
        #[inline(always)]
        fn sub(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_sub_ps(a, b) }
        }
        #[inline(always)]
        fn mul(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_mul_ps(a, b) }
        }
        #[inline(always)]
        fn div(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_div_ps(a, b) }
        }
        #[inline(always)]
        fn min(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_min_ps(a, b) }
        }
        #[inline(always)]
        fn ge(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(a, b) }
        }
        #[inline(always)]
        fn gt(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_cmp_ps::<_CMP_GT_OQ>(a, b) }
        }
        #[inline(always)]
        fn and(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_and_ps(a, b) }
        }
        #[inline(always)]
        fn or(self, a: __m256, b: __m256) -> __m256 {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_or_ps(a, b) }
        }
        #[inline(always)]
        fn any(self, mask: __m256) -> bool {
            // SAFETY: the CPU supports AVX2.
            unsafe { _mm256_movemask_ps(mask) != 0 }
        }
        #[inline(always)]
        fn store(self, values: __m256, to: &mut [f32; LANES]) {
            // SAFETY: the CPU supports AVX2; the reference is valid, and the access need not be aligned.
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), values) }
        }
        #[inline(always)]
        fn store_masked(self, mask: __m256, values: __m256, to: &mut [f32; LANES]) {
            // SAFETY: the CPU supports AVX2; the reference is valid, and the access need not be aligned.
            unsafe {
                let old = _mm256_loadu_ps(to.as_ptr());
                _mm256_storeu_ps(to.as_mut_ptr(), _mm256_blendv_ps(old, values, mask));
            }
        }
        #[inline(always)]
        fn store_word_masked(self, mask: __m256, word: u32, to: &mut [u32; LANES]) {
            // SAFETY: the CPU supports AVX2; the reference is valid, and the access need not be aligned.
            unsafe {
                let at = to.as_mut_ptr().cast::<__m256i>();
                let (old, new) = (_mm256_loadu_si256(at), _mm256_set1_epi32(word.cast_signed()));
                _mm256_storeu_si256(at, _mm256_blendv_epi8(old, new, _mm256_castps_si256(mask)));
            }
        }
    }
}
