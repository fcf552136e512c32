//! [`FAMILIES`]: the model families of this build, and what the program can do with a model of each: train it, load it,
//! plan in it, let it act, hold its predictions against recordings.

use crate::predictor::LewmPredictor;
use serde_json::{Value, json};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use swm_core::{CostModel, EnvPool, EnvSpec, Error, Manifest, Named, Policy, Registry, Result};
use swm_data::Reader;
use swm_eval::Predictor;
use swm_models::dino_wm::{self, DinoWm, DinoWmCost};
use swm_models::gcrl::{self, Gcbc, Gciql, Gcivl, GoalConditioned as _};
use swm_models::inverse::{self, InverseCheckpoint, InverseConfig, InversePolicy};
use swm_models::lewm::{self, Lewm, LewmCost};
use swm_models::online::{Agent, OnlineSummary, SharedModel, train_online};
use swm_models::pldm::{self, Pldm};
use swm_models::probe::ImageEncoder;
use swm_models::sac::Sac;
use swm_models::tdmpc2::{self, Tdmpc2, Tdmpc2Cost};
use swm_models::train::{DatasetInfo, Preset};
use swm_models::weights::Naming;
use swm_models::{Checkpoint, Device, Observer, TrainConfig, TrainOptions, TrainSummary, Trainable, checkpoint};

/// The families, in the order in which they are listed.
pub static FAMILIES: Registry<Family> = Registry {
    kind: "model",
    hint: "`swm models` lists them",
    rows: &[
        family::<Lewm>(),
        family::<Pldm>(),
        family::<DinoWm>(),
        family::<Tdmpc2>(),
        family::<Gcbc>(),
        family::<Gcivl>(),
        family::<Gciql>(),
        family::<Sac>(),
        INVERSE,
    ],
};

/// From a preset and `key=value` words to what can be trained.
pub type Configure = fn(&str, &[String]) -> Result<Box<dyn Training>>;

/// A model family.
pub struct Family {
    /// Its name.
    pub id: &'static str,
    /// What it is, in a sentence.
    pub summary: &'static str,
    /// Its configurations; the first is what is meant when none is named.
    pub presets: &'static [Preset],
    /// Whether it sees through the encoder of another checkpoint.
    pub borrows: bool,
    /// A complete configuration, from a preset and `key=value` words.
    pub config: Configure,
    /// Loads a checkpoint.
    pub load: fn(&Path, &Device) -> Result<Box<dyn Loaded>>,
    /// Makes a checkpoint, in the last folder, of what the reference trained (its `weights.pt` and `config.json` are in the first) on
    /// a dataset; none where the reference has no such family.
    pub import: fn(&Path, &dyn Reader, &Path) -> Option<Result<String>>,
}

impl Named for Family {
    fn id(&self) -> &'static str {
        self.id
    }
}

/// What a checkpoint holds, whatever its family.
pub struct Card {
    /// The family.
    pub family: &'static str,
    /// The hash of the weights.
    pub weights: String,
    /// How it was trained, as JSON.
    pub config: Value,
    /// The same, as TOML.
    pub toml: String,
    /// What it knows of its data.
    pub dataset_info: DatasetInfo,
    /// The side of the pictures it sees, if it sees any.
    pub image: Option<usize>,
    /// Environment steps in a model step.
    pub action_block: usize,
    /// Frames it looks at to predict.
    pub history: usize,
    /// Where it came from.
    pub manifest: Manifest,
}

/// A checkpoint of any family.
pub trait Loaded {
    /// What it holds.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    fn card(&self) -> Result<Card>;

    /// The cost of a plan in it; none for a model that acts without planning.
    fn cost(&self) -> Option<Box<dyn CostModel>>;

    /// Whether it knows by itself what to do, without one of the solvers.
    fn acts(&self) -> bool;

    /// A policy that acts as it says, without planning, in `slots` environments; none for a model that only predicts.
    ///
    /// # Errors
    /// When the environment has other actions than the model was trained for.
    fn policy(&self, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>>;

    /// Its predictions, to be held against recordings; none for a model without a rollout of latents.
    fn predictor(&self) -> Option<Box<dyn Predictor>>;

    /// Writes what the reference's `load_pretrained` reads; none where the reference has no such family.
    ///
    /// # Errors
    /// When the reference has no model of these sizes, or the disk refuses.
    fn export(&self, folder: &Path) -> Option<Result<()>>;

    /// Its encoder, to be probed; none for a model without eyes.
    fn encoder(&self) -> Option<Box<dyn ImageEncoder>>;
}

/// A configuration to train with.
pub trait Training {
    /// It, as TOML.
    ///
    /// # Errors
    /// Never for a configuration that was loaded.
    fn toml(&self) -> Result<String>;

