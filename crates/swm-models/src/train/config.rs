//! [`TrainConfig`]: everything that decides the numbers of a training run, from presets and `key=value` words.

use super::optim::OptimConfig;
use super::schedule::ScheduleConfig;
use crate::lewm::LewmConfig;
use crate::lewm::step::SigregConfig;
use figment::Figment;
use figment::providers::{Format as _, Serialized, Toml};
use serde::{Deserialize, Serialize};
use std::path::Path;
use swm_core::{Error, Result};

/// Everything that decides the numbers of a training run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Decides initial weights, order of the data, directions and dropout.
    pub seed: u64,
    /// The model.
    pub model: LewmConfig,
    /// What it is trained on.
    pub data: DataConfig,
    /// The regulariser.
    pub sigreg: SigregConfig,
    /// The optimizer.
    pub optim: OptimConfig,
    /// The learning rate over time.
    pub schedule: ScheduleConfig,
    /// Parts the encoder's batch is cut into, which can run in parallel. Changes the last bits of the numbers.
    pub shards: usize,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// Steps between two checkpoints; 0 saves at the end only.
    pub save_every: usize,
}

/// What a model is trained on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Frames in a clip.
    pub num_steps: usize,
    /// Environment steps from one frame to the next.
    pub frameskip: usize,
    /// Clips in a batch.
    pub batch_size: usize,
    /// Whether the episodes that [`swm_data::Split::default`] holds out, a tenth for validation and a tenth for tests, are
    /// left out, so that `swm eval --split test` starts from what was never trained on.
    #[serde(default)]
    pub hold_out: bool,
}

/// A named configuration.
pub struct Preset {
    /// Its name.
    pub id: &'static str,
    /// What it is for, in a sentence.
    pub summary: &'static str,
    toml: &'static str,
}

/// The configurations that come with the program.
pub static PRESETS: &[Preset] = &[
    Preset {
        id: "tiny",
        summary: "64 px, a small convolutional encoder: trains in half a minute on two CPU cores",
        toml: include_str!("../presets/tiny.toml"),
    },
    Preset {
        id: "paper",
        summary: "224 px, ViT-tiny/14, predictor of 6 layers: the published size, for a GPU",
        toml: include_str!("../presets/paper.toml"),
    },
];

impl TrainConfig {
    /// The configuration of a preset (its name, or the path of a TOML file), changed by `key=value` words with
    /// dots, such as `optim.lr=3e-4`.
    ///
    /// # Errors
    /// When there is no such preset or key (naming the nearest), or a value does not fit.
    pub fn load(preset: &str, words: &[String]) -> Result<Self> {
        let text = match PRESETS.iter().find(|row| row.id == preset) {
            Some(row) => row.toml.to_owned(),
            None if Path::new(preset).extension().is_some_and(|end| end == "toml") => {
                std::fs::read_to_string(preset).map_err(|error| Error::io(preset, "reading a configuration", error))?
            }
            None => {
                let hint = "or give the path of a .toml file";
                return Err(Error::unknown("preset", preset, PRESETS.iter().map(|row| row.id), hint));
            }
        };
        let presets: Vec<&str> = PRESETS.iter().map(|preset| preset.toml).collect();
        let config: Self = layered(&text, words, &presets)?;
        config.check()?;
        Ok(config)
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|error| Error::external("writing a configuration", error))
    }

    /// Checks that the settings fit each other.
    ///
    /// # Errors
    /// Naming the first that does not.
    pub fn check(&self) -> Result<()> {
        self.model.check()?;
        let least = [
            ("data.num_steps", self.data.num_steps, 2),
            ("data.frameskip", self.data.frameskip, 1),
            ("data.batch_size", self.data.batch_size, 2),
            ("sigreg.directions", self.sigreg.directions, 1),
            ("sigreg.knots", self.sigreg.knots, 2),
            ("schedule.steps", self.schedule.steps, 1),
            ("shards", self.shards, 1),
            ("log_every", self.log_every, 1),
        ];
        for (what, value, least) in least {
            if value < least {
                return Err(Error::config(what, value.to_string(), format!("give at least {least}")));
            }
        }
        let history = self.model.predictor.history;
        if self.data.num_steps - 1 < history {
            return Err(Error::config(
                "data.num_steps",
                format!(
                    "{} frames train only {} of the {history} steps of history",
                    self.data.num_steps,
                    self.data.num_steps - 1
                ),
                format!("give at least {}, or lower model.predictor.history", history + 1),
            ));
        }
        let positive =
            [("optim.lr", self.optim.lr), ("optim.epsilon", self.optim.epsilon), ("optim.clip", self.optim.clip)];
        for (what, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::config(what, value.to_string(), "give a positive number"));
            }
        }
        Ok(())
    }
}

