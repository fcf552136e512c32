//! Checks of settings, shared by the configurations of several families.

use serde::Serialize;
use serde_json::Value;
use swm_core::{Error, Result};

/// Upper limits of settings. Configurations may come from a file of a stranger, so every size has a limit: far above
/// the sizes of any model here, and low enough that the product of a few sizes is a 64-bit integer.
pub mod limits {
    /// The side of an image or a patch, in pixels.
    pub const SIDE: usize = 1 << 14;
    /// Features, elements, bins, directions.
    pub const FEATURES: usize = 1 << 20;
    /// Layers, critics, registers, shards.
    pub const LAYERS: usize = 1 << 10;
    /// Frames of a clip or a history, environment steps between two frames.
    pub const FRAMES: usize = 1 << 12;
    /// Clips of a batch, samples of a planner.
    pub const BATCH: usize = 1 << 20;
    /// Environments that run at the same time.
    pub const ENVS: usize = 1 << 14;
    /// Steps, rows and episodes of a run.
    pub const STEPS: usize = 1 << 40;
    /// The size of a configuration, a manifest or a preset, in bytes.
    pub const JSON_BYTES: u64 = 64 << 20;
}

/// Checks that sizes are in their ranges; `sizes` lists `(name, value, least, most)`.
///
/// # Errors
/// When a size is out of range; the error names the first such size.
pub fn check_sizes(sizes: &[(&str, usize, usize, usize)]) -> Result<()> {
    match sizes.iter().find(|(_, value, least, most)| value < least || value > most) {
        Some((name, value, least, most)) => {
            let fix = if value < least { format!("give at least {least}") } else { format!("give at most {most}") };
            Err(Error::config(*name, value.to_string(), fix))
        }
        None => Ok(()),
    }
}

/// Checks that every value of a configuration is finite.
///
/// # Errors
/// When a value is infinite or not a number; the error names the first such setting.
pub(crate) fn check_finite(config: &impl Serialize) -> Result<()> {
    let value = serde_json::to_value(config).map_err(|error| Error::external("checking a configuration", error))?;
    match first_null("", &value) {
        Some(name) => Err(Error::config(name, "the value is infinite or not a number", "give a finite value")),
        None => Ok(()),
    }
}

/// The dotted key of the first null, which stands for a value that is not finite: absent settings are left out.
fn first_null(at: &str, value: &Value) -> Option<String> {
    let below = |key: &str| if at.is_empty() { key.to_owned() } else { format!("{at}.{key}") };
    match value {
        Value::Null => Some(at.to_owned()),
        Value::Object(map) => map.iter().find_map(|(key, value)| first_null(&below(key), value)),
        Value::Array(values) => values.iter().find_map(|value| first_null(at, value)),
        _ => None,
    }
}