    /// It, as JSON.
    fn json(&self) -> Value;

    /// Steps to train.
    fn steps(&self) -> usize;

    /// The side of the square pictures the model sees, if it sees any.
    fn image_size(&self) -> Option<usize>;

    /// Trains by playing in the worlds that `worlds` makes, as many as it is asked for; none for a family that learns from
    /// datasets only.
    ///
    /// # Errors
    /// As [`swm_models::online::train_online`].
    fn play(&self, on: PlayOn<'_>, observer: &mut dyn Observer, stop: &AtomicBool) -> Option<Result<OnlineSummary>>;

    /// Trains on `reader`; the checkpoint and the logs go to `out`. `encoder` is the checkpoint to see through, for
    /// families that do.
    ///
    /// # Errors
    /// As [`swm_models::train`].
    fn train(&self, on: TrainOn<'_>, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<TrainSummary>;
}

/// What a model is trained on and with.
pub struct TrainOn<'a> {
    /// The dataset.
    pub reader: Arc<dyn Reader>,
    /// The checkpoint whose encoder it sees through, for families that do.
    pub encoder: Option<&'a Path>,
    /// Where the checkpoint and the logs go.
    pub out: &'a Path,
    /// What does not decide the numbers.
    pub options: TrainOptions,
}

/// What a model learns by playing in.
pub struct PlayOn<'a> {
    /// Makes worlds.
    pub worlds: &'a dyn Fn(usize) -> Result<EnvPool>,
    /// Where the checkpoint and the logs go.
    pub out: &'a Path,
    /// What does not decide the numbers.
    pub options: TrainOptions,
}

/// What a model of a family can be used for.
trait Usable: Trainable {
    /// Frames it looks at to predict.
    fn history(_config: &TrainConfig<Self>) -> usize {
        1
    }

    /// As [`Loaded::cost`].
    fn cost(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        None
    }

    /// As [`Loaded::acts`].
    const ACTS: bool = false;

    /// As [`Loaded::policy`].
    fn policy(_checkpoint: &Checkpoint<Self>, _spec: &EnvSpec, _slots: usize) -> Option<Result<Box<dyn Policy>>> {
        None
    }

    /// As [`Loaded::predictor`].
    fn predictor(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        None
    }

    /// As [`Loaded::encoder`].
    fn encoder(_checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        None
    }

    /// What the reference trained, as a checkpoint of this program.
    fn import(_from: &Path, _facts: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        None
    }

    /// As [`Loaded::export`].
    fn export(_checkpoint: &Checkpoint<Self>, _folder: &Path) -> Option<Result<()>> {
        None
    }

    /// As [`Training::play`].
    fn play(
        _config: &TrainConfig<Self>,
        _on: PlayOn<'_>,
        _observer: &mut dyn Observer,
        _stop: &AtomicBool,
    ) -> Option<Result<OnlineSummary>> {
        None
    }
}

impl Usable for Lewm {
    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(LewmCost::new(checkpoint)))
    }

    fn predictor(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        let scale = checkpoint.dataset_info.action.clone();
        let (config, block) = (&checkpoint.config.model, checkpoint.config.data.frameskip);
        Some(Box::new(LewmPredictor::new(&checkpoint.model, config, scale, block)))
    }

    fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(checkpoint.clone()))
    }

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(lewm::import::import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(lewm::import::export(checkpoint, folder, Naming::default()))
    }
}

impl Usable for Pldm {
    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(pldm::cost(checkpoint)))
    }

    fn predictor(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn Predictor>> {
        let scale = checkpoint.dataset_info.action.clone();
        let (config, block) = (&checkpoint.config.model, checkpoint.config.data.frameskip);
        Some(Box::new(LewmPredictor::new(&checkpoint.model.model, config, scale, block)))
    }

    fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(checkpoint.clone()))
    }

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(pldm::import::import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(pldm::import::export(checkpoint, folder, Naming::default()))
    }
}

impl Usable for DinoWm {
    fn history(config: &TrainConfig<Self>) -> usize {
        config.model.predictor.history
    }

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(DinoWmCost::new(checkpoint)))
    }

    fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(checkpoint.clone()))
    }

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(dino_wm::import::import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(dino_wm::import::export(checkpoint, folder, Naming::default()))
    }
}

impl Usable for Tdmpc2 {
    const ACTS: bool = true;

