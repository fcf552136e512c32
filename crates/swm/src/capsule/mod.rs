//! Capsules: packing a checkpoint with a reference batch and recorded episodes, and verifying both on another machine.
//!
//! The file itself is [`swm_models::capsule`]; environments and evaluations are joined with it here.

mod pack;
mod record;
mod verify;

pub use pack::{PackRequest, pack};
pub use record::{EvaluationRecord, RecordedEpisode, Returns};
pub(crate) use record::{check_cost, is_hash, trained};
pub use verify::{Verification, verify};

/// The name of the capsule's own model in the request that it holds.
const MODEL: &str = "capsule";

/// Returns the architecture and the level of vector instructions of this processor.
pub fn cpu_level() -> String {
    let level = format!("{:?}", swm_simd::cpu_level()).to_lowercase();
    format!("{} {level}", std::env::consts::ARCH)
}

/// Returns what the last bits of results depend on, of a level as [`cpu_level`] states it. AVX-512 and AVX2 compute the same bits: both
/// round a multiplication and an addition once, and sums are cut alike.
pub fn arithmetic(level: &str) -> &str {
    match level {
        "x86_64 avx2" | "x86_64 avx512" => "x86_64 avx2 or avx512",
        other => other,
    }
}

/// Returns whether processors of two levels, as [`cpu_level`] states them, compute the same bits.
pub fn computes_alike(a: &str, b: &str) -> bool {
    arithmetic(a) == arithmetic(b)
}

#[cfg(test)]
mod tests {
    use super::computes_alike;

    #[test]
    fn levels_with_fused_products_compute_alike() {
        assert!(
            computes_alike("x86_64 avx2", "x86_64 avx512") && computes_alike("aarch64 baseline", "aarch64 baseline")
        );
        for other in ["x86_64 baseline", "aarch64 baseline", ""] {
            assert!(!computes_alike("x86_64 avx512", other) && !computes_alike(other, "x86_64 avx2"));
        }
    }
}
