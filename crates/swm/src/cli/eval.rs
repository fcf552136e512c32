//! `swm eval`: evaluates policies and the random-policy floor from the same starts.

use super::config::{VariationArgs, count, image_size};
use super::devices::DeviceArgs;
use super::eval_policy::NamedPolicy;
use super::planner::PlannerArgs;
use super::progress::control;
use super::results_tables::summary;
use super::run_record;
use super::wrappers::WrapperArgs;
use super::{Context, emit, emit_json, eprint};
use super::{eval_until, output_folder};
use crate::recorded_env::warning_of_starts;
use crate::resolver::HomeResolver;
use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use swm_core::limits::{ENVS, EVALUATED_EPISODES, STEPS};
use swm_core::results::{Counting, Run, Until};
use swm_core::{EnvChoice, Error, Key, Origin, Result, Results, files};
use swm_data::{Part, Split};
use swm_eval::{Condition, EvalRequest, HeldOut, Model, PolicyKind, PolicyRequest, RunOptions, StartsRequest, publish};

/// Arguments of `swm eval`.
#[derive(Args)]
pub struct EvalArgs {
    /// Policies: checkpoints, expert, its id, simulator, random, or a baseline
    ///
    /// Several policies are compared from the same starts. `simulator` plans by stepping the environment itself. The
    /// baselines are `no-op`, which does nothing, and two that read the dataset that the starts come from: `replay` repeats
    /// the actions that follow a start, `nearest` those that follow the rows of other episodes nearest to the present and
    /// the goal.
    #[arg(required = true)]
    policies: Vec<String>,
    /// The environment (default: the training environment of the first checkpoint)
    #[arg(long)]
    env: Option<String>,
    /// Allow checkpoints to choose an environment that imports a Python module
    ///
    /// docs/security.md says what files may do without it.
    #[arg(long)]
    trust: bool,
    /// Dataset to take starts and goals from
    #[arg(long, value_name = "DATASET")]
    dataset: Option<String>,
    /// Steps from a start to its goal in the dataset
    #[arg(long, default_value_t = 25, requires = "dataset", value_parser = count::<1, { STEPS.max }>)]
    goal_offset: usize,
    /// Part of the dataset to take starts from: train, validation or test
    ///
    /// The validation and test parts have a tenth of the episodes each.
    #[arg(long, value_name = "PART", requires = "dataset")]
    split: Option<Part>,
    /// Seed of the split of the dataset
    #[arg(long, default_value_t = 0, requires = "split")]
    split_seed: u64,
    /// Number of episodes (default: 50; with --until the most, 2000)
    #[arg(long, value_parser = count::<1, { EVALUATED_EPISODES.max }>)]
    episodes: Option<usize>,
    /// Play starts until a rule is met: ci=5, decided or decided=10
    ///
    /// ci=5 ends when the 95 % intervals of the success rates of all policies are at most 5 percentage points wide on each side.
    /// decided=10 ends when every comparison and every gap is told apart from zero or shown to be below 10 points. All
    /// intervals are confidence sequences then. results.json is written after every stage.
    #[arg(long, value_name = "RULE", conflicts_with = "trace")]
    pub(super) until: Option<Until>,
    /// Continue an interrupted evaluation with --until
    #[arg(long, requires = "until")]
    pub(super) resume: bool,
    /// Seed of starts, goals, factors and plans (default: 0, or the capsule's)
    #[arg(long)]
    seed: Option<u64>,
    /// Repeat all draws of policies with another stream, from the same starts
    #[arg(long, value_name = "SEED")]
    planning_seed: Option<u64>,
    /// Time limit, in steps (default: the environment's; 50 with --dataset)
    ///
    /// The default of a capsule with an evaluation is the time limit of that evaluation.
    #[arg(long, value_name = "STEPS")]
    budget: Option<usize>,
    /// Rule for counting episodes: strict, or compat with the reference
    ///
    /// strict leaves out episodes that are solved at the start.
    #[arg(long, value_enum, default_value_t = Protocol::Strict)]
    protocol: Protocol,
    /// Consecutive steps that must satisfy the success criterion (strict)
    #[arg(long, default_value_t = 1, value_name = "STEPS")]
    hold: usize,
    /// Parallel environments
    ///
    /// Results do not depend on their number, except with the compat protocol.
    #[arg(long, default_value_t = 16, value_parser = count::<1, { ENVS.max }>)]
    pub(super) envs: usize,
    /// Frame size if no checkpoint determines it: 64 or HEIGHTxWIDTH
    #[arg(long, default_value = "64", value_parser = image_size)]
    image: (usize, usize),
    /// Render no frames, for policies that require none
    #[arg(long, conflicts_with_all = ["image", "videos"])]
    no_pixels: bool,
    /// Folder of results.json and the videos
    #[arg(short, long, default_value = "results", value_name = "DIR")]
    pub(super) output: PathBuf,
    /// Number of videos per policy (default: 3; 0 without frames)
    #[arg(long, value_name = "EPISODES")]
    pub(super) videos: Option<usize>,
    /// Measure prediction errors over this many model steps, by success
    ///
    /// Predictions are compared with the recorded trajectories of the dataset.
    #[arg(long, value_name = "STEPS", requires = "dataset")]
    predict: Option<usize>,
    /// Write the search of every plan to traces.json
    #[arg(long)]
    pub(super) trace: bool,
    #[command(flatten)]
    wrappers: WrapperArgs,
    #[command(flatten)]
    variation: VariationArgs,
    /// Also evaluate under a shift, as a condition of its own
    ///
    /// KEY=VALUE sets a factor, KEY samples it. Give it repeatedly for several conditions. --pin and --variation change all conditions.
    #[arg(long, value_name = "KEY[=VALUE]")]
    shift: Vec<String>,
    /// Also evaluate with each factor sampled alone, as conditions of their own
    ///
    /// Factors that the environment samples anyway are left out.
    #[arg(long)]
    each_factor: bool,
    #[command(flatten)]
    planner: PlannerArgs,
    #[command(flatten)]
    pub(super) device: DeviceArgs,
}

