//! Studies of the kind `drift`: how far a policy's observations lie from those that a TD-MPC2 was trained on, in its latents.
//!
//! A TD-MPC2 is trained on a dataset of an expert. Then the expert, the actor of the model, its planner and a random policy play
//! the same starts. Each row has the distance of their latents to the nearest latent of the training episodes, and its paths
//! are the latents along the two principal components of those.

use super::chosen::{Chosen, add_config, check_config};
use crate::cli::{Context, train_folder};
use crate::{home, resolver};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use swm_core::results::{LatentSupport, TableColumn};
use swm_core::run::{Control, Event};
use swm_core::{Batch, EnvChoice, Error, Key, Origin, Policy, RandomPolicy, Result, VariationRequest};
use swm_data::{Part, Reader, Split, StepRange};
use swm_eval::{EvalConfig, Measured, Starts, StudyFolder, TableCell, World, WorldConfig};
use swm_models::online::{self, StochasticPolicy};
use swm_models::tdmpc2::{Tdmpc2, latent};
use swm_models::{Checkpoint, FAMILIES, TrainOptions, TrainRun, device};

/// The family of the model.
const FAMILY: &str = "tdmpc2";
/// The row of episodes that were not trained on.
const HELD_OUT: &str = "held-out episodes";
/// The rows of policies.
const POLICIES: [&str; 4] = ["expert", ACTOR, PLANNER, "random policy"];
const ACTOR: &str = "TD-MPC2's actor";
const PLANNER: &str = "TD-MPC2's planner";
/// The shares of an episode at which distances are reported, in percent.
const SHARES: [usize; 5] = [0, 25, 50, 75, 100];
/// The unit of distances.
const UNIT: &str = "× held-out";
/// The environments that are played at the same time.
const ENVS: usize = 4;
/// The frames that are read together.
const BLOCK: usize = 64;
/// The decimal places of stored points.
const PLACES: f64 = 1e4;

/// The settings of the kind.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub(super) struct DriftSettings {
    /// The environment, with its options.
    env: String,
    /// The dataset that the model is trained on.
    dataset: String,
    /// The expert that plays.
    expert: String,
    /// The preset of the model.
    preset: String,
    /// Settings of the training, each KEY=VALUE.
    train: Vec<String>,
    /// Optimizer steps.
    steps: usize,
    /// The seed of the training and of the starts.
    seed: u64,
    /// The episodes that every policy plays.
    episodes: usize,
    /// The time limit of an episode, in steps; 0 for the environment's.
    max_steps: usize,
    /// The most frames of training episodes, and of held-out ones, that are encoded.
    frames: usize,
}

impl Default for DriftSettings {
    fn default() -> Self {
        Self {
            env: String::new(),
            dataset: String::new(),
            expert: "expert".to_owned(),
            preset: "tiny".to_owned(),
            train: vec![],
            steps: 6000,
            seed: 0,
            episodes: 20,
            max_steps: 0,
            frames: 4000,
        }
    }
}

/// The columns: distances along an episode, the share of frames outside, and the variance that the figure shows.
pub(super) fn columns() -> Vec<TableColumn> {
    let column = |name: String, unit: &str| TableColumn { name, unit: unit.to_owned(), published: false };
    let at = |share: &usize| column(format!("at {share} %"), UNIT);
    let shares = [("outside", "% of frames"), ("in the plane", "% of variance")];
    SHARES.iter().map(at).chain(shares.map(|(name, unit)| column(name.to_owned(), unit))).collect()
}

