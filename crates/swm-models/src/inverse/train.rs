//! Training the network on a frozen encoder.

use super::InverseCheckpoint;
use super::checkpoint::FAMILY;
use crate::checkpoint::Checkpoint;
use crate::lewm::{Lewm, pixels};
use crate::nn::parameters::{self, IntoF32};
use crate::nn::{Init, Mlp};
use crate::train::{AdamW, Observer, OptimConfig, ParameterGroup, Progress, ScheduleConfig, TrainSummary, config, log};
use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use rand::Rng as _;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;
use swm_core::{Error, Key, Manifest, Result};
use swm_data::{ClipSpec, Loader, LoaderConfig, Part, Reader};

/// Everything that decides the numbers of a run, apart from the encoder and the data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InverseConfig {
    /// Decides initial weights, order of the data and the goals.
    pub seed: u64,
    /// Model steps from a picture to the farthest goal it is trained to reach.
    pub offset: usize,
    /// Hidden features.
    pub hidden: usize,
    /// Clips in a batch.
    pub batch_size: usize,
    /// Whether the episodes that [`swm_data::Split::default`] holds out are left out.
    pub hold_out: bool,
    /// Steps between two lines of the log.
    pub log_every: usize,
    /// The optimizer.
    pub optim: OptimConfig,
    /// The learning rate over time.
    pub schedule: ScheduleConfig,
}

impl InverseConfig {
    /// The configuration that comes with the program, as TOML.
    pub const PRESET: &str = include_str!("../../presets/inverse.toml");

    /// The configuration that comes with the program, changed by `key=value` words with dots.
    ///
    /// # Errors
    /// When there is no such key (naming the nearest), or a value does not fit.
    pub fn load(words: &[String]) -> Result<Self> {
        let config: Self = config::layered(Self::PRESET, words, &[Self::PRESET])?;
        let least = [
            ("offset", config.offset),
            ("hidden", config.hidden),
            ("batch_size", config.batch_size),
            ("log_every", config.log_every),
            ("schedule.steps", config.schedule.steps),
        ];
        match least.into_iter().find(|&(_, value)| value == 0) {
            Some((what, _)) => Err(Error::config(what, "0", "give at least 1")),
            None => Ok(config),
        }
    }

    /// The configuration as TOML.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|error| Error::external("writing a configuration", error))
    }
}

/// Trains on a dataset with the columns `pixels` and `action`, through the encoder of `world`; the checkpoint and the
/// logs go to `out`.
///
/// # Errors
/// When the configuration contradicts the data, `out` holds a run, the loss is not finite, the run is stopped (nothing
/// is saved then), or the disk refuses.
pub fn train(
    config: &InverseConfig,
    world: &Checkpoint<Lewm>,
    reader: Arc<dyn Reader>,
    out: &Path,
    threads: usize,
    observer: &mut dyn Observer,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    if Checkpoint::<Lewm>::exists(out) {
        return Err(Error::config(
            out.display().to_string(),
            "holds a training run already",
            "choose another folder, or remove it",
        ));
    }
    pixels::check(&world.config.model, reader.schema(), "pixels")?;
    swm_core::pool::threads(threads)?.install(|| run(config, world, reader, out, observer, stop))
}

