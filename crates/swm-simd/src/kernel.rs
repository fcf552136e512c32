//! Kernels: computations that are compiled for every level and dispatched at run time.

use crate::{CpuLevel, F32x8, F32x16, Portable, Portable16};

/// The instruction set that a kernel is compiled for.
///
/// Only this module implements the trait, and only the dispatch functions name the implementing types, so a kernel that
/// is generic over `Level` runs only on CPUs that support the level.
pub trait Level: sealed::Sealed {
    /// The CPU level of the instruction set.
    const CPU: CpuLevel;
    /// Whether [`Level::fma`] is one instruction on this level.
    const FUSED: bool;
    /// The implementation of the operations on eight floats.
    type F32x8: F32x8;
    /// The implementation of the operations on sixteen floats.
    type F32x16: F32x16;

    /// Returns the operations on eight floats.
    fn f32x8() -> Self::F32x8;

    /// Returns the operations on sixteen floats.
    fn f32x16() -> Self::F32x16;

    /// Returns `a * b + c`, rounded once where [`Level::FUSED`] and twice elsewhere.
    #[inline(always)]
    fn fma(a: f32, b: f32, c: f32) -> f32 {
        if Self::FUSED { a.mul_add(b, c) } else { a * b + c }
    }
}

mod sealed {
    /// Prevents implementations of [`super::Level`] elsewhere, on which the soundness of intrinsics in kernels depends.
    pub trait Sealed {}
}

/// A computation that is compiled for every level. Every function that it calls must be `#[inline(always)]`, so that
/// the compiler compiles the function for the level as well.
pub trait Kernel {
    /// The result of the computation.
    type Output;

    /// Runs the computation. Implementations are `#[inline(always)]`.
    fn run<L: Level>(self) -> Self::Output;
}

/// Instructions that every CPU of the architecture supports.
struct Baseline;

impl sealed::Sealed for Baseline {}

impl Level for Baseline {
    const CPU: CpuLevel = CpuLevel::Baseline;
    const FUSED: bool = cfg!(target_arch = "aarch64");
    type F32x8 = Portable;
    type F32x16 = Portable16;

    #[inline(always)]
    fn f32x8() -> Portable {
        Portable
    }

    #[inline(always)]
    fn f32x16() -> Portable16 {
        Portable16
    }
}

/// Runs a kernel at the best level that the CPU supports.
#[inline]
pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    if crate::cpu_level() == CpuLevel::Avx512 {
        // SAFETY: the CPU supports every feature that the function is compiled for.
        #[allow(unsafe_code, reason = "calls a function that is compiled for features of the CPU")]
        return unsafe { x86::run_avx512(kernel) };
    }
    dispatch_avx2(kernel)
}

