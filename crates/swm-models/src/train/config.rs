//! [`TrainConfig`]: everything that decides the numbers of a training run, from presets and `key=value` words.

use super::optim::OptimConfig;
use super::schedule::ScheduleConfig;
use super::trainable::Trainable;
use crate::online::OnlineConfig;
use figment::Figment;
use figment::providers::{Format as _, Serialized, Toml};
use serde::{Deserialize, Serialize};
use std::path::Path;
use swm_core::{Error, Result};

/// Everything that decides the numbers of a training run.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, bound = "")]
pub struct TrainConfig<M: Trainable> {
    /// Decides initial weights, order of the data and everything else that is drawn.
    pub seed: u64,
    /// The model.
    pub model: M::Config,
    /// Its loss.
    pub loss: M::Loss,
    /// What it is trained on.
    pub data: DataConfig,
    /// The optimizer.
    pub optim: OptimConfig,
    /// The learning rate over time.
    pub schedule: ScheduleConfig,
    /// Looking at episodes it is not trained on.
    #[serde(default)]
    pub validation: ValidationConfig,
    /// How playing and learning take turns, for a model that can learn by playing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub online: Option<OnlineConfig>,
    /// Parts a batch is cut into, which can run in parallel. Changes the last bits of the numbers.
    pub shards: usize,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// Steps between two checkpoints; 0 saves at the end only.
    pub save_every: usize,
}

impl<M: Trainable> Clone for TrainConfig<M> {
    fn clone(&self) -> Self {
        let Self { seed, model, loss, data, optim, schedule, validation, online, shards, log_every, save_every } = self;
        Self {
            seed: *seed,
            model: model.clone(),
            loss: loss.clone(),
            data: data.clone(),
            optim: optim.clone(),
            schedule: schedule.clone(),
            validation: validation.clone(),
            online: online.clone(),
            shards: *shards,
            log_every: *log_every,
            save_every: *save_every,
        }
    }
}

impl<M: Trainable> std::fmt::Debug for TrainConfig<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&toml::to_string(self).unwrap_or_default())
    }
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

/// Looking at the episodes held out for validation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ValidationConfig {
    /// Steps between two looks; 0 never looks.
    pub every: usize,
    /// Batches of a look, always the same ones.
    pub batches: usize,
    /// Looks without a lower loss after which training stops; 0 trains to the end.
    pub patience: usize,
}

impl Default for ValidationConfig {
    fn default() -> Self {
        Self { every: 0, batches: 8, patience: 0 }
    }
}

/// A named configuration.
#[derive(Debug)]
pub struct Preset {
    /// Its name.
    pub id: &'static str,
    /// What it is for, in a sentence.
    pub summary: &'static str,
    /// The configuration.
    pub toml: &'static str,
}

impl<M: Trainable> TrainConfig<M> {
    /// The configuration of a preset (its name, or the path of a TOML file), changed by `key=value` words with
    /// dots, such as `optim.lr=3e-4`.
    ///
    /// # Errors
    /// When there is no such preset or key (naming the nearest), or a value does not fit.
    pub fn load(preset: &str, words: &[String]) -> Result<Self> {
        let text = preset_text(M::PRESETS, preset)?;
        let presets: Vec<&str> = M::PRESETS.iter().map(|preset| preset.toml).chain([OPTIONAL]).collect();
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
        let least = [
            ("data.num_steps", self.data.num_steps, 1),
            ("data.frameskip", self.data.frameskip, 1),
            ("data.batch_size", self.data.batch_size, 2),
            ("optim.accumulate", self.optim.accumulate, 1),
            ("schedule.steps", self.schedule.steps, 1),
            ("validation.batches", self.validation.batches, 1),
            ("shards", self.shards, 1),
            ("log_every", self.log_every, 1),
        ];
        at_least(&least)?;
        let positive =
            [("optim.lr", self.optim.lr), ("optim.epsilon", self.optim.epsilon), ("optim.clip", self.optim.clip)];
        for (what, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::config(what, value.to_string(), "give a positive number"));
            }
        }
        if !(0.0..1.0).contains(&self.optim.ema) {
            let fix = "give a share of at least 0 (no average) and below 1";
            return Err(Error::config("optim.ema", self.optim.ema.to_string(), fix));
        }
        if self.validation.every > 0 && !self.data.hold_out {
            return Err(Error::config(
                "validation.every",
                "no episodes are held out to look at",
                "say data.hold_out=true, or validation.every=0",
            ));
        }
        if self.validation.patience > 0 && self.validation.every == 0 {
            return Err(Error::config(
                "validation.patience",
                "nothing is looked at to be patient about",
                "give validation.every, or validation.patience=0",
            ));
        }
        M::check(self)
    }
}

/// Checks that sizes are not below what makes sense: `(name, given, least)`.
///
/// # Errors
/// Naming the first that is.
pub fn at_least(sizes: &[(&str, usize, usize)]) -> Result<()> {
    match sizes.iter().find(|(_, given, least)| given < least) {
        Some((what, given, least)) => Err(Error::config(*what, given.to_string(), format!("give at least {least}"))),
        None => Ok(()),
    }
}

/// The keys that a preset may leave out.
const OPTIONAL: &str = "optim.accumulate = 1\noptim.ema = 0.0\nvalidation = { every = 0, batches = 8, patience = 0 }\n";

/// The TOML of a preset, or of a file.
///
/// # Errors
/// When there is neither.
pub(crate) fn preset_text(presets: &[Preset], preset: &str) -> Result<String> {
    match presets.iter().find(|row| row.id == preset) {
        Some(row) => Ok(row.toml.to_owned()),
        None if Path::new(preset).extension().is_some_and(|end| end == "toml") => {
            std::fs::read_to_string(preset).map_err(|error| Error::io(preset, "reading a configuration", error))
        }
        None => {
            let hint = "or give the path of a .toml file";
            Err(Error::unknown("preset", preset, presets.iter().map(|row| row.id), hint))
        }
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
    use crate::lewm::Lewm;

    type Config = TrainConfig<Lewm>;

    #[test]
    fn presets_load_and_words_change_them() {
        for preset in Lewm::PRESETS {
            let config = Config::load(preset.id, &[]).expect(preset.id);
            let text = config.to_toml().expect("TOML");
            let again = toml::from_str::<Config>(&text).expect("the same");
            assert_eq!(again.to_toml().expect("TOML"), text);
        }
        let words = ["optim.lr=3e-4".to_owned(), "model.latent=16".to_owned(), "optim.betas=[0.9, 0.99]".to_owned()];
        let config = Config::load("tiny", &words).expect("fine");
        assert_eq!((config.optim.lr, config.model.latent, config.optim.betas[1]), (3e-4, 16, 0.99));
    }

    #[test]
    fn wrong_words_say_what_is_wrong() {
        let message = |word: &str| Config::load("tiny", &[word.to_owned()]).expect_err("wrong").to_string();
        assert!(message("optim.rl=1").contains("did you mean optim.lr"), "{}", message("optim.rl=1"));
        assert!(message("optim.lr=fast").contains("optim.lr"), "{}", message("optim.lr=fast"));
        assert!(message("optim.lr").contains("key=value"));
        assert!(message("model.image=60").contains("patches"), "{}", message("model.image=60"));
        assert!(message("data.num_steps=1").contains("at least 2"));
        assert!(Config::load("tniy", &[]).expect_err("wrong").to_string().contains("did you mean tiny"));
    }
}