    fn cost(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn CostModel>> {
        Some(Box::new(Tdmpc2Cost::new(checkpoint)))
    }

    fn policy(checkpoint: &Checkpoint<Self>, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        Some(agent(checkpoint, spec, slots))
    }

    fn play(
        config: &TrainConfig<Self>,
        on: PlayOn<'_>,
        observer: &mut dyn Observer,
        stop: &AtomicBool,
    ) -> Option<Result<OnlineSummary>> {
        Some(train_online(config, on.worlds, on.out, &on.options, observer, stop))
    }

    fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
        Some(tdmpc2::import(from, dataset_info))
    }

    fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
        Some(tdmpc2::export(checkpoint, folder))
    }
}

impl Usable for Sac {
    const ACTS: bool = true;

    fn policy(checkpoint: &Checkpoint<Self>, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        Some(agent(checkpoint, spec, slots))
    }

    fn play(
        config: &TrainConfig<Self>,
        on: PlayOn<'_>,
        observer: &mut dyn Observer,
        stop: &AtomicBool,
    ) -> Option<Result<OnlineSummary>> {
        Some(train_online(config, on.worlds, on.out, &on.options, observer, stop))
    }
}

/// The policy of a model that learnt by playing.
fn agent<M: Agent>(checkpoint: &Checkpoint<M>, spec: &EnvSpec, slots: usize) -> Result<Box<dyn Policy>> {
    M::policy(
        &checkpoint.config,
        &checkpoint.dataset_info,
        SharedModel::new(checkpoint.model.clone()),
        spec,
        slots,
        false,
    )
}

/// Goal-conditioned models act without planning.
macro_rules! acts {
    ($($model:ty),*) => {
        $(impl Usable for $model {
            const ACTS: bool = true;

            fn history(config: &TrainConfig<Self>) -> usize {
                config.model.history
            }

            fn policy(checkpoint: &Checkpoint<Self>, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
                let policy = Self::actor(checkpoint).policy(spec, slots);
                Some(policy.map(|policy| Box::new(policy) as Box<dyn Policy>))
            }

            fn encoder(checkpoint: &Checkpoint<Self>) -> Option<Box<dyn ImageEncoder>> {
                Some(Box::new(Self::actor(checkpoint)))
            }
            fn import(from: &Path, dataset_info: DatasetInfo) -> Option<Result<Checkpoint<Self>>> {
                Some(gcrl::import::import(from, dataset_info))
            }

            fn export(checkpoint: &Checkpoint<Self>, folder: &Path) -> Option<Result<()>> {
                Some(gcrl::import::export(checkpoint, folder, Naming::default()))
            }
        })*
    };
}
acts!(Gcbc, Gcivl, Gciql);

/// The row of a family.
const fn family<M: Usable>() -> Family {
    Family {
        id: M::FAMILY,
        summary: M::SUMMARY,
        presets: M::PRESETS,
        borrows: false,
        config: |preset, words| Ok(Box::new(TrainConfig::<M>::load(preset, words)?)),
        load: |run, device| Ok(Box::new(Checkpoint::<M>::load(run, device)?)),
        import: |from, reader, out| {
            let columns: Vec<String> = reader.schema().columns().iter().map(|column| column.name.clone()).collect();
            let dataset_info = match DatasetInfo::from_reader(reader, &columns, M::BOUNDED_ACTIONS) {
                Ok(dataset_info) => dataset_info,
                Err(error) => return Some(Err(error)),
            };
            Some(M::import(from, dataset_info)?.and_then(|mut checkpoint| checkpoint.save_to(out)))
        },
    }
}

impl<M: Usable> Training for TrainConfig<M> {
    fn toml(&self) -> Result<String> {
        self.to_toml()
    }

    fn json(&self) -> Value {
        json!(self)
    }

    fn steps(&self) -> usize {
        self.schedule.steps
    }

    fn image_size(&self) -> Option<usize> {
        M::image_size(&self.model)
    }

    fn play(&self, on: PlayOn<'_>, observer: &mut dyn Observer, stop: &AtomicBool) -> Option<Result<OnlineSummary>> {
        M::play(self, on, observer, stop)
    }

    fn train(&self, on: TrainOn<'_>, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<TrainSummary> {
        swm_models::train(self, on.reader, on.out, &on.options, observer, stop)
    }
}

impl<M: Usable> Loaded for Checkpoint<M> {
    fn card(&self) -> Result<Card> {
        Ok(Card {
            family: M::FAMILY,
            weights: self.hash().to_owned(),
            config: json!(self.config),
            toml: self.config.to_toml()?,
            dataset_info: self.dataset_info.clone(),
            image: M::image_size(&self.config.model),
            action_block: self.config.data.frameskip,
            history: M::history(&self.config),
            manifest: self.manifest.clone(),
        })
    }

