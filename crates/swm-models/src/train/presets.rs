//! Configurations from presets, TOML files and `key=value` settings.

use super::checks::limits;
use figment::Figment;
use figment::providers::{Format as _, Serialized, Toml};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::Path;
use swm_core::{Error, Result, files};

/// A named configuration.
#[derive(Debug)]
pub struct Preset {
    /// The name on the command line.
    pub id: &'static str,
    /// One-sentence description of the configuration.
    pub summary: &'static str,
    /// The configuration.
    pub toml: &'static str,
}

/// Returns the TOML of the preset named `preset`, or of the file at the path `preset`.
///
/// # Errors
/// When there is no such preset or file.
pub(crate) fn preset_text(presets: &[Preset], preset: &str) -> Result<String> {
    match presets.iter().find(|row| row.id == preset) {
        Some(row) => Ok(row.toml.to_owned()),
        None if Path::new(preset).extension().is_some_and(|end| end == "toml") => {
            let text = files::read(Path::new(preset), limits::JSON_BYTES)?;
            String::from_utf8(text).map_err(|error| Error::corrupt(preset, error.to_string(), "give a TOML file"))
        }
        None => {
            let known: Vec<&str> = presets.iter().map(|row| row.id).collect();
            let hint = format!("choose {}, or give the path of a .toml file", known.join(", "));
            Err(Error::unknown("preset", preset, known, hint))
        }
    }
}

/// Parses a configuration from TOML, overridden by `key=value` settings with dotted keys. The valid keys are those of
/// `presets`, and those that a preset may leave out because they have a default.
///
/// # Errors
/// When there is no such key (the error names the nearest), or a value has the wrong type.
pub(crate) fn parse<C: DeserializeOwned + Serialize>(text: &str, settings: &[String], presets: &[&str]) -> Result<C> {
    merge(text, settings, &known_keys::<C>(presets))?.extract().map_err(|error| {
        let key = if error.path.is_empty() { "configuration".to_owned() } else { error.path.join(".") };
        Error::config(key, in_words(&error.kind), "`--print-config` shows all settings with valid values")
    })
}

/// Returns the message for a value that has the wrong type, in the words of TOML instead of those of Rust.
fn in_words(kind: &figment::error::Kind) -> String {
    use figment::error::Kind;
    match kind {
        Kind::InvalidType(given, expected) | Kind::InvalidValue(given, expected) => {
            let expected = match expected.as_str() {
                "f64" | "f32" => "a number",
                "usize" | "u64" | "u32" | "u16" | "u8" => "a whole number from 0",
                "i64" | "i32" | "isize" => "a whole number",
                "a boolean" | "bool" => "true or false",
                text if text.starts_with("struct ") || text == "a map" => "a table of settings",
                text => text,
            };
            format!("is {}, expected {expected}", actual_in_words(given))
        }
        other => other.to_string(),
    }
}

/// Returns a value of a configuration as it was given.
fn actual_in_words(given: &figment::error::Actual) -> String {
    use figment::error::Actual;
    match given {
        Actual::Bool(value) => value.to_string(),
        Actual::Unsigned(value) => value.to_string(),
        Actual::Signed(value) => value.to_string(),
        Actual::Float(value) => value.to_string(),
        Actual::Char(value) => format!("'{value}'"),
        Actual::Str(value) => format!("'{}'", value.chars().take(60).collect::<String>()),
        Actual::Seq => "a list".to_owned(),
        Actual::Map => "a group of settings".to_owned(),
        other => other.to_string(),
    }
}

/// Merges the TOML and the settings, and checks the keys.
fn merge(text: &str, settings: &[String], known: &[String]) -> Result<Figment> {
    let check = |key: &str| {
        if known.iter().any(|name| name == key || name.starts_with(&format!("{key}."))) {
            return Ok(());
        }
        let known = known.iter().map(String::as_str);
        Err(Error::unknown("setting", key, known, "`--print-config` shows all settings"))
    };
    let table: toml::Table =
        toml::from_str(text).map_err(|error| Error::config("configuration", error.message(), "correct the file"))?;
    let mut keys = vec![];
    flatten("", &toml::Value::Table(table), &mut keys);
    keys.iter().try_for_each(|key| check(key))?;

    let mut figment = Figment::from(Toml::string(text));
    let mut given: BTreeMap<&str, &str> = BTreeMap::new();
    for setting in settings {
        let Some((key, value)) = setting.split_once('=') else {
            return Err(Error::config(setting, "is not a setting", "write key=value, such as optim.lr=3e-4"));
        };
        check(key)?;
        if let Some(first) = given.insert(key, setting) {
            return Err(Error::twice(format!("setting {key}"), first, setting));
        }
        // A value that is not valid TOML is a string.
        let value = toml::from_str::<toml::Table>(&format!("value = {value}"))
            .ok()
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| toml::Value::String(value.to_owned()));
        figment = figment.merge(Serialized::default(key, value));
    }
    Ok(figment)
}

/// The dotted keys of all presets, with the settings that have defaults.
fn known_keys<C: DeserializeOwned + Serialize>(presets: &[&str]) -> Vec<String> {
    let mut keys = vec![];
    for preset in presets {
        let complete = toml::from_str::<C>(preset).ok().and_then(|config| toml::Value::try_from(&config).ok());
        if let Some(table) = complete {
            flatten("", &table, &mut keys);
        }
    }
    keys.sort();
    keys.dedup();
    keys
}

/// Appends the dotted keys of a value to `keys`.
fn flatten(prefix: &str, value: &toml::Value, keys: &mut Vec<String>) {
    match value {
        toml::Value::Table(table) => {
            for (key, value) in table {
                let key = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                flatten(&key, value, keys);
            }
        }
        _ => keys.push(prefix.to_owned()),
    }
}
