//! Studies of the kind `online`: returns and learning curves of models that train by interaction.

use super::chosen::{Chosen, add_config, check_cells, check_config};
use crate::cli::{Context, train_folder};
use crate::home;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use swm_core::results::{Counting, TableColumn};
use swm_core::run::{Control, Event};
use swm_core::{EnvChoice, EnvPool, Error, Origin, RandomPolicy, Result, VariationRequest};
use swm_eval::{EvalConfig, Measured, Starts, TableCell, World, WorldConfig};
use swm_models::{FAMILIES, OnlineRun, TrainOptions, device};

/// The number of evaluations of a run, at equal distances in optimizer steps.
const EVALUATIONS: usize = 5;
/// The metric of the training log.
const METRIC: &str = "evaluation/return";
/// The random policy's environments that run at the same time.
const ENVS: usize = 4;

/// The settings of the kind.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields, rename_all = "kebab-case", default)]
pub(super) struct OnlineSettings {
    /// The environments, with their tasks.
    envs: Vec<String>,
    /// The families of models.
    families: Vec<String>,
    /// The preset of every family.
    preset: String,
    /// More settings of the training configuration, by family.
    train: BTreeMap<String, Vec<String>>,
    /// Training seeds.
    seeds: Vec<u64>,
    /// Optimizer steps.
    steps: usize,
    /// Environment steps with random actions before the first optimizer step.
    warmup: usize,
    /// Episodes of an evaluation.
    episodes: usize,
    /// The time limit of an episode, in steps; 0 for the environment's.
    max_steps: usize,
}

impl Default for OnlineSettings {
    fn default() -> Self {
        Self {
            envs: vec![],
            families: vec!["tdmpc2".to_owned(), "sac".to_owned()],
            preset: "tiny".to_owned(),
            train: BTreeMap::new(),
            seeds: vec![0],
            steps: 6000,
            warmup: 800,
            episodes: 10,
            max_steps: 0,
        }
    }
}

/// The columns: the random policy's return, that of each evaluation, and the published one.
pub(super) fn columns() -> Vec<TableColumn> {
    let column = |name: String| TableColumn { name, unit: "return".to_owned(), published: false };
    let after = |i: usize| column(format!("after {} %", 100 * i / EVALUATIONS));
    let published = TableColumn { published: true, ..column("published".to_owned()) };
    let random = std::iter::once(column("random policy".to_owned()));
    random.chain((1..=EVALUATIONS).map(after)).chain([published]).collect()
}

impl OnlineSettings {
    /// Checks what can be checked before training.
    ///
    /// # Errors
    /// When a name does not exist, a file names what only the user may name, or a number is out of range.
    pub(super) fn check(&self, chosen: &Chosen<'_>) -> Result<()> {
        check_cells(&[self.envs.len(), self.families.len(), self.seeds.len()])?;
        for env in &self.envs {
            crate::env(env, chosen.by("envs"))?;
        }
        chosen.check_preset(&self.preset)?;
        if let Some(family) = self.train.keys().find(|family| !self.families.contains(family)) {
            let families = self.families.iter().map(String::as_str);
            let hint = format!("the setting `train` is for the families of the study: {}", self.families.join(", "));
            return Err(Error::unknown("family", family, families, hint));
        }
        for family in &self.families {
            let config = (FAMILIES.get(family)?.config)(&self.preset, &self.overrides(family, 0))?;
            drop(config);
        }
        if self.steps == 0 || !self.steps.is_multiple_of(EVALUATIONS) || self.episodes == 0 {
            let problem = format!("{} steps and {} episodes", self.steps, self.episodes);
            let fix = format!("give steps that are a multiple of {EVALUATIONS}, and at least 1 episode");
            return Err(Error::config("settings of the study", problem, fix));
        }
        Ok(())
    }

