//! How a policy plans, as the command line says it: solver, horizon, objective.

use super::solvers;
use clap::Args;
use serde_json::{Map, Value, json};
use swm_core::{EnvChoice, Error, Result};
use swm_eval::{Choice, Model, PolicyKind};
use swm_plan::ActionKind;
use swm_plan::objective::ObjectiveConfig;
use swm_plan::{MpcConfig, SOLVERS};

/// How a world model plans; the defaults are those of the paper's experiments.
#[derive(Args, Clone)]
#[command(next_help_heading = "Planning")]
pub struct PlannerArgs {
    /// The solver and its settings, such as icem,samples=64,iterations=5 (`swm solvers` lists them); several are compared
    /// [default: the first that plans the environment's actions]
    #[arg(long = "solver", value_name = "NAME[,KEY=VALUE…]")]
    pub solvers: Vec<String>,
    /// Model steps to plan
    #[arg(long, default_value_t = 5)]
    pub horizon: usize,
    /// Model steps to execute before planning again
    #[arg(long, default_value_t = 5)]
    pub receding_horizon: usize,
    /// Environment steps in a model step of the simulator; a checkpoint knows its own
    #[arg(long, default_value_t = 5, value_name = "STEPS")]
    pub action_block: usize,
    /// Begin every plan anew, not from what the last one left
    #[arg(long)]
    pub cold_start: bool,
    /// Stop searching after so many seconds; results then depend on the machine
    #[arg(long, value_name = "SECONDS")]
    pub latency_budget: Option<f64>,
    /// A term of the objective: goal, control or change, with settings such as control,weight=0.01. Without a goal term
    /// they are added to the model's own cost
    #[arg(long = "term", value_name = "NAME[,KEY=VALUE…]")]
    pub terms: Vec<String>,
    /// A constraint: action_norm,limit=2 or latent_box
    #[arg(long = "limit", value_name = "NAME[,KEY=VALUE…]")]
    pub limits: Vec<String>,
    /// What the simulator judges a plan by: terminal, running or reach
    #[arg(long, default_value = "terminal")]
    pub score: String,
}

impl PlannerArgs {
    /// Every solver asked for, as a registry knows it; without any, the first that plans the environment's actions and
    /// asks for nothing but a cost.
    ///
    /// # Errors
    /// When a solver or a setting is unknown.
    pub fn solvers(&self, env: &EnvChoice) -> Result<Vec<Choice>> {
        if !self.solvers.is_empty() {
            let choices = self.solvers.iter().map(|text| {
                let (entry, settings) = solvers::parse(text)?;
                Ok(Choice { id: entry.id.to_owned(), settings })
            });
            return choices.collect();
        }
        let actions = ActionKind::of(&env.env()?.spec().action_space);
        let first = match actions {
            ActionKind::Continuous => SOLVERS.get("cem")?,
            ActionKind::Discrete => {
                SOLVERS.rows.iter().find(|row| row.actions == actions && row.needs.is_empty()).ok_or_else(|| {
                    Error::config("--solver", "none plans discrete actions", "`swm solvers` lists them")
                })?
            }
        };
        Ok(vec![Choice { id: first.id.to_owned(), settings: (first.defaults)() }])
    }

    /// Planning in a model with a solver; `block` and `history` are the model's.
    ///
    /// # Errors
    /// When the objective is none.
    pub fn plan(&self, model: Model, solver: Choice, block: usize, history: usize) -> Result<PolicyKind> {
        let mpc = MpcConfig {
            horizon: self.horizon,
            receding_horizon: self.receding_horizon.min(self.horizon),
            action_block: block,
            warm_start: !self.cold_start,
            history,
            latency_budget: self.latency_budget,
        };
        mpc.check()?;
        let objective = self.objective()?;
        let objective = if objective.is_empty() { Value::Null } else { json!(objective) };
        Ok(PolicyKind::Plan { model, solver, mpc: json!(mpc), objective })
    }

    fn objective(&self) -> Result<ObjectiveConfig> {
        let read = |flag: &str, tag: &str, texts: &[String]| -> Result<Vec<Value>> {
            texts
                .iter()
                .map(|text| {
                    let (name, mut settings) = named(flag, text)?;
                    settings.insert(tag.to_owned(), json!(name.replace('-', "_")));
                    Ok(Value::Object(settings))
                })
                .collect()
        };
        let described = json!({
            "terms": read("--term", "term", &self.terms)?,
            "constraints": read("--limit", "constraint", &self.limits)?,
        });
        serde_json::from_value(described).map_err(|error| {
            Error::config(
                "--term or --limit",
                error.to_string(),
                "terms are goal, control and change; limits are action_norm and latent_box",
            )
        })
    }
}

/// A name and its settings from `NAME,KEY=VALUE,…`; values are JSON where they can be, and words otherwise.
///
/// # Errors
/// When a setting has no value.
pub fn named<'a>(flag: &str, text: &'a str) -> Result<(&'a str, Map<String, Value>)> {
    let (name, rest) = text.split_once(',').unwrap_or((text, ""));
    let mut settings = Map::new();
    for pair in rest.split(',').filter(|pair| !pair.is_empty()) {
        let Some((key, value)) = pair.split_once('=') else {
            let (problem, fix) = (format!("'{pair}' is not KEY=VALUE"), "write it like NAME,KEY=VALUE,KEY=VALUE");
            return Err(Error::config(format!("{flag} {text}"), problem, fix));
        };
        let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
        settings.insert(key.to_owned(), value);
    }
    Ok((name, settings))
}