#[allow(clippy::cast_precision_loss)]
fn run(
    config: &InverseConfig,
    world: &Checkpoint<Lewm>,
    reader: Arc<dyn Reader>,
    out: &Path,
    observer: &mut dyn Observer,
    stop: &AtomicBool,
) -> Result<TrainSummary> {
    let begun = Instant::now();
    let key = Key::new(config.seed).with(FAMILY);
    let (block, dim, latent) =
        (world.config.data.frameskip, world.dataset_info.action.dim(), world.config.model.latent);
    let mut manifest = Manifest::new("train", config.seed, serde_json::to_value(config).unwrap_or_default());
    manifest.libraries = world.manifest.libraries.clone();
    manifest.device = world.manifest.device.clone();
    manifest.hashes.insert("dataset".to_owned(), reader.content_hash()?);
    manifest.hashes.insert("encoder".to_owned(), world.hash().to_owned());

    std::fs::create_dir_all(out).map_err(|error| Error::io(out, "creating a folder", error))?;
    let mut log = log::Log::new(out, false)?;
    let episodes = crate::train::episodes(config.hold_out, Part::Train, &*reader)?;
    let loader = Loader::new(
        reader,
        LoaderConfig {
            clip: ClipSpec {
                num_steps: config.offset + 1,
                frameskip: block,
                columns: vec!["pixels".to_owned(), "action".to_owned()],
            },
            batch_size: config.batch_size,
            seed: config.seed,
            threads: 1,
            drop_last: true,
            episodes,
            ..LoaderConfig::default()
        },
    )?;
    let mut model = Mlp::new(&Init::new(key.with("init"), &Device::flex()), 2 * latent, config.hidden, block * dim);
    let mut optimizer = AdamW::new(config.optim.clone());
    let (mut step, mut epoch, mut loss) = (0, 0, f64::NAN);
    let (mut waited, mut clips_per_second) = (0.0, 0.0);
    while step < config.schedule.steps {
        let mut batches = loader.epoch(epoch, 0);
        loop {
            let asked = Instant::now();
            let Some(batch) = batches.next() else { break };
            waited += asked.elapsed().as_secs_f64();
            if stop.load(Ordering::Relaxed) {
                return Err(Error::Interrupted);
            }
            let pairs = Pairs::draw(world, config.offset, &*batch?, key.with("goals").at(step as u64))?;
            let share = config.schedule.share(step);
            let norm;
            (model, loss, norm) = learn(model, &mut optimizer, share, pairs)?;
            step += 1;
            let elapsed = begun.elapsed().as_secs_f64();
            clips_per_second = (step * config.batch_size) as f64 / elapsed;
            observer.progress(&Progress {
                step,
                steps: config.schedule.steps,
                epoch,
                metrics: vec![("loss", loss)],
                validation: None,
                lr: config.optim.lr * share,
                gradient_norm: norm,
                clips_per_second,
                data_wait: waited / elapsed,
            });
            if step.is_multiple_of(config.log_every) || step == config.schedule.steps {
                let lr = config.optim.lr * share;
                log.write(step, &[("loss", loss), ("lr", lr), ("gradient_norm", norm)])?;
            }
            if step == config.schedule.steps {
                break;
            }
        }
        epoch += 1;
    }
    let mut checkpoint = InverseCheckpoint { world: world.clone(), model, config: config.clone(), manifest };
    let weights = checkpoint.save(out)?;
    let seconds = begun.elapsed().as_secs_f64();
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

/// What a step learns from: present and goal beside each other, and the actions in between, in model units.
struct Pairs {
    /// `[pairs, 2 * latent]`.
    latents: Vec<f32>,
    /// `[pairs, actions]`.
    actions: Vec<f32>,
    count: usize,
}

/// Frames encoded at once: a fixed number, so that latents do not depend on the number of threads.
const FRAMES: usize = 64;

impl Pairs {
    /// One pair for every frame of every clip but its last: the goal is one of the later frames, at random.
    fn draw(world: &Checkpoint<Lewm>, offset: usize, batch: &swm_core::Batch, key: Key) -> Result<Self> {
        let (config, dim) = (&world.config.model, world.dataset_info.action.dim());
        let (latent, actions) = (config.latent, world.config.data.frameskip * dim);
        let frame = config.image * config.image * 3;
        let encoded: Result<Vec<Vec<f32>>> = batch
            .get::<u8>("pixels")?
            .par_chunks(FRAMES * frame)
            .map(|frames| {
                let patches = pixels::patches(config, frames, &Device::flex())?;
                Ok(world.model.encode(patches).into_data().into_f32_vec())
            })
            .collect();
        let encoded = encoded?.concat();
        let taken = batch.get::<f32>("action")?;
        let count = batch.rows() * offset;
        let mut pairs =
            Self { latents: Vec::with_capacity(2 * count * latent), actions: vec![0.0; count * actions], count };
        for clip in 0..batch.rows() {
            let mut rng = key.at(clip as u64).rng();
            for present in 0..offset {
                let goal = rng.random_range(present + 1..=offset);
                for at in [present, goal] {
                    pairs.latents.extend_from_slice(&encoded[(clip * (offset + 1) + at) * latent..][..latent]);
                }
                let from = &taken[(clip * (offset + 1) + present) * actions..][..actions];
                let to = &mut pairs.actions[(clip * offset + present) * actions..][..actions];
                for (to, from) in to.chunks_exact_mut(dim).zip(from.chunks_exact(dim)) {
                    world.dataset_info.action.to_model(from, to);
                }
            }
        }
        Ok(pairs)
    }
}

/// One step: the network after it, the loss before it and the norm of the gradient.
fn learn(model: Mlp, optimizer: &mut AdamW, share: f64, pairs: Pairs) -> Result<(Mlp, f64, f64)> {
    let tensor = |numbers: Vec<f32>| {
        let width = numbers.len() / pairs.count;
        Tensor::<2>::from_data(TensorData::new(numbers, [pairs.count, width]), &Device::flex())
    };
    let trained = model.clone().train();
    let said = trained.forward(tensor(pairs.latents).autodiff());
    let loss = (said - tensor(pairs.actions).autodiff()).square().mean();
    let value = f64::from(loss.clone().inner().into_scalar::<f32>());
    if !value.is_finite() {
        return Err(Error::NotFinite {
            what: "the loss of the inverse-dynamics network".to_owned(),
            given: value.to_string(),
            fix: "lower optim.lr, or check the dataset's actions".to_owned(),
        });
    }
    let gradients = parameters::gradients(&trained, &loss.backward());
    let (model, norm) = optimizer.step(model, share, gradients, |_| ParameterGroup::default());
    Ok((model, value, norm))
}