impl DriftSettings {
    /// Checks what can be checked before training.
    ///
    /// # Errors
    /// When a name does not exist, a file names what only the user may name, or a number is out of range.
    pub(super) fn check(&self, chosen: &Chosen<'_>) -> Result<()> {
        let env = crate::env(&self.env, chosen.by("env"))?;
        resolver::check_scripted(&env.entry, &self.expert)?;
        if self.expert == "random" {
            let fix = "name an expert of the environment (`swm envs` lists them)";
            return Err(Error::config("settings of the study", "expert is random, which has a row of its own", fix));
        }
        Starts::episodic(self.episodes, 0, VariationRequest::default())?;
        chosen.check_preset(&self.preset)?;
        (FAMILIES.get(FAMILY)?.config)(&self.preset, &self.overrides())?;
        if self.steps == 0 || self.episodes == 0 || self.frames < 10 {
            let problem = format!("{} steps, {} episodes and {} frames", self.steps, self.episodes, self.frames);
            let fix = "give at least 1 step, 1 episode and 10 frames";
            return Err(Error::config("settings of the study", problem, fix));
        }
        if self.dataset.is_empty() || self.dataset.contains("://") {
            let problem = format!("'{}' is not the name of a dataset", self.dataset);
            return Err(Error::config("settings of the study", problem, "name one that a [[collect]] table collects"));
        }
        Ok(())
    }

    /// A row for the held-out episodes, then one for each policy. `collected` are the commands that collect the dataset.
    ///
    /// # Errors
    /// When the preset is a file and cannot be read.
    pub(super) fn cells(&self, collected: &[Vec<String>]) -> Result<Vec<TableCell>> {
        let cell = |row: &str| {
            let mut request = json!({
                "kind": "drift",
                "row": row,
                "settings": self,
                "collected": collected,
                "version": env!("CARGO_PKG_VERSION"),
            });
            add_config(&mut request, FAMILY, &self.preset, &self.overrides())?;
            Ok(TableCell { name: row.to_owned(), request, published: vec![] })
        };
        std::iter::once(HELD_OUT).chain(POLICIES).map(cell).collect()
    }

    /// The settings of the training configuration.
    fn overrides(&self) -> Vec<String> {
        let own = [format!("seed={}", self.seed), format!("schedule.steps={}", self.steps)];
        own.into_iter().chain(self.train.iter().cloned()).collect()
    }
}

/// What all rows share: the trained model and the latents of its dataset.
pub(super) struct Trained {
    settings: DriftSettings,
    choice: EnvChoice,
    checkpoint: Checkpoint<Tdmpc2>,
    support: LatentSupport,
    /// The latents of held-out episodes, episode by episode.
    held_out: Vec<Vec<f32>>,
}

impl Trained {
    /// Trains the model, or continues an interrupted training, and encodes its dataset.
    ///
    /// # Errors
    /// When the dataset is missing, or training fails or is interrupted.
    pub(super) fn new(
        cell: &TableCell,
        folder: &StudyFolder,
        context: &Context,
        control: &mut Control<'_>,
    ) -> Result<Self> {
        let settings: DriftSettings = serde_json::from_value(cell.request["settings"].clone())
            .map_err(|error| Error::external("reading the settings of a study", error))?;
        // The study has checked who chose the id.
        let choice = crate::env(&settings.env, &Origin::User)?;
        let reader = home::open_dataset(&settings.dataset)?;
        let config = (FAMILIES.get(FAMILY)?.config)(&settings.preset, &settings.overrides())?;
        check_config(&cell.request, &settings.preset, &*config)?;
        let out = folder.model(&model_name(&cell.request)?)?;
        train_folder::check_links(&out)?;
        let options = TrainOptions {
            resume: true,
            device: device::parse("cpu")?,
            threads: context.threads,
            cache: home::weights()?,
            ..TrainOptions::default()
        };
        let setup = TrainRun { reader: reader.clone(), encoder: None, out: &out, options };
        let mut inner = Control::new().with_poll(|| control.check());
        let summary = config.train(setup, &mut inner)?;
        drop(inner);
        if summary.interrupted {
            return Err(Error::Interrupted);
        }
        let checkpoint = Checkpoint::<Tdmpc2>::load(&out, &device::parse("cpu")?)?;
        control.emit(Event::Log(&format!("the model is {}", out.display())));
        let train = encoded(&checkpoint, &*reader, Part::Train, settings.frames)?.concat();
        let held_out = encoded(&checkpoint, &*reader, Part::Validation, settings.frames)?;
        let dim = checkpoint.config.model.latent();
        let support = LatentSupport::new(train, &held_out.concat(), dim)?;
        Ok(Self { settings, choice, checkpoint, support, held_out })
    }