/// The rule for counting episodes.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Protocol {
    /// Starts that are solved already do not count
    Strict,
    /// Episodes count as in the reference implementation
    Compat,
}

/// Whether the seed and the time limit, if they are not given, are those of the evaluation in the first capsule.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum CapsuleStarts {
    /// They are, unless its starts, or those of the command, come from a dataset.
    Use,
    /// They are not: all policies of a study have the same starts.
    Ignore,
}

/// The time limit of episodes that start from a dataset, in steps, as in the paper's evaluations.
const DATASET_TIME_LIMIT: usize = 50;

/// The number of episodes, unless the command line says otherwise.
const EPISODES: usize = 50;

/// The largest number of episodes with `--until`, unless the command line says otherwise. `ci=5` takes at most 1400.
const MOST_EPISODES: usize = 2000;

/// The number of recorded episodes of each run, unless the command line says otherwise.
pub const VIDEOS: usize = 3;

/// The file of the searches of all plans.
pub(super) const TRACES: &str = "traces.json";

/// Runs `swm eval`.
pub fn eval(args: &EvalArgs, context: &Context) -> anyhow::Result<()> {
    let (results, file) = run_args(args, context)?;
    if context.json {
        return emit_json(&results);
    }
    emit(&summary(&results));
    emit(&format!("{}\n", file.display()));
    Ok(())
}

/// Runs the evaluation of a command line and writes its results.
pub fn run_args(args: &EvalArgs, context: &Context) -> anyhow::Result<(Results, PathBuf)> {
    // The request checks the one name that a checkpoint chooses: its environment.
    let resolver = HomeResolver::new(Origin::User).on(args.device.open()?);
    let resolver = if args.trace { resolver.tracing() } else { resolver };
    let request = args.request(&resolver, CapsuleStarts::Use)?;
    args.check_effects(&request)?;
    if let StartsRequest::Dataset { dataset, .. } = &request.starts
        && let Some(warning) = warning_of_starts(dataset, &request.env)
    {
        eprint(&format!("warning: {warning}\n"));
    }
    // Before the work, which replaces older traces with those of these plans.
    if args.trace && args.output.exists() {
        drop(output_folder::claim(&args.output, &[TRACES])?);
    }
    let output = (args.output.as_path(), args.video_count());
    if let Some(until) = args.until {
        return Ok(eval_until::run(&request, (until, args.resume), &resolver, args.envs, output, context)?);
    }
    let (results, file) = run(&request, &resolver, args.envs, output, context)?;
    if args.trace {
        write_traces(&args.output, &resolver, &results)?;
    }
    Ok((results, file))
}

/// Writes the plans that a resolver has traced in an evaluation with these results.
pub(super) fn write_traces(output: &Path, resolver: &HomeResolver, results: &Results) -> Result<()> {
    write_json(&output.join(TRACES), &traces(resolver, results))
}

impl EvalArgs {
    /// The number of recorded episodes of each run.
    pub(super) fn video_count(&self) -> usize {
        self.videos.unwrap_or(if self.no_pixels { 0 } else { VIDEOS })
    }

