//! [`choose`]: parses `ID` or `ID,key=value,…` into a row of the registry of environments.

use crate::interned::interned;
use crate::{EnvLayout, GymConfig, GymEnv, WorkerTransport};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use swm_core::{Env, EnvChoice, EnvEntry, Error, Result};

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
/// When the text has another form.
pub fn choose(text: &str) -> Result<EnvChoice> {
    static ENTRIES: Mutex<BTreeMap<String, &'static EnvEntry>> = Mutex::new(BTreeMap::new());
    parse(text)?;
    let mut entries = ENTRIES.lock().unwrap_or_else(PoisonError::into_inner);
    let entry = *entries.entry(text.to_owned()).or_insert_with(|| {
        // Rows of a registry are static, so each distinct text leaks one row.
        Box::leak(Box::new(EnvEntry {
            id: interned(text),
            summary: "a Gymnasium environment",
            options: &[],
            make: |choice| make(choice.entry.id, GymConfig::default()),
            experts: &[],
        }))
    });
    Ok(entry.into())
}

/// Starts a worker process and makes the environment that `text` (`ID` or `ID,key=value,…`) names.
///
/// # Errors
/// When the environment cannot be made: Python or a package is missing, the id is unknown, or Python raises an
/// exception.
pub fn make(text: &str, config: GymConfig) -> Result<Box<dyn Env>> {
    static LAYOUTS: Mutex<BTreeMap<(String, crate::Python), Arc<EnvLayout>>> = Mutex::new(BTreeMap::new());
    let (id, options) = parse(text)?;
    let (restarts, key) = (config.restarts, (text.to_owned(), config.python.clone()));
    let transport = Box::new(WorkerTransport::new(id, options, config)?);
    // Starting the first environment of an id gives its layout; later environments use this layout and start in
    // parallel.
    let known = LAYOUTS.lock().unwrap_or_else(PoisonError::into_inner).get(&key).cloned();
    let env = match known {
        Some(layout) => GymEnv::with_layout(layout, transport, restarts)?,
        None => {
            let env = GymEnv::new(text, transport, restarts)?;
            LAYOUTS.lock().unwrap_or_else(PoisonError::into_inner).insert(key, Arc::clone(env.layout()));
            env
        }
    };
    Ok(Box::new(env))
}

/// Splits a text into id and arguments. Commas inside brackets and quotes belong to a value.
fn parse(text: &str) -> Result<(&str, BTreeMap<String, String>)> {
    let mut parts = vec![];
    let (mut start, mut depth, mut quote) = (0, 0_i32, None);
    for (at, c) in text.char_indices() {
        match (quote, c) {
            (Some(open), _) if c == open => quote = None,
            (Some(_), _) => {}
            (None, '\'' | '"') => quote = Some(c),
            (None, '(' | '[' | '{') => depth += 1,
            (None, ')' | ']' | '}') => depth -= 1,
            (None, ',') if depth == 0 => {
                parts.push(&text[start..at]);
                start = at + 1;
            }
            _ => {}
        }
    }
    parts.push(&text[start..]);
    let id = parts[0];
    let wrong = |problem: String| Error::config(format!("environment '{text}'"), problem, "write ID or ID,key=value,…");
    if id.is_empty() {
        return Err(wrong("it has no id".to_owned()));
    }
    let mut options = BTreeMap::new();
    for part in &parts[1..] {
        let (key, value) =
            part.split_once('=').ok_or_else(|| wrong(format!("'{part}' is not of the form key=value")))?;
        if options.insert(key.to_owned(), value.to_owned()).is_some() {
            return Err(wrong(format!("'{key}' occurs twice")));
        }
    }
    Ok((id, options))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_id_and_arguments() -> Result<()> {
        assert_eq!(parse("CartPole-v1")?, ("CartPole-v1", BTreeMap::new()));
        let (id, options) = parse("my.envs:Maze-v0,size=(3,4),name='a,b',hard=true")?;
        assert_eq!(id, "my.envs:Maze-v0");
        let expected = [("hard", "true"), ("name", "'a,b'"), ("size", "(3,4)")];
        assert_eq!(options, expected.map(|(key, value)| (key.to_owned(), value.to_owned())).into());
        for (text, words) in
            [("", "no id"), ("CartPole-v1,fast", "'fast' is not of the form key=value"), ("A,k=1,k=2", "twice")]
        {
            let error = parse(text).expect_err(text).to_string();
            assert!(error.contains(words), "{error}");
        }
        Ok(())
    }

    #[test]
    fn chosen_id_contains_its_arguments() -> Result<()> {
        let text = "ALE/Pong-v5,frameskip=2";
        assert_eq!(choose(text)?.id(), text);
        assert!(std::ptr::eq(choose(text)?.entry.id, choose(text)?.entry.id), "equal texts share one copy");
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