    /// What is measured of a row.
    ///
    /// # Errors
    /// When a policy or an environment fails.
    pub(super) fn measure(&self, row: &str, context: &Context, control: &mut Control<'_>) -> Result<Measured> {
        let is_held_out = row == HELD_OUT;
        let episodes = if is_held_out { self.held_out.clone() } else { self.play(row, context, control)? };
        let dim = self.checkpoint.config.model.latent();
        let distances: Vec<Vec<f64>> = episodes.iter().map(|latents| self.support.distances(latents)).collect();
        let all: Vec<f32> = episodes.concat();
        if all.is_empty() {
            return Err(Error::config(row, "every start is solved already", "set another seed, such as seed=1"));
        }
        let at = |share: &usize| {
            let of = |distances: &Vec<f64>| Some(distances[(distances.len().checked_sub(1)? * share + 50) / 100]);
            let values: Vec<f64> = distances.iter().filter_map(of).collect();
            values.iter().sum::<f64>() / values.len() as f64
        };
        let mut values: Vec<f64> = SHARES.iter().map(at).collect();
        let outside = distances.iter().flatten().filter(|distance| **distance > self.support.edge()).count();
        values.push(100.0 * outside as f64 / (all.len() / dim) as f64);
        values.push(100.0 * self.support.kept(&all));
        let round = |point: [f64; 2]| point.map(|value| (value * PLACES).round() / PLACES);
        let path = |latents: &Vec<f32>| self.support.project(latents).into_iter().map(round).collect::<Vec<_>>();
        let paths: Vec<Vec<[f64; 2]>> = episodes.iter().map(path).collect();
        // The held-out frames are a cloud of dots.
        let dots = |paths: Vec<Vec<[f64; 2]>>| paths.into_iter().flatten().map(|point| vec![point]).collect();
        Ok(Measured { values, paths: if is_held_out { dots(paths) } else { paths } })
    }

    /// Plays the starts with the policy of a row; returns the latents of each episode.
    fn play(&self, row: &str, context: &Context, control: &mut Control<'_>) -> Result<Vec<Vec<f32>>> {
        let (settings, checkpoint) = (&self.settings, &self.checkpoint);
        let envs = ENVS.min(settings.episodes);
        let image = checkpoint.config.model.image_encoding().map(|_| checkpoint.config.model.image);
        let config = WorldConfig {
            envs,
            image: image.map(|side| (side, side)),
            views: vec![],
            max_episode_steps: Some(settings.max_steps).filter(|steps| *steps > 0),
            threads: context.threads,
        };
        let mut world = World::of(|| self.choice.env(), config)?;
        let policy: Box<dyn Policy> = match row {
            ACTOR => Box::new(StochasticPolicy::of(checkpoint, world.spec(), envs)?),
            PLANNER => online::policy(checkpoint, world.spec(), envs)?,
            "expert" => resolver::scripted(&self.choice.entry, &settings.expert, &world)?,
            _ => Box::new(RandomPolicy::new(world.spec(), envs)),
        };
        let mut recorded = Recorded { policy, checkpoint, of_slot: vec![0; envs], episodes: vec![] };
        // The dataset may have been collected with the same seed: these are other episodes.
        let seed = Key::new(settings.seed).with("starts of a study of drift").seed() >> 1;
        let starts = Starts::episodic(settings.episodes, seed, VariationRequest::default())?;
        world.evaluate(&mut recorded, &starts, &EvalConfig::default(), control)?;
        Ok(recorded.episodes)
    }
}