    /// Returns the settings that determine the results.
    ///
    /// # Errors
    /// When a policy, an environment or a setting does not exist.
    pub fn request(&self, resolver: &HomeResolver, starts: CapsuleStarts) -> Result<EvalRequest> {
        let find = |given: &String| NamedPolicy::find(given, self.env.as_deref(), resolver);
        let named: Vec<NamedPolicy> = self.policies.iter().map(find).collect::<Result<_>>()?;
        let trained_on = named.iter().find_map(|policy| policy.env.clone());
        let env = match (&self.env, trained_on) {
            (Some(env), _) => resolver.choose_env(env)?,
            (None, Some((env, path))) => crate::env(&env, &Origin::file(path, self.trust))?,
            (None, None) => {
                return Err(Error::config("--env", "no environment is given", "name one (`swm envs` lists them)"));
            }
        };
        let image = named.iter().find_map(|policy| policy.image);
        let recorded = named.iter().find_map(|policy| policy.recorded.as_ref()).map(|recorded| &recorded.request);
        let is_used = starts == CapsuleStarts::Use && self.dataset.is_none();
        let recorded = recorded.filter(|request| is_used && request.starts == StartsRequest::Episodic);
        let seed = self.seed.or(recorded.map(|request| request.seed)).unwrap_or_default();
        let budget = self.budget.or(recorded.and_then(|request| request.budget));
        let mut policies = vec![];
        for policy in named {
            policies.extend(policy.requests(&env, &self.planner)?);
        }
        if self.no_pixels && image.is_some() {
            let problem = "a checkpoint among the policies requires frames";
            return Err(Error::config("--no-pixels", problem, "remove the flag"));
        }
        let image = image.map_or([self.image.0, self.image.1], |side| [side, side]);
        Ok(EvalRequest {
            version: EvalRequest::VERSION,
            env: env.id(),
            wrappers: self.wrappers.choices(resolver.origin())?,
            wrap_goal: self.wrappers.wrap_goal,
            image: (!self.no_pixels).then_some(image),
            policies,
            starts: self.starts(resolver)?,
            episodes: self.episodes.unwrap_or(if self.until.is_some() { MOST_EPISODES } else { EPISODES }),
            seed,
            budget: budget.or(self.dataset.as_ref().map(|_| DATASET_TIME_LIMIT)),
            counting: match self.protocol {
                Protocol::Strict => Counting::Strict { hold: self.hold },
                Protocol::Compat => Counting::Compat { envs: self.envs },
            },
            conditions: self.conditions(&env)?,
            prediction: self.predict,
            planning_seed: self.planning_seed,
        })
    }

    /// Checks that the options of planning and counting have an effect.
    pub(super) fn check_effects(&self, request: &EvalRequest) -> Result<()> {
        if self.hold != 1 && self.protocol == Protocol::Compat {
            let problem = "with the compat protocol, one step that satisfies the goal ends an episode";
            return Err(Error::config(format!("--hold {}", self.hold), problem, "remove it, or use --protocol strict"));
        }
        let plans = request.policies.iter().any(|policy| matches!(policy.kind, PolicyKind::Plan { .. }));
        let simulates =
            |policy: &PolicyRequest| matches!(&policy.kind, PolicyKind::Plan { model: Model::Simulator { .. }, .. });
        if let Some(option) = self.planner.of_simulator().filter(|_| !request.policies.iter().any(simulates)) {
            let problem = "none of the policies plans in the simulator";
            return Err(Error::config(option, problem, "remove it, or evaluate the policy 'simulator'"));
        }
        let option = match plans {
            false if self.trace => "--trace",
            false if self.planner.is_given() => "an option of planning (--solver, --horizon, --limit, …)",
            _ => return Ok(()),
        };
        Err(Error::config(option, "none of the policies plans", "remove it, or name a policy that plans"))
    }

    /// Checks the options before the outputs of earlier steps of a recipe exist; `is_output` is whether a policy is one.
    ///
    /// # Errors
    /// As [`EvalArgs::request`], as far as it is known.
    pub fn check(&self, resolver: &HomeResolver, is_output: impl Fn(&str) -> bool) -> Result<()> {
        for policy in self.policies.iter().filter(|policy| !is_output(policy)) {
            NamedPolicy::find(policy, self.env.as_deref(), resolver)?;
        }
        self.wrappers.choices(resolver.origin())?;
        self.planner.check()?;
        let Some(env) = &self.env else { return Ok(()) };
        let env = resolver.choose_env(env)?;
        let made = env.env()?;
        for condition in self.conditions(&env)? {
            made.spec().variation_space.resolve(&condition.variation, Key::new(self.seed.unwrap_or_default()))?;
        }
        Ok(())
    }

    /// Checks the options without the policies, and without the conditions if the environment is not one of `swm-envs`.
    ///
    /// # Errors
    /// As [`EvalArgs::check`].
    pub(super) fn check_options(&self, resolver: &HomeResolver) -> Result<()> {
        if self.env.as_ref().is_none_or(|env| swm_envs::ENVS.choose(env).is_ok()) {
            return self.check(resolver, |_| true);
        }
        self.wrappers.choices(resolver.origin())?;
        self.planner.check()
    }

