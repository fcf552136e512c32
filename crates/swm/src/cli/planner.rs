//! Arguments for planning: solvers, horizon, objective.

use super::{solvers, tagged};
use clap::Args;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};
use swm_core::{EnvChoice, Error, Result};
use swm_eval::{Choice, Model, PolicyKind};
use swm_plan::ActionKind;
use swm_plan::objective::ObjectiveConfig;
use swm_plan::{MpcConfig, SOLVERS};

/// Settings of planning. The defaults are those of the experiments in the stable-worldmodel paper.
#[derive(Args, Clone)]
#[command(next_help_heading = "Planning")]
pub struct PlannerArgs {
    /// Solver and settings, such as icem,samples=64; several are compared
    ///
    /// `swm solvers` lists them. Default: the first solver for the environment's actions.
    #[arg(long = "solver", value_name = "NAME[,KEY=VALUE…]")]
    pub solvers: Vec<String>,
    /// Model steps per plan (default: 5)
    #[arg(long, value_name = "STEPS")]
    pub horizon: Option<usize>,
    /// Model steps to execute before planning again (default: 5, at most the horizon)
    #[arg(long, value_name = "STEPS")]
    pub receding_horizon: Option<usize>,
    /// Environment steps per model step of the simulator
    ///
    /// A checkpoint has its own action block.
    #[arg(long, default_value_t = ACTION_BLOCK, value_name = "STEPS")]
    pub action_block: usize,
    /// Do not initialise a plan with the remaining steps of the previous plan
    #[arg(long)]
    pub cold_start: bool,
    /// Time limit of a plan; results then depend on the machine
    #[arg(long, value_name = "SECONDS")]
    pub latency_budget: Option<f64>,
    /// Plan for environments together on a GPU
    ///
    /// It is faster, and the last bits of a plan may then depend on the other environments. The CPU plans for each on its own.
    #[arg(long)]
    pub fast: bool,
    /// Term of the objective: goal, control or change; may be repeated
    ///
    /// With settings, such as control,weight=0.01. Without a goal term, the model's own cost is kept and terms are
    /// added. goal,when=closest lets a plan reach the goal before its end.
    #[arg(long = "term", value_name = "NAME[,KEY=VALUE…]")]
    pub terms: Vec<String>,
    /// Constraint, such as action_norm,limit=2 or latent_box
    #[arg(long = "limit", value_name = "NAME[,KEY=VALUE…]")]
    pub limits: Vec<String>,
    /// Score of simulated plans: terminal, running, reach, success or reward
    #[arg(long, default_value = SCORE)]
    pub score: String,
}

/// The default score of simulated plans, and the environment steps per model step of the simulator.
const SCORE: &str = "terminal";
const ACTION_BLOCK: usize = 5;

/// The default horizon and receding horizon, in model steps.
const HORIZON: usize = 5;
/// The names of `--term`.
const TERMS: [&str; 3] = ["goal", "control", "change"];
/// The names of `--limit`.
const LIMITS: [&str; 2] = ["action_norm", "latent_box"];

impl PlannerArgs {
    /// Returns whether an option of planning in a checkpoint is given.
    pub fn is_given(&self) -> bool {
        let lists = [&self.solvers, &self.terms, &self.limits];
        let horizons = [self.horizon, self.receding_horizon];
        lists.iter().any(|list| !list.is_empty())
            || horizons.iter().any(Option::is_some)
            || self.cold_start
            || self.latency_budget.is_some()
            || self.fast
    }