    fn cost(&self) -> Option<Box<dyn CostModel>> {
        M::cost(self)
    }

    fn acts(&self) -> bool {
        M::ACTS
    }

    fn policy(&self, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        M::policy(self, spec, slots)
    }

    fn predictor(&self) -> Option<Box<dyn Predictor>> {
        M::predictor(self)
    }

    fn export(&self, folder: &Path) -> Option<Result<()>> {
        M::export(self, folder)
    }

    fn encoder(&self) -> Option<Box<dyn ImageEncoder>> {
        M::encoder(self)
    }
}

/// The checkpoint in a folder, of whatever family it is.
///
/// # Errors
/// When there is none, its family is unknown here, it is damaged, or its weights do not fit its configuration.
pub fn load(run: &Path, device: &Device) -> Result<Box<dyn Loaded>> {
    let Some(family) = checkpoint::family(run) else {
        return Err(Error::corrupt(run, "there is no checkpoint", "give the folder that `swm train` wrote to"));
    };
    let Some(row) = FAMILIES.rows.iter().find(|row| row.id == family) else {
        let problem = format!("it holds a model of the family '{family}', which this program does not know");
        return Err(Error::corrupt(run, problem, "give another checkpoint; `swm models` lists the families"));
    };
    (row.load)(run, device)
}

/// Inverse dynamics, which is trained in a way of its own: on the latents of another checkpoint.
const INVERSE: Family = Family {
    id: "inverse",
    summary: "inverse dynamics on the frozen encoder of another checkpoint: acts without planning, the cheap baseline",
    presets: &[Preset {
        id: "tiny",
        summary: "trains in seconds on two CPU cores, given --encoder",
        toml: InverseConfig::PRESET,
    }],
    borrows: true,
    config: |_, words| Ok(Box::new(InverseConfig::load(words)?)),
    load: |run, device| Ok(Box::new(InverseCheckpoint::load(run, device)?)),
    import: |_, _, _| None,
};

impl Training for InverseConfig {
    fn toml(&self) -> Result<String> {
        self.to_toml()
    }

    fn json(&self) -> Value {
        json!(self)
    }

    fn steps(&self) -> usize {
        self.schedule.steps
    }

    fn image_size(&self) -> Option<usize> {
        None
    }

    fn play(&self, _: PlayOn<'_>, _: &mut dyn Observer, _: &AtomicBool) -> Option<Result<OnlineSummary>> {
        None
    }

    fn train(&self, on: TrainOn<'_>, observer: &mut dyn Observer, stop: &AtomicBool) -> Result<TrainSummary> {
        let Some(encoder) = on.encoder else {
            return Err(Error::config(
                "--encoder",
                "an inverse-dynamics policy sees through another model's encoder",
                "name a checkpoint with --encoder (`swm checkpoints` lists them)",
            ));
        };
        if on.options.resume {
            return Err(Error::config(
                "--resume",
                "training an inverse-dynamics policy takes seconds and begins anew",
                "leave out --resume and choose another --output",
            ));
        }
        let world = Checkpoint::<Lewm>::load(encoder, &on.options.device)?;
        inverse::train(self, &world, on.reader, on.out, on.options.threads, observer, stop)
    }
}

impl Loaded for InverseCheckpoint {
    fn card(&self) -> Result<Card> {
        Ok(Card {
            family: INVERSE.id,
            weights: self.hash().to_owned(),
            config: json!(self.config),
            toml: self.config.to_toml()?,
            dataset_info: self.world.dataset_info.clone(),
            image: Lewm::image_size(&self.world.config.model),
            action_block: self.world.config.data.frameskip,
            history: 1,
            manifest: self.manifest.clone(),
        })
    }

    fn cost(&self) -> Option<Box<dyn CostModel>> {
        None
    }

    fn acts(&self) -> bool {
        true
    }

    fn policy(&self, spec: &EnvSpec, slots: usize) -> Option<Result<Box<dyn Policy>>> {
        Some(InversePolicy::new(self.clone(), spec, slots).map(|policy| Box::new(policy) as Box<dyn Policy>))
    }

    fn predictor(&self) -> Option<Box<dyn Predictor>> {
        None
    }

    fn export(&self, _: &Path) -> Option<Result<()>> {
        None
    }

    fn encoder(&self) -> Option<Box<dyn ImageEncoder>> {
        Some(Box::new(self.world.clone()))
    }
}
