//! The settings of a study with a kind: [`settings_of`] reads them, [`Chosen`] says who chose them; and the bound of its cells.

use crate::cli::recipes::is_preset_name;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use std::collections::BTreeSet;
use swm_core::{Error, Origin, Result, limits, manifest};
use swm_eval::Study;
use swm_models::{FAMILIES, TrainableConfig};
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

/// Adds to the request of a row that trains with a preset which is a file what the file says: the hash of the configuration. With
/// another content, it is another row.
///
/// # Errors
/// When the file cannot be read or is no preset.
pub(super) fn add_config(request: &mut Value, family: &str, preset: &str, settings: &[String]) -> Result<()> {
    if !is_preset_name(preset) {
        request[CONFIG] = json!(config_hash(&*(FAMILIES.get(family)?.config)(preset, settings)?));
    }
    Ok(())
}

/// Checks that the preset of a row is still what it was when the study was made.
///
/// # Errors
/// When its file has another content.
pub(super) fn check_config(request: &Value, preset: &str, config: &dyn TrainableConfig) -> Result<()> {
    if request.get(CONFIG).is_none_or(|hash| *hash == json!(config_hash(config))) {
        return Ok(());
    }
    let problem = "is another one than that of the study";
    let fix =
        "resume it where it was started, with that file; or `swm study run` its file again, for rows of their own";
    Err(Error::config(format!("the preset '{preset}'"), problem, fix))
}

/// The key of the hash in a request.
const CONFIG: &str = "config";

fn config_hash(config: &dyn TrainableConfig) -> String {
    manifest::hash(config.to_json().to_string().as_bytes())
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

#[cfg(test)]
mod tests {
    use super::super::any_file::Size;
    use super::super::tables::TableFile;
    use super::*;
    use std::path::Path;

    #[test]
    fn rows_know_the_content_of_a_preset_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let preset = folder.path().join("own.toml");
        let of = "title = \"T\"\nquestion = \"q?\"\n[defaults]\n";
        for text in [
            format!("kind = \"drift\"\n{of}env = \"swm/PushT-v1\"\ndataset = \"states\"\n"),
            format!("kind = \"online\"\n{of}envs = [\"swm/PendulumControl-v1\"]\nfamilies = [\"tdmpc2\"]\n"),
        ] {
            let [narrow, wide] = ["8", "16"].map(|hidden| {
                let config =
                    (FAMILIES.get("tdmpc2").expect("a family").config)("tiny", &[format!("model.hidden={hidden}")]);
                let config = config.expect("a configuration");
                std::fs::write(&preset, config.to_toml().expect("TOML")).expect("writing a preset");
                let file = TableFile::parse(&text, Path::new("study.toml")).expect("a file");
                let own = [format!("preset={}", preset.display())];
                let made = file.study(Size::Paper, &own, &Origin::User).expect("a study");
                made.cells[0].clone()
            });
            assert_ne!(narrow.id().expect("an id"), wide.id().expect("an id"));
            let path = preset.to_string_lossy();
            let settings: Vec<String> = match wide.request["settings"].as_array() {
                Some(settings) => settings.iter().filter_map(|set| Some(set.as_str()?.to_owned())).collect(),
                None => vec!["seed=0".to_owned(), "schedule.steps=6000".to_owned()],
            };
            let config = (FAMILIES.get("tdmpc2").expect("a family").config)(&path, &settings).expect("a configuration");
            check_config(&wide.request, &path, &*config).expect("the same file");
            let error = check_config(&narrow.request, &path, &*config).expect_err("another").to_string();
            assert!(error.contains("own.toml': is another one"), "{error}");
        }
    }
}
