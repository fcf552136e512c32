//! Training of the inverse-dynamics network on a frozen encoder.

use super::InverseCheckpoint;
use super::checkpoint::FAMILY;
use crate::checkpoint::Checkpoint;
use crate::device;
use crate::lewm::{Lewm, pixels};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Init, Mlp};
use crate::train::{
    AdamW, OptimConfig, ParameterGroup, ScheduleConfig, TrainSummary, check_finite, check_sizes, limits, log, presets,
};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;
use swm_core::columns::{ACTION, PIXELS};
use swm_core::files::Lock;
use swm_core::run::{Control, Progress};
use swm_core::{Error, Key, Manifest, Result};
use swm_data::{ClipSpec, Loader, LoaderConfig, Part, Reader};

/// The configuration of an inverse-dynamics training run. Configuration, encoder and dataset determine the result.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InverseConfig {
    /// The seed of initial weights, data order and goals.
    pub seed: u64,
    /// Maximum number of model steps from a frame to its goal.
    pub offset: usize,
    /// Hidden features of the network.
    pub hidden: usize,
    /// Clips per batch.
    pub batch_size: usize,
    /// Whether training excludes the episodes that [`swm_data::Split::default`] holds out.
    pub hold_out: bool,
    /// Steps between log lines.
    pub log_every: usize,
    /// The optimizer.
    pub optim: OptimConfig,
    /// The learning rate over time.
    pub schedule: ScheduleConfig,
}

impl InverseConfig {
    /// The built-in configuration as TOML.
    pub const PRESET: &str = include_str!("../../presets/inverse.toml");

    /// Loads the built-in configuration, changed by `key=value` settings with dotted keys.
    ///
    /// # Errors
    /// When a key is unknown (the error names the nearest known key), or a value is invalid.
    pub fn load(settings: &[String]) -> Result<Self> {
        let config: Self = presets::parse(Self::PRESET, settings, &[Self::PRESET])?;
        config.check()?;
        Ok(config)
    }

    /// Checks the ranges of the settings.
    ///
    /// # Errors
    /// When a setting is out of range; the error names the first such setting.
    pub fn check(&self) -> Result<()> {
        check_finite(self)?;
        self.optim.check()?;
        self.schedule.check()?;
        let OptimConfig { accumulate, ema, .. } = self.optim;
        if (accumulate, ema) != (1, 0.0) {
            let given = format!("accumulate={accumulate}, ema={ema}");
            return Err(Error::config("optim", given, "give 1 and 0: this training has neither"));
        }
        check_sizes(&[
            ("offset", self.offset, 1, limits::FRAMES),
            ("hidden", self.hidden, 1, limits::FEATURES),
            ("batch_size", self.batch_size, 1, limits::BATCH),
            ("log_every", self.log_every, 1, limits::STEPS),
            ("schedule.steps", self.schedule.steps, 1, limits::STEPS),
        ])
    }

    /// Returns the configuration as TOML.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|error| Error::external("writing a configuration", error))
    }
}

/// Trains on a dataset with the columns `pixels` and `action`, on latents of the encoder of `world_model`; writes the
/// checkpoint and the logs to `out`.
///
/// # Errors
/// When the configuration contradicts the data, `out` holds a checkpoint, the loss is not finite, the run is
/// interrupted (no checkpoint is saved then), or a file cannot be written.
pub fn train(
    config: &InverseConfig,
    world_model: &Checkpoint<Lewm>,
    reader: Arc<dyn Reader>,
    out: &Path,
    threads: usize,
    control: &mut Control<'_>,
) -> Result<TrainSummary> {
    let check_unused = || match Checkpoint::<Lewm>::exists(out) {
        true => Err(Error::config(
            out.display().to_string(),
            "holds a training run already",
            "choose another folder, or remove it",
        )),
        false => Ok(()),
    };
    check_unused()?;
    check_data(config, world_model, &reader)?;
    let _lock = Lock::folder(out)?;
    check_unused()?;
    swm_core::pool::threads(threads)?.install(|| run(config, world_model, reader, out, control))
}

