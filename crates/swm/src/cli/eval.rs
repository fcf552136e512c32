//! `swm eval`: how often a policy reaches its goals, beside the random floor on the same starts.

use super::collect::{folder, policy};
use super::config::{VariationArgs, image_size};
use super::{Context, Progress, checkpoints, datasets, emit, emit_json, table};
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm::ENVS;
use swm_core::results::{Proportion, Run};
use swm_core::{EnvEntry, Error, Policy, Result, Results, VariationRequest};
use swm_eval::{Control, EvalConfig, Starts, Videos, World, WorldConfig};
use swm_models::Checkpoint;
use swm_models::lewm::LewmCost;
use swm_plan::{Cem, MpcConfig, MpcPolicy};

/// Arguments of `swm eval`.
#[derive(Args)]
pub struct EvalArgs {
    /// Who acts: a checkpoint (path or name), expert, one of the environment's experts, or random
    policy: String,
    /// The environment (default: the one the checkpoint was trained on)
    #[arg(long)]
    env: Option<String>,
    /// Take starts and goals from this dataset
    #[arg(long, value_name = "DATASET")]
    dataset: Option<String>,
    /// Steps from a start to its goal in the dataset
    #[arg(long, default_value_t = 25, requires = "dataset")]
    goal_offset: usize,
    /// How many episodes
    #[arg(long, default_value_t = 50)]
    episodes: usize,
    /// What decides starts, goals, factors and plans
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Steps an episode may take (default: the environment's own, or 50 from a dataset)
    #[arg(long, value_name = "STEPS")]
    budget: Option<usize>,
    /// Environments played, and planned for, at the same time; results do not depend on it
    #[arg(long, default_value_t = 16)]
    envs: usize,
    /// Picture size where no checkpoint decides it: 64 or HEIGHTxWIDTH
    #[arg(long, default_value = "64", value_parser = image_size)]
    image: (usize, usize),
    /// Where to write results.json and the videos
    #[arg(short, long, default_value = "results", value_name = "DIR")]
    output: PathBuf,
    /// Episodes of each policy to film
    #[arg(long, default_value_t = 0, value_name = "EPISODES")]
    videos: usize,
    #[command(flatten)]
    variation: VariationArgs,
    #[command(flatten)]
    planner: PlannerArgs,
}

/// How a world model plans; the defaults are those of the paper's experiments.
#[derive(Args, Clone)]
pub struct PlannerArgs {
    /// Model steps to plan
    #[arg(long, default_value_t = 5, help_heading = "Planning")]
    pub horizon: usize,
    /// Model steps to execute before planning again
    #[arg(long, default_value_t = 5, help_heading = "Planning")]
    pub receding_horizon: usize,
    /// Candidates of an iteration of CEM
    #[arg(long, default_value_t = 300, help_heading = "Planning")]
    pub samples: usize,
    /// Iterations of CEM
    #[arg(long, default_value_t = 30, help_heading = "Planning")]
    pub iterations: usize,
    /// Candidates that refit the distribution
    #[arg(long, default_value_t = 30, help_heading = "Planning")]
    pub elites: usize,
    /// The first standard deviation, in model action units
    #[arg(long, default_value_t = 1.0, help_heading = "Planning")]
    pub sigma: f32,
}

/// An evaluation, as `swm eval` and `swm demo` ask for it.
pub struct Evaluation<'a> {
    /// The environment.
    pub entry: &'static EnvEntry,
    /// What the policy is called in the results.
    pub name: &'a str,
    /// The checkpoint that acts; without one `name` is a policy of the environment.
    pub checkpoint: Option<&'a Checkpoint>,
    /// How it plans.
    pub planner: &'a PlannerArgs,
    /// Environments, pictures, steps, threads.
    pub world: WorldConfig,
    /// Episodes, or picks of a dataset.
    pub starts: StartsFrom<'a>,
    /// How many episodes.
    pub episodes: usize,
    /// The seed.
    pub seed: u64,
    /// Conditions to evaluate under: names and what is sampled or pinned.
    pub conditions: Vec<(String, VariationRequest)>,
    /// Episodes of each policy to film.
    pub videos: usize,
    /// Where results go.
    pub output: &'a Path,
    /// The command that gives the same results.
    pub command: String,
}

/// Where starts and goals come from.
#[derive(Clone, Copy)]
pub enum StartsFrom<'a> {
    /// The environment.
    Env,
    /// A dataset, with this many steps from start to goal.
    Dataset(&'a dyn swm_data::Reader, usize),
}