    /// A row for each environment, family and training seed. `published` returns the values of a row without its seed.
    ///
    /// # Errors
    /// When the preset is a file and cannot be read.
    pub(super) fn cells(&self, published: impl Fn(&str) -> Vec<Option<f64>>) -> Result<Vec<TableCell>> {
        let mut cells = vec![];
        for env in &self.envs {
            for family in &self.families {
                let run = format!("{}, {family}", short(env));
                for seed in &self.seeds {
                    let seeded = if self.seeds.len() > 1 { format!(", seed {seed}") } else { String::new() };
                    let settings = self.overrides(family, *seed);
                    let mut request = json!({
                        "kind": "online",
                        "env": env,
                        "family": family,
                        "preset": self.preset,
                        "seed": seed,
                        "settings": settings,
                        "episodes": self.episodes,
                        "max-steps": self.max_steps,
                        "version": env!("CARGO_PKG_VERSION"),
                    });
                    add_config(&mut request, family, &self.preset, &settings)?;
                    cells.push(TableCell { name: format!("{run}{seeded}"), request, published: published(&run) });
                }
            }
        }
        Ok(cells)
    }

    /// The settings of the training configuration.
    fn overrides(&self, family: &str, seed: u64) -> Vec<String> {
        let every = self.steps / EVALUATIONS;
        let own = [
            format!("seed={seed}"),
            format!("schedule.steps={}", self.steps),
            format!("log_every={every}"),
            format!("save_every={every}"),
            format!("online.warmup={}", self.warmup),
            format!("online.evaluate_every={every}"),
            format!("online.evaluate_episodes={}", self.episodes),
        ];
        self.train.get(family).into_iter().flatten().cloned().chain(own).collect()
    }
}

/// The name of an environment and its task: `Walker, run` of `swm/WalkerDMControl-v0,task=run`.
fn short(env: &str) -> String {
    let (id, options) = env.split_once(',').unwrap_or((env, ""));
    let name = id.rsplit('/').next().unwrap_or(id);
    let name = name.split("DMControl").next().unwrap_or(name);
    let task = options.split(',').find_map(|option| option.strip_prefix("task="));
    task.map_or_else(|| name.to_owned(), |task| format!("{name} {task}"))
}

/// Trains the model of a row, or continues an interrupted training, and returns its values. `None` where the environment
/// cannot be made, such as without MuJoCo.
///
/// # Errors
/// When training fails or is interrupted.
pub(super) fn measure(cell: &TableCell, context: &Context, control: &mut Control<'_>) -> Result<Option<Measured>> {
    let request = &cell.request;
    let text = |key: &str| request[key].as_str().unwrap_or_default();
    let number = |key: &str| request[key].as_u64().unwrap_or_default() as usize;
    // The study has checked who chose the id.
    let choice = crate::env(text("env"), &Origin::User)?;
    if let Err(error) = choice.env() {
        control.emit(Event::Log(&format!("{} is left out: {error}", cell.name)));
        return Ok(None);
    }
    let limit = Some(number("max-steps")).filter(|steps| *steps > 0);
    let settings: Vec<String> =
        request["settings"].as_array().into_iter().flatten().filter_map(|set| Some(set.as_str()?.to_owned())).collect();
    let config = (FAMILIES.get(text("family"))?.config)(text("preset"), &settings)?;
    check_config(request, text("preset"), &*config)?;
    let threads = swm_core::pool::threads(context.threads)?;
    let environments = |count: usize| {
        let envs = (0..count).map(|_| choice.env()).collect::<Result<Vec<_>>>()?;
        EnvPool::new(envs, config.image_size().map(|side| (side, side)), limit, Arc::clone(&threads))
    };
    let words = cell.name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    let name = words.collect::<Vec<_>>().join("-");
    let out = home::new_checkpoint(&format!("online-{}-{}", name.to_lowercase(), cell.id()?))?;
    train_folder::check_links(&out)?;
    let options = TrainOptions {
        resume: true,
        device: device::parse("cpu")?,
        threads: context.threads,
        cache: home::weights()?,
        ..TrainOptions::default()
    };
    let Some(summary) = config.train_online(OnlineRun { environments: &environments, out: &out, options }, control)
    else {
        let problem = format!("{} trains on datasets only", text("family"));
        return Err(Error::config("families", problem, "give tdmpc2 or sac"));
    };
    if summary?.interrupted {
        return Err(Error::Interrupted);
    }
    let mut values = vec![random(&choice, number("episodes"), limit, context, control)?];
    values.extend(returns(&out, request)?);
    Ok(Some(values.into()))
}