/// The name of the model that all rows of a study share.
pub(super) fn model_name(request: &Value) -> Result<String> {
    let mut shared = request.clone();
    shared["row"] = Value::Null;
    let id = TableCell { name: String::new(), request: shared, published: vec![] }.id()?;
    Ok(format!("{FAMILY}-{id}"))
}

/// The latents of a part of a dataset, episode by episode, at most about `frames` in all: every n-th row.
fn encoded(checkpoint: &Checkpoint<Tdmpc2>, reader: &dyn Reader, part: Part, frames: usize) -> Result<Vec<Vec<f32>>> {
    let chosen = Split::default().episodes(reader, part)?;
    let rows: usize = chosen.iter().map(|episode| reader.episodes()[*episode].length).sum();
    let every = rows.div_ceil(frames).max(1);
    let names = checkpoint.config.model.columns();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut latents = vec![];
    for episode in chosen {
        let rows = (0..reader.episodes()[episode].length).step_by(every);
        let ranges: Vec<StepRange> = rows.map(|row| StepRange::new(episode, row, 1)).collect();
        let mut of_episode = vec![];
        for ranges in ranges.chunks(BLOCK) {
            let batch = reader.read(&names, ranges)?;
            for row in 0..batch.rows() {
                of_episode.extend(latent(&checkpoint.config.model, &checkpoint.model, &batch, row)?);
            }
        }
        latents.push(of_episode);
    }
    Ok(latents)
}

/// A policy whose observations are encoded before it acts.
struct Recorded<'a> {
    policy: Box<dyn Policy>,
    checkpoint: &'a Checkpoint<Tdmpc2>,
    /// The episode of each slot. Episodes begin in order.
    of_slot: Vec<usize>,
    episodes: Vec<Vec<f32>>,
}

impl Policy for Recorded<'_> {
    fn begin(&mut self, slot: usize, key: Key) {
        self.of_slot[slot] = self.episodes.len();
        self.episodes.push(vec![]);
        self.policy.begin(slot, key);
    }

    fn act(&mut self, infos: &Batch, active: &[bool], actions: &mut Batch) -> Result<()> {
        for (slot, episode) in self.of_slot.iter().enumerate().filter(|(slot, _)| active[*slot]) {
            let of = latent(&self.checkpoint.config.model, &self.checkpoint.model, infos, slot)?;
            self.episodes[*episode].extend(of);
        }
        self.policy.act(infos, active, actions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_that_no_study_can_have_are_errors() {
        let settings =
            DriftSettings { env: "swm/PushT-v1".to_owned(), dataset: "push-t".to_owned(), ..DriftSettings::default() };
        settings.check(&Chosen::by_user()).expect("settings");
        let cells = settings.cells(&[]).expect("cells");
        assert_eq!(cells.len(), 5);
        let models: Vec<String> = cells.iter().map(|cell| model_name(&cell.request).expect("a name")).collect();
        assert!(models.iter().all(|model| *model == models[0]), "all rows have one model");
        for (wrong, part) in [
            (DriftSettings { steps: 0, ..settings.clone() }, "schedule.steps: 0"),
            (DriftSettings { dataset: "s3://bucket/a".to_owned(), ..settings.clone() }, "[[collect]]"),
            (DriftSettings { train: vec!["optim.rl=1".to_owned()], ..settings.clone() }, "optim"),
            (DriftSettings { env: "swm/PushT-v2".to_owned(), ..settings.clone() }, "PushT-v1"),
            (DriftSettings { expert: "/etc/passwd".to_owned(), ..settings.clone() }, "/etc/passwd"),
            (DriftSettings { expert: "random".to_owned(), ..settings.clone() }, "expert is random"),
            (DriftSettings { episodes: 1 << 60, ..settings.clone() }, "number of evaluated episodes"),
        ] {
            let error = wrong.check(&Chosen::by_user()).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
