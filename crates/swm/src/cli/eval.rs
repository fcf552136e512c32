//! `swm eval` and `swm reproduce`: how often policies reach their goals, beside the random floor on the same starts.

use super::collect::folder;
use super::config::{VariationArgs, image_size};
use super::planner::PlannerArgs;
use super::wrappers::WrapperArgs;
use super::{Context, Progress, emit, emit_json, table};
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use swm::home;
use swm::resolver::{Home, parse_score};
use swm_core::results::{Counting, Proportion, Run};
use swm_core::run::{Control, Event};
use swm_core::{EnvChoice, Error, Result, Results};
use swm_data::{Part, Split};
use swm_eval::reproduce::{Reproduction, reproduce as run_again};
use swm_eval::{Condition, EvalRequest, HeldOut, Model, PolicyKind, PolicyRequest, RunOptions, StartsRequest};
use swm_models::Device;

/// Arguments of `swm eval`.
#[derive(Args)]
pub struct EvalArgs {
    /// Who acts: a checkpoint (path or name), expert, one of the environment's experts, simulator (which plans in the world
    /// itself), or random; several are compared on the same starts
    #[arg(required = true)]
    policies: Vec<String>,
    /// The environment (default: the one the first checkpoint was trained on)
    #[arg(long)]
    env: Option<String>,
    /// Take starts and goals from this dataset
    #[arg(long, value_name = "DATASET")]
    dataset: Option<String>,
    /// Steps from a start to its goal in the dataset
    #[arg(long, default_value_t = 25, requires = "dataset")]
    goal_offset: usize,
    /// Take starts from this part of the dataset only: train, validation or test, a tenth of the episodes each for the
    /// latter two
    #[arg(long, value_name = "PART", requires = "dataset")]
    split: Option<Part>,
    /// What divides the dataset
    #[arg(long, default_value_t = 0, requires = "split")]
    split_seed: u64,
    /// How many episodes
    #[arg(long, default_value_t = 50)]
    episodes: usize,
    /// What decides starts, goals, factors and plans
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Steps an episode may take (default: the environment's own, or 50 from a dataset)
    #[arg(long, value_name = "STEPS")]
    budget: Option<usize>,
    /// How episodes count: strict leaves out starts that are solved already, compat counts as the reference does
    #[arg(long, value_enum, default_value_t = Protocol::Strict)]
    protocol: Protocol,
    /// Steps in a row that must satisfy the goal (strict)
    #[arg(long, default_value_t = 1, value_name = "STEPS")]
    hold: usize,
    /// Environments played, and planned for, at the same time; results do not depend on it, except by the compat protocol
    #[arg(long, default_value_t = 16)]
    envs: usize,
    /// Picture size where no checkpoint decides it: 64 or HEIGHTxWIDTH
    #[arg(long, default_value = "64", value_parser = image_size)]
    image: (usize, usize),
    /// Draw nothing: where no policy looks at pictures, and on machines that cannot draw a world of three dimensions
    #[arg(long, conflicts_with_all = ["image", "videos"])]
    no_pixels: bool,
    /// Where to write results.json and the videos
    #[arg(short, long, default_value = "results", value_name = "DIR")]
    output: PathBuf,
    /// Episodes of each policy to film
    #[arg(long, default_value_t = 0, value_name = "EPISODES")]
    videos: usize,
    /// Compare the models' predictions with the recorded trajectories, so many model steps far, apart by success
    #[arg(long, value_name = "STEPS", requires = "dataset")]
    predict: Option<usize>,
    /// Keep how the search of every plan went, in traces.json beside the results
    #[arg(long)]
    trace: bool,
    #[command(flatten)]
    wrappers: WrapperArgs,
    #[command(flatten)]
    variation: VariationArgs,
    #[command(flatten)]
    planner: PlannerArgs,
}

/// How episodes count.
#[derive(Clone, Copy, ValueEnum)]
enum Protocol {
    Strict,
    Compat,
}

/// Steps of an episode from a dataset: the paper's evaluation budget.
const DATASET_BUDGET: usize = 50;

/// Evaluates policies and the random floor.
pub fn eval(args: &EvalArgs, context: &Context) -> anyhow::Result<()> {
    let request = args.request()?;
    let home = if args.trace { Home::tracing() } else { Home::default() };
    let (results, file) = run(&request, &home, args.envs, (&args.output, args.videos), context)?;
    if args.trace {
        write_json(&args.output.join("traces.json"), &traces(&home))?;
    }
    if context.json {
        return emit_json(&results);
    }
    emit(&summary(&results));
    emit(&format!("{}\n", file.display()));
    Ok(())
}

impl EvalArgs {
    /// Everything that decides the results.
    fn request(&self) -> Result<EvalRequest> {
        let found: Vec<Found> =
            self.policies.iter().map(|given| find(given, self.env.as_deref())).collect::<Result<_>>()?;
        let trained_on = found.iter().find_map(|found| found.env.clone());
        let Some(env) = self.env.clone().or(trained_on) else {
            return Err(Error::config("--env", "no environment is given", "name one (`swm envs` lists them)"));
        };
        let chosen = swm::env(&env)?;
        let mut policies = vec![];
        for found in found {
            policies.extend(self.acts(&chosen, found)?);
        }
        let image = policies.iter().find_map(|(_, image)| *image);
        if self.no_pixels && image.is_some() {
            let problem = "a checkpoint among the policies looks at pictures";
            return Err(Error::config("--no-pixels", problem, "leave it out"));
        }
        Ok(EvalRequest {
            version: EvalRequest::VERSION,
            env: chosen.id(),
            wrappers: self.wrappers.choices()?,
            wrap_goal: self.wrappers.wrap_goal,
            image: (!self.no_pixels).then(|| image.unwrap_or([self.image.0, self.image.1])),
            policies: policies.into_iter().map(|(policy, _)| policy).collect(),
            starts: match &self.dataset {
                None => StartsRequest::Episodic,
                Some(dataset) => StartsRequest::Dataset {
                    dataset: dataset.clone(),
                    goal_offset: self.goal_offset,
                    held_out: self
                        .split
                        .map(|part| HeldOut { part, split: Split { seed: self.split_seed, ..Split::default() } }),
                },
            },
            episodes: self.episodes,
            seed: self.seed,
            budget: self.budget.or(self.dataset.as_ref().map(|_| DATASET_BUDGET)),
            counting: match self.protocol {
                Protocol::Strict => Counting::Strict { hold: self.hold },
                Protocol::Compat => Counting::Compat { envs: self.envs },
            },
            conditions: vec![Condition { name: self.describe(), variation: self.variation.request()? }],
            prediction: self.predict,
        })
    }

