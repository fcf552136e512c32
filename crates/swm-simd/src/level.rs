//! Run-time detection of the vector instructions of the CPU.

use std::sync::atomic::{AtomicU8, Ordering};

/// A set of vector instructions. The variants are ordered from the smallest to the largest set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum CpuLevel {
    /// The instructions that every CPU of the architecture supports.
    Baseline,
    /// x86-64-v3: AVX2, FMA, BMI1 and BMI2. 16 registers of 8 floats.
    Avx2,
    /// x86-64-v4: also AVX-512 F, BW, CD, DQ and VL. 32 registers of 16 floats.
    Avx512,
}

/// Value of [`LEVEL`] before the first detection.
const UNKNOWN: u8 = u8::MAX;

/// The level in use. Threads that race on the first detection store the same value.
static LEVEL: AtomicU8 = AtomicU8::new(UNKNOWN);

/// Returns the best level that the CPU supports. After the first call this costs one load.
#[inline]
pub fn cpu_level() -> CpuLevel {
    match LEVEL.load(Ordering::Relaxed) {
        level if level == CpuLevel::Baseline as u8 => CpuLevel::Baseline,
        level if level == CpuLevel::Avx2 as u8 => CpuLevel::Avx2,
        level if level == CpuLevel::Avx512 as u8 => CpuLevel::Avx512,
        _ => {
            let level = detect();
            LEVEL.store(level as u8, Ordering::Relaxed);
            level
        }
    }
}

/// Limits the result of [`cpu_level`] to `limit` in the whole process, for tests that compare levels.
pub fn limit_cpu_level(limit: CpuLevel) {
    LEVEL.store(detect().min(limit) as u8, Ordering::Relaxed);
}

#[cfg(target_arch = "x86_64")]
#[cold]
fn detect() -> CpuLevel {
    let avx2 = is_x86_feature_detected!("avx2")
        && is_x86_feature_detected!("fma")
        && is_x86_feature_detected!("bmi1")
        && is_x86_feature_detected!("bmi2");
    let avx512 = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512bw")
        && is_x86_feature_detected!("avx512cd")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512vl");
    match (avx2, avx512) {
        (true, true) => CpuLevel::Avx512,
        (true, false) => CpuLevel::Avx2,
        _ => CpuLevel::Baseline,
    }
}

#[cfg(not(target_arch = "x86_64"))]
#[cold]
fn detect() -> CpuLevel {
    CpuLevel::Baseline
}
