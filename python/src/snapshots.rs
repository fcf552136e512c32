//! Snapshots as Python keeps them: the bytes of the engine, and a checksum of them. Environments check what a snapshot states,
//! but not every number of a simulation, and continue it without checks.

use crate::errors::to_py_err;
use pyo3::PyResult;
use swm::core::manifest::hash;
use swm::core::{Error, Snapshot};

/// Length in bytes of the checksum at the end.
const SUM: usize = 16;

/// Returns the bytes of a snapshot with their checksum.
pub fn seal(snapshot: Snapshot) -> Vec<u8> {
    let Snapshot(mut bytes) = snapshot;
    let sum = hash(&bytes);
    bytes.extend_from_slice(&sum.as_bytes()[..SUM]);
    bytes
}

/// Returns the snapshot that [`seal`] gave.
///
/// # Errors
/// `ValueError` if a byte differs.
pub fn unseal(mut sealed: Vec<u8>) -> PyResult<Snapshot> {
    let length = sealed.len().saturating_sub(SUM);
    let sum = sealed.split_off(length);
    if hash(&sealed).as_bytes()[..SUM] != sum {
        let problem = "expected the bytes of `snapshot`; some of them are missing or changed";
        return Err(to_py_err(Error::config("snapshot", problem, "take another snapshot")));
    }
    Ok(Snapshot(sealed))
}