    /// The condition in a few words.
    fn describe(&self) -> String {
        let wrapped = self.wrappers.wrappers.iter().cloned();
        let varied = Some(self.variation.describe()).filter(|words| words != "in distribution");
        let words: Vec<String> = varied.into_iter().chain(wrapped).collect();
        if words.is_empty() { "in distribution".to_owned() } else { words.join(", ") }
    }

    /// What a word of the command line stands for in an environment: one policy, or one for every solver.
    #[allow(clippy::type_complexity)]
    fn acts(&self, env: &EnvChoice, found: Found) -> Result<Vec<(PolicyRequest, Option<[usize; 2]>)>> {
        let Found { name, kind, image, .. } = found;
        let image = image.map(|side| [side, side]);
        let (model, block, history) = match kind {
            Kind::Acts(acts) => return Ok(vec![(PolicyRequest { name, kind: acts }, image)]),
            Kind::Plans { acts: Some(acts), .. } if self.planner.solvers.is_empty() => {
                return Ok(vec![(PolicyRequest { name, kind: acts }, image)]);
            }
            Kind::Plans { model: None, .. } => {
                parse_score(&self.planner.score)?;
                (Model::Simulator { score: self.planner.score.clone() }, self.planner.action_block, 1)
            }
            Kind::Plans { model: Some(given), block, history, .. } => (Model::Checkpoint(given), block, history),
        };
        let solvers = self.planner.solvers(env)?;
        // Several solvers are told apart by what was written, settings included.
        let words = &self.planner.solvers;
        let policies = solvers.into_iter().enumerate().map(|(i, solver)| {
            let name = if words.len() > 1 { format!("{name} ({})", words[i]) } else { name.clone() };
            let acts = self.planner.plan(model.clone(), solver, block, history)?;
            Ok((PolicyRequest { name, kind: acts }, image))
        });
        policies.collect()
    }
}

/// What a word of the command line stands for.
struct Found {
    name: String,
    kind: Kind,
    /// The environment it was trained on.
    env: Option<String>,
    /// The side of the pictures it sees.
    image: Option<usize>,
}

enum Kind {
    /// A policy that does not plan.
    Acts(PolicyKind),
    /// A model to plan in, the simulator for none; one that knows how to act does so unless a solver is named.
    Plans { model: Option<String>, block: usize, history: usize, acts: Option<PolicyKind> },
}

/// Finds out what a word stands for.
fn find(given: &str, env: Option<&str>) -> Result<Found> {
    let scripted = |acts| Found { name: given.to_owned(), kind: Kind::Acts(acts), env: None, image: None };
    let env = env.map(swm::env).transpose()?;
    if given == "random" {
        return Ok(scripted(PolicyKind::Random));
    }
    if given == "expert" || env.is_some_and(|env| env.entry.experts.iter().any(|expert| expert.id == given)) {
        return Ok(scripted(PolicyKind::Expert { id: given.to_owned() }));
    }
    if given == "simulator" {
        let kind = Kind::Plans { model: None, block: 1, history: 1, acts: None };
        return Ok(Found { name: given.to_owned(), kind, env: None, image: None });
    }
    let path = home::find_checkpoint(given)?;
    let name = Path::new(given).file_name().map_or(given.to_owned(), |name| name.to_string_lossy().into_owned());
    let found = swm_models::load(&path, &Device::flex())?;
    let info = found.info()?;
    let direct = PolicyKind::Direct { checkpoint: given.to_owned(), settings: Value::Null };
    let kind = match found.cost() {
        Some(_) => Kind::Plans {
            model: Some(given.to_owned()),
            block: info.action_block,
            history: info.history,
            acts: found.acts().then_some(direct),
        },
        None => Kind::Acts(direct),
    };
    Ok(Found { name, kind, env: info.dataset_info.env, image: info.image_size })
}

/// Evaluates with a progress bar and writes `results.json`; `films` is where to, and how many episodes of each run.
pub fn run(
    request: &EvalRequest,
    home: &Home,
    envs: usize,
    (output, films): (&Path, usize),
    context: &Context,
) -> Result<(Results, PathBuf)> {
    folder(output)?;
    let mut bar = Bar::new(request.episodes);
    let results = request.run(home, &run_options(envs, (output, films), context), &mut bar.control(context))?;
    let file = output.join("results.json");
    write_json(&file, &results)?;
    Ok((results, file))
}

fn run_options(envs: usize, (output, films): (&Path, usize), context: &Context) -> RunOptions {
    RunOptions { envs, threads: context.threads, videos: (films > 0).then(|| (output.to_owned(), films)) }
}

fn write_json(file: &Path, value: &impl serde::Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Error::external("writing JSON", e))?;
    std::fs::write(file, text + "\n").map_err(|e| Error::io(file, "writing results", e))
}