fn run(
    config: &InverseConfig,
    world_model: &Checkpoint<Lewm>,
    reader: Arc<dyn Reader>,
    out: &Path,
    control: &mut Control<'_>,
) -> Result<TrainSummary> {
    let started = Instant::now();
    let key = Key::new(config.seed).with(FAMILY);
    let manifest = manifest(config, world_model, &*reader)?;
    let mut log = log::Log::new(out, 0)?;
    let loader = loader(config, world_model.config.data.frameskip, reader)?;
    let (latent, action_dim) = (world_model.config.model.latent, world_model.action_dim());
    let device = world_model.model.device();
    let init = Init::new(key.with("init"), &device);
    let mut model = Mlp::new(&init, 2 * latent, config.hidden, action_dim);
    init.check()?;
    let mut optimizer = AdamW::new(config.optim.clone());
    let (mut step, mut epoch, mut loss) = (0, 0, f64::NAN);
    let (mut waited, mut clips_per_second) = (0.0, 0.0);
    let mut batches = loader.epoch(epoch, 0);
    while step < config.schedule.steps {
        let waiting = Instant::now();
        let Some(batch) = batches.next() else {
            epoch += 1;
            batches = loader.epoch(epoch, 0);
            continue;
        };
        waited += waiting.elapsed().as_secs_f64();
        control.check()?;
        let pairs = Pairs::draw(world_model, config.offset, &*batch?, key.with("goals").at(step as u64))?;
        let factor = config.schedule.lr_factor(step);
        let norm;
        (model, loss, norm) = optimizer_step(model, &mut optimizer, factor, pairs, &device)?;
        step += 1;
        let (elapsed, lr) = (started.elapsed().as_secs_f64(), config.optim.lr * factor);
        clips_per_second = (step * config.batch_size) as f64 / elapsed;
        let metrics = [
            ("loss", loss),
            ("lr", lr),
            ("gradient_norm", norm),
            ("clips_per_second", clips_per_second),
            ("data_wait", waited / elapsed),
        ];
        let total = config.schedule.steps;
        control.progress(Progress { stage: "train", done: step, total, unit: "steps", metrics: &metrics });
        if step.is_multiple_of(config.log_every) || step == config.schedule.steps {
            log.write(step, &[("loss", loss), ("lr", lr), ("gradient_norm", norm)])?;
        }
    }
    let world_model = world_model.clone();
    let mut checkpoint = InverseCheckpoint { world_model, model, config: config.clone(), manifest };
    let weights = checkpoint.save(out)?;
    let seconds = started.elapsed().as_secs_f64();
    Ok(TrainSummary {
        checkpoint: out.to_owned(),
        weights,
        steps: step,
        interrupted: false,
        stopped_early: false,
        best: None,
        metrics: [("loss".to_owned(), loss)].into(),
        parameters: checkpoint.model.num_params(),
        clips_per_second,
        data_wait: waited / seconds,
        seconds,
    })
}

/// Checks that a dataset has the images of a world model and fills a batch.
///
/// # Errors
/// When it does not.
pub fn check_data(config: &InverseConfig, world_model: &Checkpoint<Lewm>, reader: &Arc<dyn Reader>) -> Result<()> {
    pixels::check(&world_model.config.model, reader.schema(), PIXELS)?;
    loader(config, world_model.config.data.frameskip, Arc::clone(reader)).map(drop)
}

fn manifest(config: &InverseConfig, world_model: &Checkpoint<Lewm>, reader: &dyn Reader) -> Result<Manifest> {
    let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
    manifest.libraries = world_model.manifest.libraries.clone();
    manifest.device = device::name_after(&world_model.model.device(), &world_model.manifest.device);
    manifest.hashes.insert("dataset".to_owned(), reader.content_hash()?);
    manifest.hashes.insert("encoder".to_owned(), world_model.hash().to_owned());
    Ok(manifest)
}

