//! `swm train`: one run here, the steps of a recipe, or a sweep of runs on a Ray cluster.

use super::{OnRayArgs, Request};
use crate::cli::Context;
use crate::cli::recipes::{self, RecipeRun};
use crate::cli::train::{self, TrainArgs};
use clap::Args;
use serde_json::json;
use std::collections::BTreeSet;
use std::path::Path;
use swm_core::{Error, Result};

/// Arguments of `swm train`.
#[derive(Args)]
pub struct TrainCommand {
    #[command(flatten)]
    pub args: TrainArgs,
    #[command(flatten)]
    on: OnRayArgs,
    /// Train once for each value, with --on: seed=0,1,2
    ///
    /// Repeat the option for all combinations. Each run is a folder of the output.
    #[arg(long, value_name = "KEY=VALUES", requires = "on")]
    sweep: Vec<String>,
}

/// The largest number of runs of a sweep.
const MAX_RUNS: usize = 10_000;

/// Runs `swm train`.
pub fn run(command: &TrainCommand, context: &Context) -> anyhow::Result<()> {
    let TrainCommand { args, on, sweep } = command;
    if !on.is_given() {
        let (Some(recipe), Some(output)) = (&args.recipe, &args.output) else { return train::train(args, context) };
        let settings = args.model.iter().chain(&args.settings).map(String::as_str).collect();
        return recipes::run(&RecipeRun { recipe, output: Path::new(output), settings, trust: args.trust }, context);
    }
    let refused =
        [("--recipe", args.recipe.is_some()), ("--resume", args.resume), ("--print-config", args.print_config)];
    on.refuse(&refused, "remove it: the same command continues interrupted runs")?;
    let Some(output) = &args.output else {
        return Err(Error::config("--output", "is not given", "name the folder or the URI of the runs").into());
    };
    if args.data.is_none() && args.env.is_none() {
        let fix = "name a dataset with --data, by a URI or a path that all nodes have, or an environment with --env";
        return Err(Error::config("--data", "no dataset is given", fix).into());
    }
    let runs = runs(sweep)?;
    for settings in &runs {
        args.config_with(settings)?;
    }
    let name = |settings: &[String]| if settings.is_empty() { "run".to_owned() } else { settings.join(",") };
    let names: Vec<String> = runs.iter().map(|run| name(run)).collect();
    on.check_new(output, &names.iter().map(String::as_str).collect::<Vec<_>>())?;
    let runs: Vec<_> = runs.iter().map(|run| json!({"name": name(run), "settings": run})).collect();
    let replaced = &["-o", "--output", "--sweep"];
    on.submit(&Request { kind: "train", output, replaced, cells: json!({"runs": runs}) }, context)
}

/// The settings of every run of a sweep.
fn runs(sweep: &[String]) -> Result<Vec<Vec<String>>> {
    let (mut runs, mut keys) = (vec![vec![]], BTreeSet::new());
    for given in sweep {
        let invalid = |problem: &str| Error::config(format!("--sweep {given}"), problem, "write KEY=VALUE,VALUE");
        let (key, values) = given.split_once('=').ok_or_else(|| invalid("has no values"))?;
        if !keys.insert(key) {
            return Err(invalid("its setting is swept twice"));
        }
        // The values name folders.
        let plain = |c: char| c.is_ascii_alphanumeric() || "._+-".contains(c);
        let values: Vec<&str> = values.split(',').collect();
        if values.iter().any(|value| value.is_empty() || !value.chars().all(plain)) {
            return Err(invalid("a value is not a number or a word"));
        }
        if values.iter().collect::<BTreeSet<_>>().len() < values.len() {
            return Err(invalid("a value is given twice"));
        }
        if runs.len().saturating_mul(values.len()) > MAX_RUNS {
            return Err(invalid("makes more than 10000 runs"));
        }
        let with = |run: &Vec<String>, value: &&str| run.iter().cloned().chain([format!("{key}={value}")]).collect();
        runs = runs.iter().flat_map(|run| values.iter().map(move |value| with(run, value))).collect();
    }
    Ok(runs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sweep_has_all_combinations() {
        let sweep = ["seed=0,1".to_owned(), "optim.lr=1e-3,3e-4".to_owned()];
        let found: Vec<String> = runs(&sweep).expect("a sweep").iter().map(|run| run.join(" ")).collect();
        let expected = ["seed=0 optim.lr=1e-3", "seed=0 optim.lr=3e-4", "seed=1 optim.lr=1e-3", "seed=1 optim.lr=3e-4"];
        assert_eq!(found, expected);
        assert_eq!(runs(&[]).expect("no sweep"), [Vec::<String>::new()]);
        for wrong in ["seed", "seed=", "seed=0,0", "seed=a/b"] {
            assert!(runs(&[wrong.to_owned()]).is_err(), "{wrong}");
        }
        assert!(runs(&["seed=0".to_owned(), "seed=1".to_owned()]).is_err());
    }
}
