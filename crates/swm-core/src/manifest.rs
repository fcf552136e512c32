//! [`Manifest`]: where a dataset, a checkpoint or a result came from, so that it can be made again.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Provenance. Everything in it is decided by what was asked, so two equal runs have equal manifests.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// What made it: `collect`, `train`, `evaluate`.
    pub kind: String,
    /// The version of stable-worldmodel.
    pub swm_version: String,
    /// Versions of the libraries that decide the numbers.
    pub libraries: BTreeMap<String, String>,
    /// The seed.
    pub seed: u64,
    /// The complete configuration.
    pub config: serde_json::Value,
    /// BLAKE3 hashes of what went in: `dataset`, `weights`, `starts`.
    pub hashes: BTreeMap<String, String>,
    /// Where the numbers were computed, such as `cpu (flex)`.
    pub device: String,
}

impl Manifest {
    /// A manifest of this build.
    pub fn new(kind: &str, seed: u64, config: serde_json::Value) -> Self {
        Self {
            kind: kind.to_owned(),
            swm_version: env!("CARGO_PKG_VERSION").to_owned(),
            seed,
            config,
            device: "cpu".to_owned(),
            ..Self::default()
        }
    }
}

/// The BLAKE3 hash of some bytes, in hexadecimal.
pub fn hash(bytes: &[u8]) -> String {
    blake3::hash(bytes).to_hex().to_string()
}