fn loader(config: &InverseConfig, frameskip: usize, reader: Arc<dyn Reader>) -> Result<Loader> {
    let episodes = crate::train::episodes(config.hold_out, Part::Train, &*reader)?;
    let clip =
        ClipSpec { num_steps: config.offset + 1, frameskip, columns: vec![PIXELS.to_owned(), ACTION.to_owned()] };
    let config = LoaderConfig {
        clip,
        batch_size: config.batch_size,
        seed: config.seed,
        threads: 1,
        drop_last: true,
        episodes,
        ..LoaderConfig::default()
    };
    Loader::new(reader, config)
}

/// The training examples of a step: pairs of the latents of a present and a goal frame, and the actions taken at the
/// present frame.
struct Pairs {
    /// The latents of the present and the goal frame, `[pairs, 2 * latent]`.
    latents: Vec<f32>,
    /// The actions of a model step in model units, `[pairs, action_dim]`.
    actions: Vec<f32>,
    count: usize,
}

/// The number of frames encoded in a call: a constant, so that latents do not depend on the number of threads.
const FRAMES_PER_CALL: usize = 64;

impl Pairs {
    /// Draws one pair for every frame of a clip except the last frame. The goal is a random later frame of the clip.
    fn draw(world_model: &Checkpoint<Lewm>, offset: usize, batch: &swm_core::Batch, key: Key) -> Result<Self> {
        let (config, dim) = (&world_model.config.model, world_model.dataset_info.action.dim());
        let (latent, action_dim) = (config.latent, world_model.action_dim());
        let frame = config.image * config.image * 3;
        let device = world_model.model.device();
        let encoded: Result<Vec<Vec<f32>>> = batch
            .get::<u8>(PIXELS)?
            .par_chunks(FRAMES_PER_CALL * frame)
            .map(|frames| {
                let patches = pixels::patches(config, frames, &device)?;
                Ok(world_model.model.encode(patches).into_data().into_f32_vec())
            })
            .collect();
        let encoded = encoded?.concat();
        let actions_taken = batch.to_f32(ACTION)?;
        let count = batch.rows() * offset;
        let mut pairs =
            Self { latents: Vec::with_capacity(2 * count * latent), actions: vec![0.0; count * action_dim], count };
        for clip in 0..batch.rows() {
            let mut rng = key.at(clip as u64).rng();
            for present in 0..offset {
                let goal = rng.random_range(present + 1..=offset);
                for frame in [present, goal] {
                    pairs.latents.extend_from_slice(&encoded[(clip * (offset + 1) + frame) * latent..][..latent]);
                }
                let from = &actions_taken[(clip * (offset + 1) + present) * action_dim..][..action_dim];
                let to = &mut pairs.actions[(clip * offset + present) * action_dim..][..action_dim];
                for (to, from) in to.chunks_exact_mut(dim).zip(from.chunks_exact(dim)) {
                    world_model.dataset_info.action.to_model(from, to);
                }
            }
        }
        Ok(pairs)
    }
}

/// Takes one optimizer step with the learning rate times `factor`; returns the new network, the loss before the step
/// and the norm of the gradient.
fn optimizer_step(
    model: Mlp,
    optimizer: &mut AdamW,
    factor: f64,
    pairs: Pairs,
    device: &Device,
) -> Result<(Mlp, f64, f64)> {
    let tensor = |values: Vec<f32>| {
        let width = values.len() / pairs.count;
        Tensor::<2>::from_data(TensorData::new(values, [pairs.count, width]), device)
    };
    let trained = model.clone().train();
    let predicted = trained.forward(tensor(pairs.latents).autodiff());
    let loss = (predicted - tensor(pairs.actions).autodiff()).square().mean();
    let value = f64::from(loss.clone().inner().into_scalar::<f32>());
    if !value.is_finite() {
        return Err(Error::NotFinite {
            what: "the loss of the inverse-dynamics network".to_owned(),
            given: value.to_string(),
            fix: "lower optim.lr, or check the dataset's actions".to_owned(),
        });
    }
    let gradients = parameters::gradients(&trained, &loss.backward());
    let (model, norm) = optimizer.step(model, factor, gradients, |_| ParameterGroup::default());
    Ok((model, value, norm))
}
