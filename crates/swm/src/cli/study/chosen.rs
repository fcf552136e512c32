//! The settings of a study with a kind: [`settings_of`] reads them, [`Chosen`] says who chose them; and the bound of its cells.

use crate::cli::recipes::is_preset_name;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::json;
use std::collections::BTreeSet;
use swm_core::{Error, Origin, Result, limits};
use swm_eval::Study;
use toml::Table;

/// Who chose the settings of a study.
pub(super) struct Chosen<'a> {
    /// Who chose the file.
    origin: &'a Origin,
    /// The settings of the command line, which are the user's own.
    own: BTreeSet<&'a str>,
}

impl<'a> Chosen<'a> {
    /// `own` are the settings of the command line.
    pub(super) fn new(origin: &'a Origin, own: BTreeSet<&'a str>) -> Self {
        Self { origin, own }
    }

    /// The user chose all of them.
    #[cfg(test)]
    pub(super) fn by_user() -> Self {
        Self { origin: &Origin::User, own: BTreeSet::new() }
    }

    /// Who chose a setting.
    pub(super) fn by(&self, key: &str) -> &Origin {
        if self.own.contains(key) { &Origin::User } else { self.origin }
    }

    /// Checks that a preset is one of the program, or that the user chose its file.
    ///
    /// # Errors
    /// When a file chose the file of a preset.
    pub(super) fn check_preset(&self, preset: &str) -> Result<()> {
        if is_preset_name(preset) {
            return Ok(());
        }
        self.by("preset").check_user(&format!("the preset '{preset}'"), "which is a file", Some("preset=FILE"))
    }
}

/// Reads the settings of a study; those that are not given have their defaults.
///
/// # Errors
/// When there is no such setting, or a value has another type.
pub(super) fn settings_of<T: Serialize + DeserializeOwned + Default>(given: Table) -> Result<T> {
    let names = json!(T::default());
    let names: Vec<&str> = names.as_object().into_iter().flat_map(|all| all.keys().map(String::as_str)).collect();
    known(&given, &names)?;
    // An error of the whole table does not name the setting.
    for (key, value) in &given {
        let alone: std::result::Result<T, _> = Table::from_iter([(key.clone(), value.clone())]).try_into();
        if let Err(error) = alone {
            let fix = "docs/studies.md describes the settings";
            return Err(Error::config(format!("{key}={value}"), in_words(error.message()), fix));
        }
    }
    given.try_into().map_err(|error| Error::config("settings of the study", in_words(error.message()), "correct them"))
}

/// Checks the names of settings.
///
/// # Errors
/// When one is not among `names`.
pub(super) fn known(settings: &Table, names: &[&str]) -> Result<()> {
    let hint = || format!("the settings are {}", names.join(", "));
    match settings.keys().find(|key| !names.contains(&key.as_str())) {
        Some(key) if names.is_empty() => Err(Error::config(key, "this study has no settings", "remove it")),
        Some(key) => Err(Error::unknown("setting", key, names.iter().copied(), hint())),
        None => Ok(()),
    }
}

/// Returns the message about a value of the wrong type in the words of TOML instead of those of Rust.
fn in_words(message: &str) -> String {
    let Some((_, expected)) = message.split_once(", expected ") else { return message.to_owned() };
    let expected = match expected.trim() {
        "f64" | "f32" => "a number",
        "usize" | "u64" | "u32" | "u16" | "u8" => "a whole number from 0",
        "i64" | "i32" | "isize" => "a whole number",
        "bool" | "a boolean" => "true or false",
        "a sequence" => "a list, such as [1, 2]",
        "a map" => "a table",
        "a string" => "a text",
        text => text,
    };
    format!("expected {expected}")
}

/// Checks the number of cells, which lists of these lengths have, before they are made.
///
/// # Errors
/// When there are more than [`Study::MAX_CELLS`].
pub(super) fn check_cells(lengths: &[usize]) -> Result<()> {
    let cells = limits::product(lengths.iter().copied());
    if cells > Study::MAX_CELLS {
        let problem = format!("its lists have {cells} combinations");
        return Err(Error::config("the study", problem, format!("give at most {}", Study::MAX_CELLS)));
    }
    Ok(())
}