/// Every plan of an evaluation, one object each.
fn traces(home: &Home) -> Vec<Value> {
    let plans = home.take_traces().into_iter().map(|(policy, record)| {
        let mut plan = json!(record);
        plan["policy"] = json!(policy);
        plan
    });
    plans.collect()
}

/// One progress bar for every policy and condition.
struct Bar {
    episodes: usize,
    progress: Option<Progress>,
    doing: String,
}

impl Bar {
    fn new(episodes: usize) -> Self {
        Self { episodes, progress: None, doing: String::new() }
    }

    /// The control of a run that shows its progress and stops at Ctrl-C.
    fn control(&mut self, context: &Context) -> Control<'_> {
        Control::new().with_interrupt(context.stop.clone()).with_events(|event| self.show(event))
    }

    fn show(&mut self, event: Event<'_>) {
        match event {
            Event::Started(stage) => {
                self.progress = Some(Progress::new("evaluate", self.episodes));
                self.doing = stage.subject.join(", ");
            }
            Event::Progress(at) => {
                if let Some(progress) = &self.progress {
                    progress.at(at.done, self.doing.clone());
                }
            }
            Event::Finished { metrics, .. } => {
                let metric = |name| metrics.iter().find(|(known, _)| *known == name).map_or(0.0, |(_, value)| *value);
                let success = Proportion::wilson(metric("successes") as usize, metric("episodes") as usize);
                if let Some(progress) = self.progress.take() {
                    progress.done(&format!("{}: {}", self.doing, percent(&success)));
                }
            }
            _ => {}
        }
    }
}

