//! What pages ask to start, and the arguments of the program that does it. Everything that a page chose is checked, or looked
//! up, before it becomes an argument.

use crate::Lab;
use crate::datasets::is_dataset;
use crate::folders::{Folders, check_name, new_dataset};
use crate::plans::messages::Named;
use crate::plans::{SIMULATOR, Settings};
use crate::still;
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::fmt::{self, Display, Formatter};
use std::path::PathBuf;
use swm_core::{Error, Result, limits};

/// About how many points the curve of a training has.
const POINTS: usize = 200;
/// The largest number of steps of a training.
const MOST_STEPS: usize = 10_000_000;
/// The largest number of episodes of a dataset and of an evaluation.
const MOST_EPISODES: usize = 100_000;
/// The folder of evaluations in the first folder of results.
const RESULTS: &str = "results";

/// What a process does.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// It trains a model.
    Training,
    /// It collects episodes.
    Collection,
    /// It evaluates a planner.
    Evaluation,
}

impl Kind {
    /// What it writes.
    pub fn result(self) -> &'static str {
        match self {
            Self::Training => "run",
            Self::Collection => "dataset",
            Self::Evaluation => "folder of results",
        }
    }
}

impl Display for Kind {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Training => "training",
            Self::Collection => "collection",
            Self::Evaluation => "evaluation",
        })
    }
}

/// What a page asks for.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Request {
    /// A training.
    Train(Train),
    /// A collection.
    Collect(Collect),
    /// An evaluation.
    Evaluate(Evaluate),
}

/// A training on a dataset.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Train {
    /// The id of the family.
    family: String,
    /// The id of the preset.
    preset: String,
    /// The index of the dataset's folder.
    folder: usize,
    /// The dataset.
    dataset: String,
    /// The plain name of the run.
    name: String,
    /// Steps.
    steps: usize,
    /// The seed.
    seed: u32,
}

/// A collection of episodes.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Collect {
    /// The environment.
    env: String,
    /// An expert of the environment, or `random`.
    policy: String,
    /// Episodes.
    episodes: usize,
    /// The side of frames in pixels.
    image: usize,
    /// The seed.
    seed: u32,
    /// Pinned factors, as [`still::StillQuery`] has them.
    #[serde(default)]
    pin: String,
    /// Factors to sample, in the same way.
    variation: Option<String>,
    /// The plain name of the dataset.
    name: String,
}

/// An evaluation of a planner.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Evaluate {
    /// The environment.
    env: String,
    /// The planner.
    planner: Settings,
    /// The dataset whose recorded states are starts and goals; `None` for episodes of the environment.
    dataset: Option<Named>,
    /// Episodes.
    episodes: usize,
    /// The seed.
    seed: u32,
    /// The plain name of the folder of results.
    name: String,
}

/// A process to start.
pub struct Order {
    /// What it does.
    pub kind: Kind,
    /// The name of what it writes.
    pub name: String,
    /// What it trains, or what acts.
    pub what: String,
    /// The path of what it writes.
    pub output: PathBuf,
    /// The arguments of the program.
    pub arguments: Vec<OsString>,
}

impl Request {
    /// Checks the request, and returns what it starts.
    ///
    /// # Errors
    /// When something is unknown or out of bounds, or the lab has no folder for it.
    pub fn order(&self, lab: &Lab) -> Result<Order> {
        let mut order = match self {
            Self::Train(train) => train.order(lab)?,
            Self::Collect(collect) => collect.order(lab)?,
            Self::Evaluate(evaluate) => evaluate.order(lab)?,
        };
        order.arguments.extend(["--output".into(), order.output.clone().into()]);
        if lab.threads > 0 {
            order.arguments.extend(["--threads".into(), lab.threads.to_string().into()]);
        }
        Ok(order)
    }
}

/// The first of some folders.
fn first(folders: &Folders, kind: Kind) -> Result<&PathBuf> {
    let none = || Error::config(format!("a {kind}"), "the lab has no folder for it", "set STABLEWM_HOME");
    folders.paths().first().ok_or_else(none)
}

/// Checks a number that a page chose.
fn check_count(what: &str, count: usize, most: usize) -> Result<()> {
    if (1..=most).contains(&count) {
        return Ok(());
    }
    Err(Error::config(what, count.to_string(), format!("choose 1 to {most}")))
}

fn arguments<const N: usize>(texts: [&str; N]) -> Vec<OsString> {
    texts.into_iter().map(OsString::from).collect()
}