/// Evaluates a policy and the random floor.
pub fn eval(args: &EvalArgs, context: &Context) -> anyhow::Result<()> {
    /// Steps of an episode from a dataset: the paper's evaluation budget.
    const DATASET_BUDGET: usize = 50;
    let named = |env: &Option<String>| match env {
        Some(id) => ENVS.get(id),
        None => Err(Error::config("--env", "no environment is given", "name one (`swm envs` lists them)")),
    };
    let is_scripted = |entry: &EnvEntry| {
        matches!(args.policy.as_str(), "random" | "expert") || entry.experts.iter().any(|e| e.id == args.policy)
    };
    let asked = args.env.as_ref().map(|id| ENVS.get(id)).transpose()?;
    let scripted = matches!(args.policy.as_str(), "random" | "expert") || asked.is_some_and(is_scripted);
    let (entry, checkpoint) = if scripted {
        (named(&args.env)?, None)
    } else {
        let (_, checkpoint) = checkpoints::load(&args.policy)?;
        let entry = named(&args.env.clone().or_else(|| checkpoint.env.clone()))?;
        fits(&checkpoint, &args.policy, entry)?;
        (entry, Some(checkpoint))
    };
    let image = checkpoint.as_ref().map_or(args.image, |c| (c.config.model.image, c.config.model.image));
    let dataset = args.dataset.as_deref().map(datasets::open).transpose()?;
    let name = Path::new(&args.policy).file_name().map_or(args.policy.clone(), |n| n.to_string_lossy().into_owned());
    let (results, file) = run(
        &Evaluation {
            entry,
            name: &name,
            checkpoint: checkpoint.as_ref(),
            planner: &args.planner,
            world: WorldConfig {
                envs: args.envs.min(args.episodes.max(1)),
                image: Some(image),
                max_episode_steps: args.budget.or(dataset.as_ref().map(|_| DATASET_BUDGET)),
                threads: context.threads,
            },
            starts: dataset.as_deref().map_or(StartsFrom::Env, |reader| StartsFrom::Dataset(reader, args.goal_offset)),
            episodes: args.episodes,
            seed: args.seed,
            conditions: vec![(args.variation.describe(), args.variation.request()?)],
            videos: args.videos,
            output: &args.output,
            command: args.command(entry, &name),
        },
        context,
    )?;
    if context.json {
        return emit_json(&results);
    }
    emit(&summary(&results));
    emit(&format!("{}\n", file.display()));
    Ok(())
}

impl EvalArgs {
    /// The command that gives the same results: what decides them, and nothing else.
    fn command(&self, entry: &EnvEntry, name: &str) -> String {
        let PlannerArgs { horizon, receding_horizon, samples, iterations, elites, sigma } = &self.planner;
        let mut words = vec![format!(
            "swm eval {name} --env {} --episodes {} --seed {} --horizon {horizon} --receding-horizon {receding_horizon} --samples {samples} --iterations {iterations} --elites {elites} --sigma {sigma}",
            entry.id, self.episodes, self.seed
        )];
        words.extend(self.dataset.iter().map(|data| format!("--dataset {data} --goal-offset {}", self.goal_offset)));
        words.extend(self.budget.iter().map(|steps| format!("--budget {steps}")));
        words.extend(self.variation.variation.iter().map(|keys| format!("--variation {}", keys.join(","))));
        words.extend(self.variation.pin.iter().map(|pin| format!("--pin {pin}")));
        words.join(" ")
    }
}

/// Refuses a checkpoint trained on another environment.
fn fits(checkpoint: &Checkpoint, name: &str, entry: &EnvEntry) -> Result<()> {
    match &checkpoint.env {
        Some(env) if env != entry.id => Err(Error::config(
            format!("checkpoint {name}"),
            format!("it was trained on {env}, not on {}", entry.id),
            format!("evaluate it with --env {env}, or train one on {}", entry.id),
        )),
        _ => Ok(()),
    }
}

