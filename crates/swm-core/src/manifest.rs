//! [`Manifest`]: the provenance of a dataset, a checkpoint or a result, sufficient to reproduce it.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The provenance of an artifact. A manifest holds no timestamps, so two equal runs have equal manifests.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Manifest {
    /// The command that made the artifact: `collect`, `train`, `evaluate`.
    pub kind: String,
    /// The version of stable-worldmodel.
    pub swm_version: String,
    /// Versions of the libraries that affect the content of the artifact.
    pub libraries: BTreeMap<String, String>,
    /// The seed of the command.
    pub seed: u64,
    /// The complete configuration.
    pub config: serde_json::Value,
    /// BLAKE3 hashes of the inputs: `dataset`, `weights`, `starts`.
    pub hashes: BTreeMap<String, String>,
    /// The device of the computation, such as `cpu (flex)`.
    pub device: String,
    /// The number of NaN and infinite values of each column of a collected dataset that has any, the actions of final
    /// rows excepted.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub not_finite: BTreeMap<String, u64>,
}

impl Manifest {
    /// A manifest of this version of stable-worldmodel.
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