impl Train {
    fn order(&self, lab: &Lab) -> Result<Order> {
        check_name("the name of a run", &self.name)?;
        let families = lab.program.families();
        let family = families.iter().find(|family| family.id == self.family).ok_or_else(|| {
            let known = families.iter().map(|family| family.id.as_str());
            Error::unknown("model", &self.family, known, "reload the page, which lists the models")
        })?;
        if !family.presets.iter().any(|(id, _)| *id == self.preset) {
            let known = family.presets.iter().map(|(id, _)| id.as_str());
            return Err(Error::unknown("preset", &self.preset, known, "reload the page, which lists the presets"));
        }
        check_count("the steps of a training", self.steps, MOST_STEPS)?;
        let data = lab.datasets.find(self.folder, &self.dataset, 1, is_dataset)?;
        let mut arguments = arguments(["train", &self.family, "--preset", &self.preset, "--data"]);
        arguments.push(data.into());
        let (steps, seed, every) = (self.steps, self.seed, (self.steps / POINTS).max(1));
        let settings = [format!("schedule.steps={steps}"), format!("seed={seed}"), format!("log_every={every}")];
        arguments.extend(settings.map(OsString::from));
        let output = first(&lab.runs, Kind::Training)?.join(&self.name);
        Ok(Order { kind: Kind::Training, name: self.name.clone(), what: self.family.clone(), output, arguments })
    }
}

impl Collect {
    fn order(&self, lab: &Lab) -> Result<Order> {
        let choice = lab.envs.choose(&self.env)?;
        let known = || choice.entry.experts.iter().map(|expert| expert.id).chain(["random"]);
        if !known().any(|id| id == self.policy) {
            let fix = "reload the page, which lists the policies";
            return Err(Error::unknown("policy", &self.policy, known(), fix));
        }
        check_count("the episodes of a dataset", self.episodes, MOST_EPISODES)?;
        limits::IMAGE_SIDE.check(self.image)?;
        let factors = still::request(&self.pin, self.variation.as_deref())?;
        let env = choice.env()?;
        env.spec().variation_space.check(&factors)?;
        let mut arguments = arguments(["collect", &env.spec().id, "--policy", &self.policy]);
        for (option, count) in [("--episodes", self.episodes), ("--image", self.image), ("--seed", self.seed as usize)]
        {
            arguments.extend([option.into(), count.to_string().into()]);
        }
        arguments.extend(still::factor_options(env.spec(), &factors)?.split_whitespace().map(OsString::from));
        let output = new_dataset(first(&lab.datasets, Kind::Collection)?, &self.name)?;
        let (name, what) = (self.name.clone(), format!("{}, {}", env.spec().id, self.policy));
        Ok(Order { kind: Kind::Collection, name, what, output, arguments })
    }
}

impl Evaluate {
    fn order(&self, lab: &Lab) -> Result<Order> {
        check_name("the name of a folder of results", &self.name)?;
        let env = lab.envs.choose(&self.env)?.env()?;
        let models = lab.planning.models(env.spec());
        let model = models.iter().find(|model| model.name == self.planner.model).ok_or_else(|| {
            let names = models.iter().map(|model| model.name.as_str());
            Error::unknown("model", &self.planner.model, names, "reload the page, which lists the models")
        })?;
        self.planner.mpc(model, env.spec())?;
        check_count("the episodes of an evaluation", self.episodes, MOST_EPISODES)?;
        let mut arguments = arguments(["eval"]);
        arguments.extend(self.planner.arguments(env.spec()).into_iter().map(OsString::from));
        if let Some(Named { folder, name }) = &self.dataset {
            arguments.extend(["--dataset".into(), lab.datasets.find(*folder, name, 1, is_dataset)?.into()]);
        }
        for (option, count) in [("--episodes", self.episodes), ("--seed", self.seed as usize)] {
            arguments.extend([option.into(), count.to_string().into()]);
        }
        if let (true, None) = (self.planner.model == SIMULATOR, &self.dataset) {
            // Nothing reads frames.
            arguments.push("--no-pixels".into());
        }
        let output = first(&lab.results, Kind::Evaluation)?.join(RESULTS).join(&self.name);
        let (name, what) = (self.name.clone(), format!("{}, {}", env.spec().id, self.planner.model));
        Ok(Order { kind: Kind::Evaluation, name, what, output, arguments })
    }
}