    /// Returns the option that only plans in the simulator use, if one is given.
    pub fn of_simulator(&self) -> Option<&'static str> {
        let score = (self.score != SCORE).then_some("--score");
        score.or_else(|| (self.action_block != ACTION_BLOCK).then_some("--action-block"))
    }

    /// Returns the solvers with complete settings. Without --solver, this is the first solver for the environment's
    /// actions that requires only a cost.
    ///
    /// # Errors
    /// When a solver or a setting is unknown.
    pub fn solvers(&self, env: &EnvChoice) -> Result<Vec<Choice>> {
        if !self.solvers.is_empty() {
            return self.given();
        }
        let actions = ActionKind::of(&env.env()?.spec().action_space);
        let first = match actions {
            ActionKind::Continuous => SOLVERS.get("cem")?,
            ActionKind::Discrete => {
                SOLVERS.rows.iter().find(|row| row.actions == actions && row.needs.is_empty()).ok_or_else(|| {
                    Error::config(
                        "--solver",
                        "no solver plans discrete actions without settings",
                        "name one (`swm solvers` lists them)",
                    )
                })?
            }
        };
        Ok(vec![Choice { id: first.id.to_owned(), settings: (first.defaults)() }])
    }

    /// Returns the solvers that the command names.
    fn given(&self) -> Result<Vec<Choice>> {
        let choices = self.solvers.iter().map(|text| {
            let (entry, settings) = solvers::parse(text)?;
            Ok(Choice { id: entry.id.to_owned(), settings })
        });
        choices.collect()
    }

    /// Checks the options without a model and an environment.
    ///
    /// # Errors
    /// When a solver or a setting is unknown, or a setting of planning or of the objective is invalid.
    pub fn check(&self) -> Result<()> {
        let model = || Model::Simulator { score: self.score.clone() };
        self.given()?.into_iter().try_for_each(|solver| self.plan(model(), solver, 1, 1).map(drop))
    }

    /// Returns the policy that plans in a model with a solver. `block` is the number of environment steps in a
    /// model step, `history` the number of observations that the model gets.
    ///
    /// # Errors
    /// When a setting of planning or of the objective is invalid.
    pub fn plan(&self, model: Model, solver: Choice, block: usize, history: usize) -> Result<PolicyKind> {
        let horizon = self.horizon.unwrap_or(HORIZON);
        let mpc = MpcConfig {
            horizon,
            receding_horizon: self.receding_horizon.unwrap_or(HORIZON.min(horizon)),
            action_block: block,
            warm_start: !self.cold_start,
            history,
            latency_budget: self.latency_budget,
            fast: self.fast,
        };
        mpc.check()?;
        let objective = self.objective()?;
        let objective = if objective.is_empty() { Value::Null } else { json!(objective) };
        Ok(PolicyKind::Plan { model, solver, mpc: json!(mpc), objective })
    }

    fn objective(&self) -> Result<ObjectiveConfig> {
        let objective = ObjectiveConfig {
            terms: read("--term", "term", &TERMS, &self.terms)?,
            constraints: read("--limit", "constraint", &LIMITS, &self.limits)?,
        };
        objective.check()?;
        Ok(objective)
    }
}

/// Reads the values of an option that may be repeated; `tag` is the kind of what `known` names.
fn read<T: DeserializeOwned>(flag: &str, tag: &'static str, known: &[&str], texts: &[String]) -> Result<Vec<T>> {
    let read = |text: &String| {
        let (given, settings) = named(flag, text)?;
        let name = given.replace('-', "_");
        if !known.contains(&name.as_str()) {
            let hint = format!("{flag} accepts {}", known.join(", "));
            return Err(Error::unknown(tag, &name, known.iter().copied(), hint));
        }
        tagged::read(&format!("{flag} {given}"), tag, &name, &settings)
    };
    texts.iter().map(read).collect()
}

/// Parses `NAME,KEY=VALUE,…`. Values are JSON where they parse as JSON, else strings.
///
/// # Errors
/// When a setting has no value, or is given twice.
pub fn named<'a>(flag: &str, text: &'a str) -> Result<(&'a str, Map<String, Value>)> {
    let (name, rest) = text.split_once(',').unwrap_or((text, ""));
    let mut settings = Map::new();
    for pair in rest.split(',').filter(|pair| !pair.is_empty()) {
        let Some((key, value)) = pair.split_once('=') else {
            let (problem, fix) = (format!("'{pair}' is not KEY=VALUE"), "write it like NAME,KEY=VALUE,KEY=VALUE");
            return Err(Error::config(format!("{flag} {text}"), problem, fix));
        };
        let parsed = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
        if let Some(first) = settings.insert(key.to_owned(), parsed) {
            let first = first.as_str().map_or_else(|| first.to_string(), str::to_owned);
            return Err(Error::twice(format!("{flag} {text}"), format!("{key}={first}"), pair));
        }
    }
    Ok((name, settings))
}