/// A configuration from TOML, changed by `key=value` words with dots; the keys there are are those of `presets`.
///
/// # Errors
/// When there is no such key (naming the nearest), or a value does not fit.
pub(crate) fn layered<C: serde::de::DeserializeOwned>(text: &str, words: &[String], presets: &[&str]) -> Result<C> {
    let known = known_keys(presets);
    let check = |key: &str| {
        if known.iter().any(|name| name == key || name.starts_with(&format!("{key}."))) {
            return Ok(());
        }
        let known = known.iter().map(String::as_str);
        Err(Error::unknown("setting", key, known, "`--print-config` shows them all"))
    };
    let table: toml::Table =
        toml::from_str(text).map_err(|error| Error::config("configuration", error.message(), "correct the file"))?;
    let mut keys = vec![];
    flatten("", &toml::Value::Table(table), &mut keys);
    keys.iter().try_for_each(|key| check(key))?;

    let mut figment = Figment::from(Toml::string(text));
    for word in words {
        let Some((key, value)) = word.split_once('=') else {
            return Err(Error::config(word, "is no setting", "write key=value, such as optim.lr=3e-4"));
        };
        check(key)?;
        // A word that is no TOML value is a string.
        let value = toml::from_str::<toml::Table>(&format!("value = {value}"))
            .ok()
            .and_then(|mut table| table.remove("value"))
            .unwrap_or_else(|| toml::Value::String(value.to_owned()));
        figment = figment.merge(Serialized::default(key, value));
    }
    figment.extract().map_err(|error| {
        let key = if error.path.is_empty() { "configuration".to_owned() } else { error.path.join(".") };
        Error::config(key, error.kind.to_string(), "give a value that fits (`--print-config` shows them all)")
    })
}

/// The dotted keys of all presets.
fn known_keys(presets: &[&str]) -> Vec<String> {
    let mut keys = vec![];
    for preset in presets {
        if let Ok(table) = toml::from_str(preset) {
            flatten("", &toml::Value::Table(table), &mut keys);
        }
    }
    keys.sort();
    keys.dedup();
    keys
}

/// The dotted keys of a value.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_load_and_words_change_them() {
        for preset in PRESETS {
            let config = TrainConfig::load(preset.id, &[]).expect(preset.id);
            assert_eq!(toml::from_str::<TrainConfig>(&config.to_toml().expect("TOML")).expect("the same"), config);
        }
        let words = ["optim.lr=3e-4".to_owned(), "model.latent=16".to_owned(), "optim.betas=[0.9, 0.99]".to_owned()];
        let config = TrainConfig::load("tiny", &words).expect("fine");
        assert_eq!((config.optim.lr, config.model.latent, config.optim.betas[1]), (3e-4, 16, 0.99));
    }

    #[test]
    fn wrong_words_say_what_is_wrong() {
        let message = |word: &str| TrainConfig::load("tiny", &[word.to_owned()]).expect_err("wrong").to_string();
        assert!(message("optim.rl=1").contains("did you mean optim.lr"), "{}", message("optim.rl=1"));
        assert!(message("optim.lr=fast").contains("optim.lr"), "{}", message("optim.lr=fast"));
        assert!(message("optim.lr").contains("key=value"));
        assert!(message("model.image=60").contains("patches"), "{}", message("model.image=60"));
        assert!(message("data.num_steps=1").contains("at least 2"));
        assert!(TrainConfig::load("tniy", &[]).expect_err("wrong").to_string().contains("did you mean tiny"));
    }
}