/// Arguments of `swm reproduce`.
#[derive(Args)]
pub struct ReproduceArgs {
    /// A results.json, or the folder that holds one
    results: PathBuf,
    /// Environments played, and planned for, at the same time; results do not depend on it
    #[arg(long, default_value_t = 16)]
    envs: usize,
    /// Where to write the new results.json (default: nowhere)
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

/// Runs an evaluation again and says what differs.
pub fn reproduce(args: &ReproduceArgs, context: &Context) -> anyhow::Result<()> {
    let file = if args.results.is_dir() { args.results.join("results.json") } else { args.results.clone() };
    let old = swm_report::read_results(&file)?;
    let episodes = EvalRequest::of(&old.manifest)?.episodes;
    let mut bar = Bar::new(episodes);
    let options = run_options(args.envs, (Path::new("."), 0), context);
    let again: Reproduction = run_again(&old, &Home::default(), &options, &mut bar.control(context))?;
    if let Some(output) = &args.output {
        write_json(&folder(output)?.join("results.json"), &again.results)?;
    }
    if context.json {
        emit_json(&json!({"holds": again.holds(), "differences": again.differences, "results": again.results}))?;
    } else {
        emit(&summary(&again.results));
        for difference in &again.differences {
            emit(&format!("{difference}\n"));
        }
    }
    if again.holds() {
        if !context.json {
            emit(&format!(
                "{} episodes are as they were\n",
                again.results.runs.iter().map(|r| r.episodes.len()).sum::<usize>()
            ));
        }
        return Ok(());
    }
    anyhow::bail!("the results of {} are not reproduced: {} differences", file.display(), again.differences.len())
}

/// A table of runs, and how policies compare.
pub fn summary(results: &Results) -> String {
    let rows = results.runs.iter().map(|run: &Run| {
        let seconds = |s: f64| match s {
            s if s < 0.01 => format!("{:.2} ms", 1e3 * s),
            s if s < 1.0 => format!("{:.0} ms", 1e3 * s),
            s => format!("{s:.2} s"),
        };
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
    let mut text = table(
        &["condition", "policy", "success [95 %]", "n", "solved at start", "median steps", "plan, median (p95)"],
        rows,
    );
    let predicted = results.runs.iter().filter_map(|run| Some((run, run.prediction.as_ref()?)));
    let rows: Vec<Vec<String>> = predicted
        .flat_map(|(run, prediction)| {
            prediction.groups.iter().map(move |group| {
                let of = group.success.map_or("all", |success| if success { "successes" } else { "failures" });
                let last = group.steps.last().map_or(f64::NAN, |step| step.mean);
                vec![
                    run.condition.clone(),
                    run.policy.clone(),
                    of.to_owned(),
                    group.trajectory.n.to_string(),
                    format!("{:.3}", group.trajectory.mean),
                    format!("{last:.3}"),
                ]
            })
        })
        .collect();
    if !rows.is_empty() {
        text.push('\n');
        text.push_str(&table(
            &["condition", "model", "trajectories of", "n", "prediction error", "at the last step"],
            rows,
        ));
    }
    if !results.comparisons.is_empty() {
        let rows = results.comparisons.iter().map(|comparison| {
            let found = &comparison.table;
            vec![
                comparison.condition.clone(),
                format!("{} – {}", comparison.a, comparison.b),
                format!("{:+.0} % [{:+.0}, {:+.0}]", 100.0 * found.difference, 100.0 * found.low, 100.0 * found.high),
                format!("{} : {}", found.only_a, found.only_b),
                if found.p < 1e-4 { "< 0.0001".to_owned() } else { format!("{:.4}", found.p) },
            ]
        });
        text.push('\n');
        text.push_str(&table(&["condition", "compared", "difference [95 %]", "only one solved", "p (McNemar)"], rows));
    }
    text
}

/// A success rate with its interval.
pub fn percent(p: &Proportion) -> String {
    format!("{:.0} % [{:.0}, {:.0}]", 100.0 * p.rate, 100.0 * p.low, 100.0 * p.high)
}