    fn starts(&self, resolver: &HomeResolver) -> Result<StartsRequest> {
        let Some(dataset) = &self.dataset else { return Ok(StartsRequest::Episodic) };
        let split = Split { seed: self.split_seed, ..Split::default() };
        Ok(StartsRequest::Dataset {
            dataset: resolver.pinned_dataset(dataset)?,
            goal_offset: self.goal_offset,
            held_out: self.split.map(|part| HeldOut { part, split }),
            one_per_episode: self.until.is_some(),
        })
    }

    /// Returns the condition of all factors that the arguments set, and then that condition with each shift.
    fn conditions(&self, env: &EnvChoice) -> Result<Vec<Condition>> {
        let condition = |named: &VariationArgs, sampled: &VariationArgs| {
            Ok(Condition { name: self.condition_name(named), variation: sampled.request()? })
        };
        let mut conditions = vec![condition(&self.variation, &self.variation)?];
        if self.shift.is_empty() && !self.each_factor {
            return Ok(conditions);
        }
        let made = env.env()?;
        let space = &made.spec().variation_space;
        // What the environment samples anyway stays sampled, so that all conditions have the same starts; recorded starts
        // have recorded factors.
        let by_default = if self.dataset.is_none() { space.defaults() } else { &[] };
        let each = space.factors().iter().map(|factor| &factor.key).filter(|key| !by_default.contains(key));
        let each: Vec<&String> = if self.each_factor { each.collect() } else { vec![] };
        for shift in self.shift.iter().chain(each) {
            let named = self.variation.with(shift, &[])?;
            conditions.push(condition(&named, &self.variation.with(shift, by_default)?)?);
        }
        Ok(conditions)
    }

    /// Returns the name of a condition: its shifted factors and its wrappers.
    fn condition_name(&self, variation: &VariationArgs) -> String {
        let variation = Some(variation.describe()).filter(|shift| shift != Condition::IN_DISTRIBUTION);
        let shifts: Vec<String> = variation.into_iter().chain(self.wrappers.wrappers.iter().cloned()).collect();
        if shifts.is_empty() { Condition::IN_DISTRIBUTION.to_owned() } else { shifts.join(", ") }
    }
}

/// Evaluates, shows progress and writes `results.json`. `videos` is the number of recorded episodes of each run.
pub fn run(
    request: &EvalRequest,
    resolver: &HomeResolver,
    envs: usize,
    (output, videos): (&Path, usize),
    context: &Context,
) -> Result<(Results, PathBuf)> {
    let is_new = !output.exists();
    let _lock = output_folder::claim(output, &[output_folder::RESULTS])?;
    run_record::check(output)?;
    eval_until::refuse_fixed(output)?;
    let videos = (videos > 0).then(|| (output.to_owned(), videos));
    // Older results keep their videos until there are new results.
    let options = RunOptions { staged: true, ..run_options(envs, videos, context) };
    let results = request.run(resolver, &options, &mut control(context));
    if results.is_err() && is_new {
        files::remove_empty_folder(output)?;
    }
    let results = results?;
    let file = output.join(output_folder::RESULTS);
    publish(output, results.runs.iter().flat_map(|run| &run.videos))?;
    output_folder::delete_traces(output)?;
    write_json(&file, &results)?;
    run_record::write(output, false)?;
    Ok((results, file))
}

/// Returns the options that do not change results; `videos` is a folder, and the number of recorded episodes of each
/// run.
pub fn run_options(envs: usize, videos: Option<(PathBuf, usize)>, context: &Context) -> RunOptions {
    RunOptions { envs, threads: context.threads, videos, frame_strip: None, staged: false }
}

/// Writes indented JSON to a file.
pub fn write_json(file: &Path, value: &impl serde::Serialize) -> Result<()> {
    let text = serde_json::to_string_pretty(value).map_err(|e| Error::external("writing JSON", e))?;
    files::write(file, (text + "\n").as_bytes())
}

/// Returns every traced plan as one object, by run, episode and number.
fn traces(resolver: &HomeResolver, results: &Results) -> Vec<Value> {
    let mut runs: Vec<&Run> = results.runs.iter().collect();
    let mut plans = vec![];
    for (policy, mut records) in resolver.take_traces() {
        // The runs of a policy, and so their plans, are in the order of the conditions.
        let run = runs.iter().position(|run| run.policy == policy).map(|next| runs.remove(next));
        records.sort_by_key(|record| (record.episode, record.replan));
        plans.extend(records.into_iter().map(|record| {
            let mut plan = json!(record);
            plan["policy"] = json!(policy);
            plan["condition"] = json!(run.map(|run| &run.condition));
            plan
        }));
    }
    plans
}
