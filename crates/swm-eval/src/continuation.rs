//! [`check_continues`]: whether a collection may continue a dataset; and [`difference`]: how two collections differ.

use serde_json::Value;
use std::collections::BTreeSet;
use swm_core::{Error, Manifest, Result};

/// Checks that a collection may be continued: all settings, such as the environment, the policy, the seed and the wrappers,
/// and the weights of policies must be equal; the number of episodes may differ.
///
/// # Errors
/// When a setting differs; the message names the setting.
pub fn check_continues(stored: &Manifest, wanted: &Manifest) -> Result<()> {
    let Some(found) = difference(stored, wanted) else { return Ok(()) };
    let fix = "use the same settings (--codec, --wrapper, … on the command line), or collect into another dataset";
    Err(Error::config(format!("continuing a collection with {} {}", found.setting, found.wanted), found.problem(), fix))
}

/// A setting in which a dataset differs from a collection.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// The name of the setting: `policy`.
    pub setting: String,
    /// The setting of the dataset.
    pub stored: String,
    /// The setting of the collection.
    pub wanted: String,
}

impl Difference {
    /// What is wrong with the dataset.
    pub fn problem(&self) -> String {
        format!("its episodes were collected with {} {}", self.setting, self.stored)
    }
}

/// Returns a setting, or the weights of a policy, in which a dataset differs from a collection; `None` if all are equal but the
/// number of episodes.
pub fn difference(stored: &Manifest, wanted: &Manifest) -> Option<Difference> {
    let differs = |setting: &str, stored: String, wanted: String| {
        Some(Difference { setting: setting.to_owned(), stored, wanted })
    };
    if stored.seed != wanted.seed {
        return differs("seed", stored.seed.to_string(), wanted.seed.to_string());
    }
    let settings = [stored, wanted].into_iter().filter_map(|manifest| manifest.config.as_object());
    let names: BTreeSet<&str> = settings.flat_map(|config| config.keys().map(String::as_str)).collect();
    for what in names.into_iter().filter(|what| *what != "episodes") {
        let (stored, wanted) = (setting(stored, what), setting(wanted, what));
        if stored != wanted {
            return differs(what, stored.to_string(), wanted.to_string());
        }
    }
    for (policy, wanted) in &wanted.hashes {
        if let Some(stored) = stored.hashes.get(policy).filter(|stored| *stored != wanted) {
            return differs(&format!("the weights of {policy}"), stored.clone(), wanted.clone());
        }
    }
    None
}

/// Returns a setting of a collection. A setting that is left out, empty or false is the same as null: older manifests and
/// those of Python differ in this.
fn setting(manifest: &Manifest, name: &str) -> Value {
    let value = &manifest.config[name];
    let unset = value == false || value.as_array().is_some_and(Vec::is_empty);
    if unset { Value::Null } else { value.clone() }
}
