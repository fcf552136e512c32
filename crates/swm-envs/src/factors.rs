//! What every environment's `snapshot`, `restore` and `restore_from` need: the factors, as `swm-core` writes them, and two
//! places.

use swm_core::Result;
pub use swm_core::factors::{foreign, from_row, restored, snapshot};

/// The bytes of two places, where an agent is and where it should go.
pub fn places_to_bytes(agent: [f32; 2], goal: [f32; 2]) -> impl Iterator<Item = u8> {
    agent.into_iter().chain(goal).flat_map(f32::to_le_bytes)
}

/// The two places of [`places_to_bytes`].
///
/// # Errors
/// When these are not their bytes.
pub fn places_from_bytes(id: &str, bytes: &[u8]) -> Result<[[f32; 2]; 2]> {
    match bytes.as_chunks() {
        (&[ax, ay, gx, gy], []) => Ok([[ax, ay], [gx, gy]].map(|place| place.map(f32::from_le_bytes))),
        _ => Err(foreign(id, format!("{} bytes of places", bytes.len()))),
    }
}