/// The mean return of the random policy.
fn random(
    choice: &EnvChoice,
    episodes: usize,
    limit: Option<usize>,
    context: &Context,
    control: &mut Control<'_>,
) -> Result<f64> {
    let envs = ENVS.min(episodes);
    let config = WorldConfig { envs, image: None, views: vec![], max_episode_steps: limit, threads: context.threads };
    let mut world = World::of(|| choice.env(), config)?;
    let mut policy = RandomPolicy::new(world.spec(), envs);
    let starts = Starts::sequential(episodes, 0, VariationRequest::default())?;
    // Episodes are played to their end, also after a success.
    let config = EvalConfig { counting: Counting::Compat { envs }, ..EvalConfig::default() };
    let run = world.evaluate(&mut policy, &starts, &config, control)?;
    let sum: f64 = run.episodes.iter().map(|episode| episode.total_reward).sum();
    Ok(sum / run.episodes.len().max(1) as f64)
}

/// The returns of the evaluations in the training log of a run.
fn returns(out: &Path, request: &Value) -> Result<Vec<f64>> {
    let log = out.join("train.jsonl");
    let metrics = swm_report::read_metrics(&log)?;
    let found = metrics.series.iter().find(|series| series.name == METRIC);
    let mut settings = request["settings"].as_array().into_iter().flatten().filter_map(Value::as_str);
    let every =
        settings.find_map(|set| set.strip_prefix("online.evaluate_every=")?.parse::<usize>().ok()).unwrap_or_default();
    // After a kill, a run repeats the steps since its last save, with equal results.
    let at = |step: usize| found?.points.iter().rev().find(|(x, _)| *x == step as f64).map(|(_, value)| *value);
    let values: Option<Vec<f64>> = (1..=EVALUATIONS).map(|i| at(i * every)).collect();
    values.ok_or_else(|| {
        Error::corrupt(&log, "lacks an evaluation", "remove the folder of the checkpoint, and run the study again")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_domains_and_tasks() {
        assert_eq!(short("swm/WalkerDMControl-v0,task=run"), "Walker run");
        assert_eq!(short("swm/PendulumControl-v1"), "PendulumControl-v1");
        assert_eq!(
            columns().iter().map(|column| column.name.as_str()).collect::<Vec<_>>()[..2],
            ["random policy", "after 20 %"]
        );
    }

    #[test]
    fn settings_that_no_run_can_have_are_errors() {
        let settings = OnlineSettings { envs: vec!["swm/PendulumControl-v1".to_owned()], ..OnlineSettings::default() };
        settings.check(&Chosen::by_user()).expect("settings");
        let cells = settings.cells(|run| vec![(run == "PendulumControl-v1, sac").then_some(-150.0)]).expect("cells");
        assert_eq!(cells.iter().map(|cell| cell.published[0]).collect::<Vec<_>>(), [None, Some(-150.0)]);
        let train = |family: &str| [(family.to_owned(), vec!["model.hidden=8".to_owned()])].into();
        let own = OnlineSettings { train: train("sac"), ..settings.clone() };
        own.check(&Chosen::by_user()).expect("settings of a family");
        assert_eq!(own.cells(|_| vec![None]).expect("cells")[1].request["settings"][0], "model.hidden=8");
        for (wrong, part) in [
            (OnlineSettings { steps: 7, ..settings.clone() }, "multiple of 5"),
            (OnlineSettings { train: train("lewm"), ..settings.clone() }, "unknown family 'lewm'"),
            (OnlineSettings { families: vec!["sax".to_owned()], ..settings.clone() }, "sac"),
            (
                OnlineSettings { envs: vec!["swm/PendulumControl-v2".to_owned()], ..settings.clone() },
                "PendulumControl-v1",
            ),
        ] {
            let error = wrong.check(&Chosen::by_user()).expect_err(part).to_string();
            assert!(error.contains(part), "{error}");
        }
    }
}
