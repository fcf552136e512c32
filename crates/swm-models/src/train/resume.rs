//! Checks that a stored run can be continued with a given configuration and dataset.

use serde_json::Value;
use std::path::Path;
use swm_core::{Error, Manifest, Result};

/// Returns the error for a new run whose output folder holds an earlier run.
pub(crate) fn refuse_existing(out: &Path) -> Error {
    Error::config(
        out.display().to_string(),
        "holds a training run already",
        "continue the run with `resume`, or choose another folder",
    )
}

/// Checks that a stored run has the configuration and the data of the requested run.
///
/// # Errors
/// When the configuration differs, with the settings that differ and their values, or else when the data differ.
pub(crate) fn check_same_run(path: &Path, stored: &Manifest, requested: &Manifest) -> Result<()> {
    let problem = if stored.config != requested.config {
        let differing = differences("", &stored.config, &requested.config);
        format!("the stored run has another configuration ({})", differing.join(", "))
    } else if stored.hashes.get("dataset") != requested.hashes.get("dataset") {
        "the stored run was trained on other data".to_owned()
    } else {
        return Ok(());
    };
    Err(Error::config(
        path.display().to_string(),
        problem,
        "continue with the configuration and the data of the stored run, or choose another folder",
    ))
}

/// The keys in which two configurations differ, with both values.
fn differences(prefix: &str, stored: &Value, requested: &Value) -> Vec<String> {
    match (stored, requested) {
        (Value::Object(left), Value::Object(right)) => {
            let mut keys: Vec<&String> = left.keys().chain(right.keys()).collect();
            keys.sort();
            keys.dedup();
            keys.into_iter()
                .flat_map(|key| {
                    let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                    differences(&name, left.get(key).unwrap_or(&Value::Null), right.get(key).unwrap_or(&Value::Null))
                })
                .collect()
        }
        _ if stored == requested => vec![],
        _ => vec![format!("{prefix}: stored {stored}, requested {requested}")],
    }
}
