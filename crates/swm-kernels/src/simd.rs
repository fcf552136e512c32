//! The choice of the instruction set at run time.
//!
//! Kernels are plain loops over arrays of sixteen elements. [`dispatch`] compiles each kernel for every [`Level`] and
//! runs the best one that the machine supports; the compiler vectorises the loops. All levels add in the same order, so
//! the levels that fuse multiplication and addition compute the same bytes.

/// Properties of an instruction set.
pub(crate) trait Level {
    /// Rows of a matrix product that fit into the registers at once.
    const ROWS: usize;
    /// Whether multiplication and addition are one instruction.
    const FUSED: bool;

    /// Returns `a * b + c`.
    #[inline(always)]
    fn fma(a: f32, b: f32, c: f32) -> f32 {
        if Self::FUSED { a.mul_add(b, c) } else { a * b + c }
    }
}

/// A computation that is compiled for every level. Every function it calls is `#[inline(always)]`, so that it is compiled
/// for the level, too.
pub(crate) trait Kernel {
    /// The result.
    type Output;

    /// Runs the computation.
    fn run<L: Level>(self) -> Self::Output;
}

/// Instructions that every machine of the architecture supports.
struct Baseline;

impl Level for Baseline {
    const ROWS: usize = if cfg!(target_arch = "aarch64") { 6 } else { 2 };
    const FUSED: bool = cfg!(target_arch = "aarch64");
}

/// Runs a kernel at the best level that the machine supports.
#[cfg(not(target_arch = "x86_64"))]
#[inline(always)]
pub(crate) fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Baseline>()
}

#[cfg(target_arch = "x86_64")]
pub(crate) use x86::dispatch;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Baseline, Kernel, Level};

    /// 32 registers of 16 elements.
    struct Avx512;

    impl Level for Avx512 {
        const ROWS: usize = 12;
        const FUSED: bool = true;
    }

    /// 16 registers of 8 elements.
    struct Avx2;

    impl Level for Avx2 {
        const ROWS: usize = 6;
        const FUSED: bool = true;
    }

    #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx2,fma")]
    fn avx512<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx512>()
    }

    #[target_feature(enable = "avx2,fma")]
    fn avx2<K: Kernel>(kernel: K) -> K::Output {
        kernel.run::<Avx2>()
    }

    /// Runs a kernel at the best level that the machine supports.
    #[allow(unsafe_code, reason = "functions compiled for detected features can only be called unsafely")]
    pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
        // The standard library caches the detected features: each check is one load.
        let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        if has_avx2
            && is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl")
        {
            // SAFETY: the machine supports every feature that the function is compiled for.
            unsafe { avx512(kernel) }
        } else if has_avx2 {
            // SAFETY: the machine supports AVX2 and FMA, which the function is compiled for.
            unsafe { avx2(kernel) }
        } else {
            kernel.run::<Baseline>()
        }
    }
}
