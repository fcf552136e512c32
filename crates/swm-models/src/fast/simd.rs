//! The instruction set of the machine, chosen when the program runs.
//!
//! Kernels are plain loops over arrays of sixteen numbers. [`dispatch`] compiles each for every [`Level`] and runs it at the
//! best the machine has; the compiler turns the loops into vectors. Where multiplication and addition are fused, every
//! level computes the same bytes: all of them add in the same order.

/// What a kernel may count on.
pub(super) trait Level {
    /// Rows of a product that registers hold at once.
    const ROWS: usize;
    /// Whether multiplication and addition are one instruction.
    const FUSED: bool;

    /// `a * b + c`.
    #[inline(always)]
    fn fma(a: f32, b: f32, c: f32) -> f32 {
        if Self::FUSED { a.mul_add(b, c) } else { a * b + c }
    }
}

/// What runs at any level. Everything it calls is `#[inline(always)]`, so that it is compiled for the level, too.
pub(super) trait Kernel {
    /// What it returns.
    type Output;

    /// Runs it.
    fn run<L: Level>(self) -> Self::Output;
}

/// What every machine of an architecture has.
struct Baseline;

impl Level for Baseline {
    const ROWS: usize = if cfg!(target_arch = "aarch64") { 6 } else { 2 };
    const FUSED: bool = cfg!(target_arch = "aarch64");
}

/// Runs a kernel at the best level of the machine.
#[cfg(not(target_arch = "x86_64"))]
#[inline(always)]
pub(super) fn dispatch<K: Kernel>(kernel: K) -> K::Output {
    kernel.run::<Baseline>()
}

#[cfg(target_arch = "x86_64")]
pub(super) use x86::dispatch;

#[cfg(target_arch = "x86_64")]
mod x86 {
    use super::{Baseline, Kernel, Level};

    /// 32 registers of 16 numbers.
    struct Avx512;

    impl Level for Avx512 {
        const ROWS: usize = 12;
        const FUSED: bool = true;
    }

    /// 16 registers of 8 numbers.
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

    /// Runs a kernel at the best level of the machine.
    #[allow(unsafe_code)]
    pub fn dispatch<K: Kernel>(kernel: K) -> K::Output {
        // The answers are cached by the standard library: asking costs a load each.
        let has_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        if has_avx2
            && is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl")
        {
            // SAFETY: the machine has every feature the function is compiled for.
            unsafe { avx512(kernel) }
        } else if has_avx2 {
            // SAFETY: as above.
            unsafe { avx2(kernel) }
        } else {
            kernel.run::<Baseline>()
        }
    }
}