/// Runs a kernel at AVX2 where the CPU supports it and at the baseline elsewhere, for kernels that AVX-512 does not
/// make faster.
#[inline]
pub fn dispatch_avx2<K: Kernel>(kernel: K) -> K::Output {
    #[cfg(target_arch = "x86_64")]
    if crate::cpu_level() >= CpuLevel::Avx2 {
        // SAFETY: the CPU supports every feature that the function is compiled for.
        #[allow(unsafe_code, reason = "calls a function that is compiled for features of the CPU")]
        return unsafe { x86::run_avx2(kernel) };
    }
    kernel.run::<Baseline>()
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Kernel, Level, sealed::Sealed};
    use crate::CpuLevel;
    use crate::f32x8::Avx2Lanes;
    use crate::f32x16::{Avx2Pair, Avx512Lanes};

    struct Avx2;

    impl Sealed for Avx2 {}

    impl Level for Avx2 {
        const CPU: CpuLevel = CpuLevel::Avx2;
        const FUSED: bool = true;
        type F32x8 = Avx2Lanes;
        type F32x16 = Avx2Pair;

        #[inline(always)]
        fn f32x8() -> Avx2Lanes {
            // SAFETY: only `run_avx2` names this level, and `dispatch_avx2` calls it only where the CPU supports AVX2.
            #[allow(unsafe_code, reason = "the level shows that the CPU supports AVX2")]
            unsafe {
                Avx2Lanes::new()
            }
        }

        #[inline(always)]
        fn f32x16() -> Avx2Pair {
            // SAFETY: only `run_avx2` names this level, and `dispatch_avx2` calls it only where the CPU supports AVX2 and
            // FMA.
            #[allow(unsafe_code, reason = "the level shows that the CPU supports AVX2 and FMA")]
            unsafe {
                Avx2Pair::new()
            }
        }
    }

    struct Avx512;

    impl Sealed for Avx512 {}

    impl Level for Avx512 {
        const CPU: CpuLevel = CpuLevel::Avx512;
        const FUSED: bool = true;
        type F32x8 = Avx2Lanes;
        type F32x16 = Avx512Lanes;

        #[inline(always)]
        fn f32x8() -> Avx2Lanes {
            // SAFETY: only `run_avx512` names this level, and `dispatch` calls it only where the CPU supports AVX-512
            // and AVX2.
            #[allow(unsafe_code, reason = "the level shows that the CPU supports AVX2")]
            unsafe {
                Avx2Lanes::new()
            }
        }

        #[inline(always)]
        fn f32x16() -> Avx512Lanes {
            // SAFETY: only `run_avx512` names this level, and `dispatch` calls it only where the CPU supports AVX-512.
            #[allow(unsafe_code, reason = "the level shows that the CPU supports AVX-512")]
            unsafe {
                Avx512Lanes::new()
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx2,fma,bmi1,bmi2")]
    pub fn run_avx512<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx512>()
    }

    #[target_feature(enable = "avx2,fma,bmi1,bmi2")]
    pub fn run_avx2<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx2>()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Sum<'a>(&'a [f32]);

    impl Kernel for Sum<'_> {
        type Output = (f32, CpuLevel);

        #[inline(always)]
        fn run<L: Level>(self) -> (f32, CpuLevel) {
            (self.0.iter().sum(), L::CPU)
        }
    }

    #[test]
    fn kernels_run_at_the_level_of_the_cpu() {
        let values = [1.0, 2.5, 4.0];
        assert_eq!(dispatch(Sum(&values)), (7.5, crate::cpu_level()));
        assert_eq!(dispatch_avx2(Sum(&values)), (7.5, crate::cpu_level().min(CpuLevel::Avx2)));
    }

    struct Operations;

    impl Kernel for Operations {
        type Output = Vec<[f32; 16]>;

        #[inline(always)]
        fn run<L: Level>(self) -> Vec<[f32; 16]> {
            let simd = L::f32x16();
            let a = simd.load(&std::array::from_fn(|i| i as f32 - 7.0));
            let (b, c) = (simd.load(&std::array::from_fn(|i| 3.0 * i as f32 - 20.0)), simd.splat(0.5));
            let results =
                [simd.add(a, b), simd.sub(a, b), simd.fma(a, b, c), simd.max(a, b), simd.where_positive(a, b)];
            let mut stored = [[0.0; 16]; 5];
            results.into_iter().zip(&mut stored).for_each(|(result, to)| simd.store(result, to));
            stored.to_vec()
        }
    }

    #[test]
    fn sixteen_floats_have_the_same_values_at_every_level() {
        let lanes = |value: fn(f32, f32) -> f32| std::array::from_fn(|i| value(i as f32 - 7.0, 3.0 * i as f32 - 20.0));
        let expected = [
            lanes(|a, b| a + b),
            lanes(|a, b| a - b),
            lanes(|a, b| a * b + 0.5),
            lanes(f32::max),
            lanes(|a, b| if a > 0.0 { b } else { 0.0 }),
        ];
        assert_eq!(dispatch(Operations), expected);
        assert_eq!(dispatch_avx2(Operations), expected);
        assert_eq!(Operations.run::<Baseline>(), expected);
    }
}