/// Evaluates under every condition, the random floor first, and writes `results.json`.
pub fn run(evaluation: &Evaluation<'_>, context: &Context) -> Result<(Results, PathBuf)> {
    let Evaluation { entry, name, checkpoint, planner, episodes, seed, output, .. } = evaluation;
    folder(output)?;
    let mut world = World::new(entry, evaluation.world)?;
    let policies: Vec<&str> = if *name == "random" { vec!["random"] } else { vec!["random", name] };
    let mut manifest = None;
    let mut runs = vec![];
    for (condition, variation) in &evaluation.conditions {
        let starts = match evaluation.starts {
            StartsFrom::Env => Starts::episodic(*episodes, *seed, variation.clone())?,
            StartsFrom::Dataset(reader, goal_offset) => {
                let picks = Starts::choose(reader, *episodes, goal_offset, *seed)?;
                Starts::from_dataset(reader, world.spec(), picks, goal_offset, *seed, variation.clone())?
            }
        };
        manifest.get_or_insert_with(|| world.eval_manifest(&starts, None));
        for &who in &policies {
            let mut acting: Box<dyn Policy> = match checkpoint {
                Some(checkpoint) if who != "random" => planning(checkpoint, planner, &world)?,
                _ => policy(entry, who, &world)?,
            };
            let progress = Progress::new("evaluate", *episodes);
            let mut control = Control {
                stop: Some(context.stop.clone()),
                progress: Some(Box::new(|at| progress.at(at.episodes, format!("{who}, {condition}")))),
            };
            let config = EvalConfig {
                policy: who.to_owned(),
                condition: condition.clone(),
                budget: None,
                videos: (evaluation.videos > 0).then(|| Videos {
                    root: output.to_path_buf(),
                    prefix: format!("videos/{}-{}", slug(who), slug(condition)),
                    count: evaluation.videos,
                    fps: 15,
                }),
            };
            let run = world.evaluate(&mut *acting, &starts, &config, &mut control)?;
            drop(control);
            progress.done(&format!("{who}, {condition}: {}", percent(&run.success)));
            runs.push(run);
        }
    }
    let mut manifest = manifest.unwrap_or_default();
    manifest.config["policy"] = json!(name);
    manifest.config["command"] = json!(evaluation.command);
    manifest.config["conditions"] = json!(evaluation.conditions);
    if let Some(checkpoint) = checkpoint {
        manifest.hashes.insert("weights".to_owned(), checkpoint.hash().to_owned());
        manifest.config["planner"] = json!({"mpc": mpc(checkpoint, planner), "cem": cem(planner)});
        manifest.libraries = checkpoint.manifest.libraries.clone();
        manifest.device = checkpoint.manifest.device.clone();
    }
    let results =
        Results { manifest, env: entry.id.to_owned(), protocol: protocol(evaluation.starts).to_owned(), runs };
    let file = output.join("results.json");
    let text = serde_json::to_string_pretty(&results).map_err(|e| Error::external("writing results", e))?;
    std::fs::write(&file, text + "\n").map_err(|e| Error::io(&file, "writing results", e))?;
    Ok((results, file))
}

fn protocol(starts: StartsFrom<'_>) -> &'static str {
    match starts {
        StartsFrom::Env => "episodic",
        StartsFrom::Dataset(..) => "dataset",
    }
}

/// A checkpoint that plans.
fn planning(checkpoint: &Checkpoint, planner: &PlannerArgs, world: &World) -> Result<Box<dyn Policy>> {
    let policy = MpcPolicy::new(
        Box::new(cem(planner)),
        Box::new(LewmCost::new(checkpoint)),
        mpc(checkpoint, planner),
        checkpoint.action.clone(),
        world.spec(),
        world.pool().len(),
    )?;
    Ok(Box::new(policy))
}

fn cem(planner: &PlannerArgs) -> Cem {
    Cem {
        samples: planner.samples,
        iterations: planner.iterations,
        elites: planner.elites.min(planner.samples),
        sigma: planner.sigma,
    }
}

fn mpc(checkpoint: &Checkpoint, planner: &PlannerArgs) -> MpcConfig {
    MpcConfig {
        horizon: planner.horizon,
        receding_horizon: planner.receding_horizon.min(planner.horizon),
        action_block: checkpoint.config.data.frameskip,
        warm_start: true,
        history: checkpoint.config.model.predictor.history,
        ..MpcConfig::default()
    }
}

/// A table of runs.
pub fn summary(results: &Results) -> String {
    let rows = results.runs.iter().map(|run: &Run| {
        let seconds = |s: f64| if s < 1.0 { format!("{:.0} ms", 1e3 * s) } else { format!("{s:.2} s") };
        vec![
            run.condition.clone(),
            run.policy.clone(),
            percent(&run.success),
            run.success.n.to_string(),
            run.solved_at_start.to_string(),
            run.time_to_goal.map_or("–".to_owned(), |t| format!("{:.0}", t.median)),
            run.timing.plan_seconds.map_or("–".to_owned(), |t| format!("{} ({})", seconds(t.median), seconds(t.p95))),
        ]
    });
    table(
        &["condition", "policy", "success [95 %]", "n", "solved at start", "median steps", "plan, median (p95)"],
        rows,
    )
}

/// A success rate with its interval.
pub fn percent(p: &Proportion) -> String {
    format!("{:.0} % [{:.0}, {:.0}]", 100.0 * p.rate, 100.0 * p.low, 100.0 * p.high)
}

/// A name as part of a file name.
fn slug(name: &str) -> String {
    let words: Vec<&str> = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty()).collect();
    words.join("-").to_lowercase()
}
