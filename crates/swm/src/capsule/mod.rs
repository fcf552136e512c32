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
