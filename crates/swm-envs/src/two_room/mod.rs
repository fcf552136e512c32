//! In work.

use swm_core::EnvEntry;

/// The registry row.
pub const ENTRY: EnvEntry = EnvEntry { id: "swm/TwoRoom-v1", summary: "", make: || unreachable!(), experts: &[] };
