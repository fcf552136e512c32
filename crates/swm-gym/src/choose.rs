//! [`choose`]: parses `ID` or `ID,key=value,…` into a row of the registry of environments.

use crate::interned::interned;
use crate::{EnvLayout, GymConfig, GymEnv, TrustedId, WorkerTransport};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Env, EnvChoice, EnvEntry, Origin, Result};

/// Example ids for listings of environments, each with a description of its environments and their requirements.
pub const EXAMPLES: &[(&str, &str)] = &[
    ("CartPole-v1", "any environment registered with Gymnasium: `swm assets install gymnasium`"),
    ("module:Name-v0", "any environment that importing the module registers"),
    ("ALE/Pong-v5", "the Arcade Learning Environment: `swm assets install ale`"),
    ("swm/CraftaxPixels-v1", "Craftax; also CraftaxSymbolic-v1, CraftaxClassicPixels-v1, CraftaxClassicSymbolic-v1"),
];

/// Returns whether an id has the form of a Gymnasium id: a version, a namespace or a module. `swm/…` ids are native,
/// apart from Craftax.
pub fn is_gymnasium_id(text: &str) -> bool {
    let id = text.split(',').next().unwrap_or_default();
    if id.starts_with("swm/") {
        return id.starts_with("swm/Craftax");
    }
    let version = id.rsplit_once("-v").is_some_and(|(_, version)| version.parse::<u32>().is_ok());
    version || id.contains('/') || id.contains(':')
}

/// Parses `ID` or `ID,key=value,…`, where the keys are arguments of `gymnasium.make`: `ALE/Pong-v5,frameskip=2`. An id
/// may name the module that registers it: `my_envs:Maze-v0`. No process starts here, so an unknown id becomes an error
/// only when an environment is made.
///
/// # Errors
/// When the text has another form, or a file chose an id that only the user may choose ([`TrustedId::new`]).
pub fn choose(text: &str, origin: &Origin) -> Result<EnvChoice> {
    static ENTRIES: Mutex<BTreeMap<String, &'static EnvEntry>> = Mutex::new(BTreeMap::new());
    TrustedId::new(text, origin)?;
    let mut entries = ENTRIES.lock().unwrap_or_else(PoisonError::into_inner);
    let entry = *entries.entry(text.to_owned()).or_insert_with(|| {
        // Rows of a registry are static, so each distinct text leaks one row.
        Box::leak(Box::new(EnvEntry {
            id: interned(text),
            summary: "a Gymnasium environment",
            options: &[],
            // `choose` checked the origin of the id.
            make: |choice| make(&TrustedId::new(choice.entry.id, &Origin::User)?, GymConfig::default()),
            experts: &[],
        }))
    });
    Ok(entry.into())
}

/// Starts a worker process and makes an environment.
///
/// # Errors
/// When the environment cannot be made: Python or a package is missing, the id is unknown, or Python raises an
/// exception.
pub fn make(id: &TrustedId, config: GymConfig) -> Result<Box<dyn Env>> {
    static LAYOUTS: Mutex<BTreeMap<(String, crate::Python), Arc<EnvLayout>>> = Mutex::new(BTreeMap::new());
    let (restarts, key) = (config.restarts, (id.text().to_owned(), config.python.clone()));
    let transport = Box::new(WorkerTransport::new(id, config)?);
    // Starting the first environment of an id gives its layout; later environments use this layout and start in
    // parallel.
    let known = LAYOUTS.lock().unwrap_or_else(PoisonError::into_inner).get(&key).cloned();
    let env = match known {
        Some(layout) => GymEnv::with_layout(layout, transport, restarts)?,
        None => {
            let env = GymEnv::new(id.text(), transport, restarts)?;
            LAYOUTS.lock().unwrap_or_else(PoisonError::into_inner).insert(key, Arc::clone(env.layout()));
            env
        }
    };
    Ok(Box::new(env))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chosen_id_contains_its_arguments() -> Result<()> {
        let text = "ALE/Pong-v5,frameskip=2";
        let choose = || choose(text, &Origin::User);
        assert_eq!(choose()?.id(), text);
        assert!(std::ptr::eq(choose()?.entry.id, choose()?.entry.id), "equal texts share one copy");
        Ok(())
    }

    #[test]
    fn native_ids_are_not_gymnasium_ids() {
        for text in ["CartPole-v1", "ALE/Pong-v5,frameskip=2", "swm/CraftaxPixels-v1", "mine:Maze-v0", "mine:maze"] {
            assert!(is_gymnasium_id(text), "{text}");
        }
        for text in ["swm/PushT-v1", "swm/PusT-v1", "pusht", "push-variant", ""] {
            assert!(!is_gymnasium_id(text), "{text}");
        }
    }
}
