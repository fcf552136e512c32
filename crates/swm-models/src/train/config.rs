//! [`TrainConfig`]: all settings that a training run's results depend on.

use super::checks::{check_finite, check_sizes, limits};
use super::described::describe;
use super::optim::OptimConfig;
use super::presets::{parse, preset_text};
use super::schedule::ScheduleConfig;
use super::trainable::Trainable;
use crate::online::OnlineConfig;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Result};

/// All settings that a training run's results depend on.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields, bound = "")]
pub struct TrainConfig<M: Trainable> {
    /// The seed of the initial weights, the order of the data and all other random draws.
    pub seed: u64,
    /// The sizes of the model.
    pub model: M::Config,
    /// The settings of the loss.
    pub loss: M::Loss,
    /// The data.
    pub data: DataConfig,
    /// The optimizer.
    pub optim: OptimConfig,
    /// The schedule of the learning rate.
    pub schedule: ScheduleConfig,
    /// Validation on held-out episodes.
    #[serde(default)]
    pub validation: ValidationConfig,
    /// Online training, for a model that can learn by interaction.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub online: Option<OnlineConfig>,
    /// The number of shards of a batch, which run in parallel. The number changes the last bits of the results.
    pub shards: usize,
    /// The number of steps between two lines of the log.
    pub log_every: usize,
    /// The number of steps between two checkpoints; 0 saves at the end only.
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

/// The data on which a model is trained.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// The number of frames of a clip.
    pub num_steps: usize,
    /// The number of environment steps from one frame of a clip to the next.
    pub frameskip: usize,
    /// The number of clips of a batch.
    pub batch_size: usize,
    /// Whether the episodes that [`swm_data::Split::default`] holds out, a tenth for validation and a tenth for
    /// testing, are left out of the training data, so that `swm eval --split test` starts from episodes no model was
    /// trained on. Mean, deviation and range of actions and columns are those of all episodes.
    #[serde(default)]
    pub hold_out: bool,
}

/// Validation on held-out episodes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ValidationConfig {
    /// The number of steps between two validations; 0 disables validation.
    pub every: usize,
    /// The number of batches of a validation. Every validation uses the same batches.
    pub batches: usize,
    /// The number of validations without a lower loss after which training stops; 0 trains to the end.
    pub patience: usize,
}

impl Default for ValidationConfig {
    fn default() -> Self {
        Self { every: 0, batches: 8, patience: 0 }
    }
}

/// The settings of a [`TrainConfig`] that the training loop reads and that have the same type for every family.
#[derive(Clone)]
pub(crate) struct LoopConfig {
    pub seed: u64,
    pub data: DataConfig,
    pub optim: OptimConfig,
    pub schedule: ScheduleConfig,
    pub validation: ValidationConfig,
    pub log_every: usize,
    pub save_every: usize,
}

impl<M: Trainable> TrainConfig<M> {
    /// Loads a preset (its name, or the path of a TOML file), overridden by `key=value` settings with dotted keys, such
    /// as `optim.lr=3e-4`.
    ///
    /// # Errors
    /// When there is no such preset or key (the error names the nearest), or a value has the wrong type.
    pub fn load(preset: &str, settings: &[String]) -> Result<Self> {
        let text = preset_text(M::PRESETS, preset)?;
        let presets: Vec<&str> = M::PRESETS.iter().map(|preset| preset.toml).collect();
        let config: Self = parse(&text, settings, &presets)?;
        config.check()?;
        Ok(config)
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// Never, if [`TrainConfig::load`] returned the configuration.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|error| Error::external("writing a configuration", error))
    }

    /// The configuration as TOML, with the documentation of each setting as a comment above it.
    ///
    /// # Errors
    /// As [`TrainConfig::to_toml`].
    pub fn to_commented_toml(&self) -> Result<String> {
        let own = [std::any::type_name::<M::Config>(), std::any::type_name::<M::Loss>()];
        Ok(describe(&self.to_toml()?, "TrainConfig", &[("M::Config", own[0]), ("M::Loss", own[1])]))
    }

    /// Checks that the settings fit each other.
    ///
    /// # Errors
    /// When a setting does not fit; the error names the first such setting.
    pub fn check(&self) -> Result<()> {
        check_sizes(&[
            ("data.num_steps", self.data.num_steps, 1, limits::FRAMES),
            ("data.frameskip", self.data.frameskip, 1, limits::FRAMES),
            ("data.batch_size", self.data.batch_size, 2, limits::BATCH),
            ("optim.accumulate", self.optim.accumulate, 1, limits::BATCH),
            ("schedule.steps", self.schedule.steps, 1, limits::STEPS),
            ("validation.batches", self.validation.batches, 1, limits::STEPS),
            ("shards", self.shards, 1, limits::LAYERS),
            ("log_every", self.log_every, 1, limits::STEPS),
        ])?;
        check_finite(self)?;
        self.loop_config().check()?;
        if let Some(online) = &self.online {
            online.check()?;
            self.schedule.check_warmup()?;
        }
        M::check(self)
    }

    /// The settings that the training loop reads.
    pub(crate) fn loop_config(&self) -> LoopConfig {
        LoopConfig {
            seed: self.seed,
            data: self.data.clone(),
            optim: self.optim.clone(),
            schedule: self.schedule.clone(),
            validation: self.validation.clone(),
            log_every: self.log_every,
            save_every: self.save_every,
        }
    }
}

impl LoopConfig {
    /// Checks the settings of the optimizer and of the validation.
    fn check(&self) -> Result<()> {
        self.optim.check()?;
        self.schedule.check()?;
        if self.validation.every > 0 && !self.data.hold_out {
            return Err(Error::config(
                "validation.every",
                "no episodes are held out for validation",
                "set data.hold_out=true, or validation.every=0",
            ));
        }
        if self.validation.patience > 0 && self.validation.every == 0 {
            return Err(Error::config(
                "validation.patience",
                "validation is off, so its loss cannot stop the run",
                "set validation.every, or validation.patience=0",
            ));
        }
        Ok(())
    }
}
