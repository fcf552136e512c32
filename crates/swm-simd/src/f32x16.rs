//! [`F32x16`]: sixteen floats at once, for kernels that keep their sums in registers.

/// Floats per vector.
pub const LANES16: usize = 16;

/// Operations on sixteen floats. The existence of a value of such a type proves that the CPU supports the operations.
pub trait F32x16: Copy {
    /// Sixteen floats.
    type Vector: Copy;

    /// Loads sixteen floats.
    fn load(self, from: &[f32; LANES16]) -> Self::Vector;
    /// Returns a vector with `value` in every lane.
    fn splat(self, value: f32) -> Self::Vector;
    /// Returns a + b.
    fn add(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns a - b.
    fn sub(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns `a * b + c`, rounded once where the CPU has the instruction and twice elsewhere.
    fn fma(self, a: Self::Vector, b: Self::Vector, c: Self::Vector) -> Self::Vector;
    /// Returns the larger of a and b, and b where either is NaN.
    fn max(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Returns b where a > 0, and 0 elsewhere.
    fn where_positive(self, a: Self::Vector, b: Self::Vector) -> Self::Vector;
    /// Stores sixteen floats.
    fn store(self, values: Self::Vector, to: &mut [f32; LANES16]);
}

/// Computes the lanes one after another, on every CPU.
#[derive(Clone, Copy, Debug)]
pub struct Portable16;

#[inline(always)]
fn each(lane: impl FnMut(usize) -> f32) -> [f32; LANES16] {
    std::array::from_fn(lane)
}

impl F32x16 for Portable16 {
    type Vector = [f32; LANES16];

    #[inline(always)]
    fn load(self, from: &[f32; LANES16]) -> [f32; LANES16] {
        *from
    }
    #[inline(always)]
    fn splat(self, value: f32) -> [f32; LANES16] {
        [value; LANES16]
    }
    #[inline(always)]
    fn add(self, a: [f32; LANES16], b: [f32; LANES16]) -> [f32; LANES16] {
        each(|i| a[i] + b[i])
    }
    #[inline(always)]
    fn sub(self, a: [f32; LANES16], b: [f32; LANES16]) -> [f32; LANES16] {
        each(|i| a[i] - b[i])
    }
    #[inline(always)]
    fn fma(self, a: [f32; LANES16], b: [f32; LANES16], c: [f32; LANES16]) -> [f32; LANES16] {
        each(|i| if cfg!(target_arch = "aarch64") { a[i].mul_add(b[i], c[i]) } else { a[i] * b[i] + c[i] })
    }
    #[inline(always)]
    fn max(self, a: [f32; LANES16], b: [f32; LANES16]) -> [f32; LANES16] {
        each(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    fn where_positive(self, a: [f32; LANES16], b: [f32; LANES16]) -> [f32; LANES16] {
        each(|i| if a[i] > 0.0 { b[i] } else { 0.0 })
    }
    #[inline(always)]
    fn store(self, values: [f32; LANES16], to: &mut [f32; LANES16]) {
        *to = values;
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::{Avx2Pair, Avx512Lanes};

#[cfg(target_arch = "x86_64")]
#[allow(unsafe_code, reason = "AVX2 and AVX-512 intrinsics, where the CPU supports them")]
mod x86 {
    use super::{F32x16, LANES16};
    use std::arch::x86_64::{
        __m256, __m512, _CMP_GT_OQ, _mm256_add_ps, _mm256_and_ps, _mm256_cmp_ps, _mm256_fmadd_ps, _mm256_loadu_ps,
        _mm256_max_ps, _mm256_set1_ps, _mm256_setzero_ps, _mm256_storeu_ps, _mm256_sub_ps, _mm512_add_ps,
        _mm512_cmp_ps_mask, _mm512_fmadd_ps, _mm512_loadu_ps, _mm512_maskz_mov_ps, _mm512_max_ps, _mm512_set1_ps,
        _mm512_setzero_ps, _mm512_storeu_ps, _mm512_sub_ps,
    };

    /// Proves that the CPU supports AVX2 and FMA; a vector is a pair of registers.
    #[derive(Clone, Copy, Debug)]
    pub struct Avx2Pair(());

    impl Avx2Pair {
        /// Returns the operations.
        ///
        /// # Safety
        /// The CPU must support AVX2 and FMA.
        #[inline(always)]
        pub const unsafe fn new() -> Self {
            Self(())
        }
    }

    impl F32x16 for Avx2Pair {
        type Vector = [__m256; 2];

        #[inline(always)]
        fn load(self, from: &[f32; LANES16]) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2; both halves are in the array, and the access need not be aligned.
            unsafe { [_mm256_loadu_ps(from.as_ptr()), _mm256_loadu_ps(from.as_ptr().add(8))] }
        }
        #[inline(always)]
        fn splat(self, value: f32) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2.
            unsafe { [_mm256_set1_ps(value); 2] }
        }
        #[inline(always)]
        fn add(self, a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2.
            unsafe { [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])] }
        }
        #[inline(always)]
        fn sub(self, a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2.
            unsafe { [_mm256_sub_ps(a[0], b[0]), _mm256_sub_ps(a[1], b[1])] }
        }
        #[inline(always)]
        fn fma(self, a: [__m256; 2], b: [__m256; 2], c: [__m256; 2]) -> [__m256; 2] {
            // SAFETY: the CPU supports FMA.
            unsafe { [_mm256_fmadd_ps(a[0], b[0], c[0]), _mm256_fmadd_ps(a[1], b[1], c[1])] }
        }
        #[inline(always)]
        fn max(self, a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2.
            unsafe { [_mm256_max_ps(a[0], b[0]), _mm256_max_ps(a[1], b[1])] }
        }
        #[inline(always)]
        fn where_positive(self, a: [__m256; 2], b: [__m256; 2]) -> [__m256; 2] {
            // SAFETY: the CPU supports AVX2.
            unsafe {
                let zero = _mm256_setzero_ps();
                [0, 1].map(|i| _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(a[i], zero), b[i]))
            }
        }
        #[inline(always)]
        fn store(self, values: [__m256; 2], to: &mut [f32; LANES16]) {
            // SAFETY: the CPU supports AVX2; both halves are in the array, and the access need not be aligned.
            unsafe {
                _mm256_storeu_ps(to.as_mut_ptr(), values[0]);
                _mm256_storeu_ps(to.as_mut_ptr().add(8), values[1]);
            }
        }
    }

    /// Proves that the CPU supports AVX-512.
    #[derive(Clone, Copy, Debug)]
    pub struct Avx512Lanes(());

    impl Avx512Lanes {
        /// Returns the operations.
        ///
        /// # Safety
        /// The CPU must support AVX-512 F.
        #[inline(always)]
        pub const unsafe fn new() -> Self {
            Self(())
        }
    }

    impl F32x16 for Avx512Lanes {
        type Vector = __m512;

        #[inline(always)]
        fn load(self, from: &[f32; LANES16]) -> __m512 {
            // SAFETY: the CPU supports AVX-512; the reference is valid, and the access need not be aligned.
            unsafe { _mm512_loadu_ps(from.as_ptr()) }
        }
        #[inline(always)]
        fn splat(self, value: f32) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_set1_ps(value) }
        }
        #[inline(always)]
        fn add(self, a: __m512, b: __m512) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_add_ps(a, b) }
        }
        #[inline(always)]
        fn sub(self, a: __m512, b: __m512) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_sub_ps(a, b) }
        }
        #[inline(always)]
        fn fma(self, a: __m512, b: __m512, c: __m512) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_fmadd_ps(a, b, c) }
        }
        #[inline(always)]
        fn max(self, a: __m512, b: __m512) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_max_ps(a, b) }
        }
        #[inline(always)]
        fn where_positive(self, a: __m512, b: __m512) -> __m512 {
            // SAFETY: the CPU supports AVX-512.
            unsafe { _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(a, _mm512_setzero_ps()), b) }
        }
        #[inline(always)]
        fn store(self, values: __m512, to: &mut [f32; LANES16]) {
            // SAFETY: the CPU supports AVX-512; the reference is valid, and the access need not be aligned.
            unsafe { _mm512_storeu_ps(to.as_mut_ptr(), values) }
        }
    }
}
