//! [`Simd`]: eight numbers at once, in AVX2's registers where the processor has them and one by one elsewhere.
//!
//! For loops too short for the compiler to see vectors in them (`simd` serves the long ones). Both give equal bytes: each
//! operation is the same, rounded in the same way.
#![allow(unsafe_code, reason = "AVX2's instructions are used where the processor has them")]

/// Numbers at once.
pub(crate) const LANES: usize = 8;

/// What can be done with eight numbers. A value of such a type shows that the processor can do it.
pub(crate) trait Simd: Copy {
    type Numbers: Copy;
    /// A yes or no for each.
    type Mask: Copy;

    fn load(self, from: &[f32; LANES]) -> Self::Numbers;
    fn splat(self, number: f32) -> Self::Numbers;
    fn add(self, a: Self::Numbers, b: Self::Numbers) -> Self::Numbers;
    fn sub(self, a: Self::Numbers, b: Self::Numbers) -> Self::Numbers;
    fn mul(self, a: Self::Numbers, b: Self::Numbers) -> Self::Numbers;
    fn div(self, a: Self::Numbers, b: Self::Numbers) -> Self::Numbers;
    /// The smaller one, b where one is no number.
    fn min(self, a: Self::Numbers, b: Self::Numbers) -> Self::Numbers;
    /// Whether a >= b, which is no for what is no number.
    fn at_least(self, a: Self::Numbers, b: Self::Numbers) -> Self::Mask;
    /// Whether a > b.
    fn more(self, a: Self::Numbers, b: Self::Numbers) -> Self::Mask;
    fn both(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn either(self, a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn any(self, mask: Self::Mask) -> bool;
    fn store(self, numbers: Self::Numbers, to: &mut [f32; LANES]);
    /// Stores numbers where the mask says so.
    fn put(self, mask: Self::Mask, numbers: Self::Numbers, to: &mut [f32; LANES]);
    /// Stores a word there.
    fn mark(self, mask: Self::Mask, word: u32, to: &mut [u32; LANES]);
}

/// Work that is done with them.
pub(crate) trait Job {
    /// Does it; to be marked `#[inline(always)]`, so that it is compiled for each.
    fn run(self, simd: impl Simd);
}

/// Does it with the best this processor has.
pub(crate) fn run(job: impl Job) {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = avx2::Avx2::here() {
        return simd.run(job);
    }
    job.run(Plain);
}

/// One by one.
#[derive(Clone, Copy)]
pub(crate) struct Plain;

#[inline(always)]
fn each<T>(of: impl FnMut(usize) -> T) -> [T; LANES] {
    std::array::from_fn(of)
}

impl Simd for Plain {
    type Numbers = [f32; LANES];
    type Mask = [bool; LANES];

    #[inline(always)]
    fn load(self, from: &[f32; LANES]) -> [f32; LANES] {
        *from
    }
    #[inline(always)]
    fn splat(self, number: f32) -> [f32; LANES] {
        [number; LANES]
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
    fn at_least(self, a: [f32; LANES], b: [f32; LANES]) -> [bool; LANES] {
        each(|i| a[i] >= b[i])
    }
    #[inline(always)]
    fn more(self, a: [f32; LANES], b: [f32; LANES]) -> [bool; LANES] {
        each(|i| a[i] > b[i])
    }
    #[inline(always)]
    fn both(self, a: [bool; LANES], b: [bool; LANES]) -> [bool; LANES] {
        each(|i| a[i] & b[i])
    }
    #[inline(always)]
    fn either(self, a: [bool; LANES], b: [bool; LANES]) -> [bool; LANES] {
        each(|i| a[i] | b[i])
    }
    #[inline(always)]
    fn any(self, mask: [bool; LANES]) -> bool {
        mask.contains(&true)
    }
    #[inline(always)]
    fn store(self, numbers: [f32; LANES], to: &mut [f32; LANES]) {
        *to = numbers;
    }
    #[inline(always)]
    fn put(self, mask: [bool; LANES], numbers: [f32; LANES], to: &mut [f32; LANES]) {
        *to = each(|i| if mask[i] { numbers[i] } else { to[i] });
    }
    #[inline(always)]
    fn mark(self, mask: [bool; LANES], word: u32, to: &mut [u32; LANES]) {
        *to = each(|i| if mask[i] { word } else { to[i] });
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{Job, LANES, Simd};
    use std::arch::x86_64::{
        __m256, __m256i, _CMP_GE_OQ, _CMP_GT_OQ, _mm256_add_ps, _mm256_and_ps, _mm256_blendv_epi8, _mm256_blendv_ps,
        _mm256_castps_si256, _mm256_cmp_ps, _mm256_div_ps, _mm256_loadu_ps, _mm256_loadu_si256, _mm256_min_ps,
        _mm256_movemask_ps, _mm256_mul_ps, _mm256_or_ps, _mm256_set1_epi32, _mm256_set1_ps, _mm256_storeu_ps,
        _mm256_storeu_si256, _mm256_sub_ps,
    };

    /// Shows that the processor has AVX2.
    #[derive(Clone, Copy)]
    pub(super) struct Avx2(());

    impl Avx2 {
        /// If this processor has it.
        pub(super) fn here() -> Option<Self> {
            crate::simd::avx2().then_some(Self(()))
        }

        pub(super) fn run(self, job: impl Job) {
            #[target_feature(enable = "avx2")]
            fn compiled(job: impl Job, simd: Avx2) {
                job.run(simd);
            }
            // SAFETY: the value shows that the processor has AVX2.
            unsafe { compiled(job, self) }
        }
    }

    // SAFETY of all: the value shows that the processor has AVX2; references are valid, and need not be aligned.
    impl Simd for Avx2 {
        type Numbers = __m256;
        type Mask = __m256;

        #[inline(always)]
        fn load(self, from: &[f32; LANES]) -> __m256 {
            unsafe { _mm256_loadu_ps(from.as_ptr()) }
        }
        #[inline(always)]
        fn splat(self, number: f32) -> __m256 {
            unsafe { _mm256_set1_ps(number) }
        }
        #[inline(always)]
        fn add(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_add_ps(a, b) }
        }
        #[inline(always)]
        fn sub(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_sub_ps(a, b) }
        }
        #[inline(always)]
        fn mul(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_mul_ps(a, b) }
        }
        #[inline(always)]
        fn div(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_div_ps(a, b) }
        }
        #[inline(always)]
        fn min(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_min_ps(a, b) }
        }
        #[inline(always)]
        fn at_least(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_cmp_ps::<_CMP_GE_OQ>(a, b) }
        }
        #[inline(always)]
        fn more(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_cmp_ps::<_CMP_GT_OQ>(a, b) }
        }
        #[inline(always)]
        fn both(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_and_ps(a, b) }
        }
        #[inline(always)]
        fn either(self, a: __m256, b: __m256) -> __m256 {
            unsafe { _mm256_or_ps(a, b) }
        }
        #[inline(always)]
        fn any(self, mask: __m256) -> bool {
            unsafe { _mm256_movemask_ps(mask) != 0 }
        }
        #[inline(always)]
        fn store(self, numbers: __m256, to: &mut [f32; LANES]) {
            unsafe { _mm256_storeu_ps(to.as_mut_ptr(), numbers) }
        }
        #[inline(always)]
        fn put(self, mask: __m256, numbers: __m256, to: &mut [f32; LANES]) {
            unsafe {
                let old = _mm256_loadu_ps(to.as_ptr());
                _mm256_storeu_ps(to.as_mut_ptr(), _mm256_blendv_ps(old, numbers, mask));
            }
        }
        #[inline(always)]
        fn mark(self, mask: __m256, word: u32, to: &mut [u32; LANES]) {
            unsafe {
                let at = to.as_mut_ptr().cast::<__m256i>();
                let (old, new) = (_mm256_loadu_si256(at), _mm256_set1_epi32(word.cast_signed()));
                _mm256_storeu_si256(at, _mm256_blendv_epi8(old, new, _mm256_castps_si256(mask)));
            }
        }
    }
}
