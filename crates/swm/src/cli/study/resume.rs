//! `swm study resume`: evaluates what the folder of a study lacks.

use super::expand::Inputs;
use super::{export_table, show, tables};
use crate::cli::config::count;
use crate::cli::eval::{run_options, write_json};
use crate::cli::progress::control;
use crate::cli::{Context, emit, emit_json};
use crate::resolver::HomeResolver;
use clap::Args;
use serde_json::json;
use std::path::PathBuf;
use swm_core::{Error, Origin, limits};
use swm_eval::{AnyStudy, Study, StudyFolder, TableStudy};

/// The file with the ids of the cells that a stage leaves open.
const OPEN: &str = "open.json";

/// Arguments of `swm study resume`.
#[derive(Args)]
pub struct ResumeArgs {
    /// The folder of the study
    folder: PathBuf,
    /// Evaluate only the cell with this id
    #[arg(long, value_name = "ID")]
    cell: Option<String>,
    /// Play at most so many starts of the cell
    ///
    /// Without --cell, apply the rule that ends the study to so many starts, and write the ids of the cells that need more.
    #[arg(long, hide = true, value_name = "EPISODES")]
    stage: Option<usize>,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16, value_parser = count::<1, { limits::ENVS.max }>)]
    envs: usize,
    /// Allow the folder to name what loads code or opens connections
    ///
    /// docs/security.md says what files may do without it.
    #[arg(long)]
    trust: bool,
}

/// Runs `swm study resume`.
pub fn run(args: &ResumeArgs, context: &Context) -> anyhow::Result<()> {
    let folder = StudyFolder::new(&args.folder);
    let study = match folder.open()? {
        AnyStudy::Evaluations(study) => study,
        AnyStudy::Table(study) => return run_table(&study, &folder, args, context),
    };
    let resolver = HomeResolver::new(Origin::file(args.folder.join("study.json"), args.trust));
    let _lock = folder.create(&study)?;
    let (options, control) = (run_options(args.envs, None, context), &mut control(context));
    if let (Some(stage), None) = (args.stage, &args.cell) {
        let open = match study.until {
            Some(until) => study.open_after(until, &folder, stage)?,
            None => return Err(Error::config("--stage", "the study has no rule that ends it", "leave it out").into()),
        };
        // What a command prints may be too long for a record.
        write_json(&args.folder.join(OPEN), &open)?;
        return emit_json(&json!({"open": open.len()}));
    }
    check_inputs(&study, args.cell.as_deref(), &folder, &resolver)?;
    if let Some(id) = &args.cell {
        study.run_cell(id, args.stage, &folder, &resolver, &options, control)?;
        if context.json {
            return emit_json(&json!({"cell": id}));
        }
        emit(&format!("{id}\n"));
        return Ok(());
    }
    study.run(&folder, &resolver, &options, control)?;
    show(&study.results(&folder)?, context.json)
}

/// Checks that the datasets and checkpoints of all cells that are not done, or of the only one, are those of the study: their names may mean
/// something else in another folder, or after a change.
fn check_inputs(
    study: &Study,
    only: Option<&str>,
    folder: &StudyFolder,
    resolver: &HomeResolver,
) -> anyhow::Result<()> {
    let cells = match only {
        Some(only) => study.cells.iter().filter(|cell| cell.id().is_ok_and(|id| id == only)).collect(),
        None => study.unfinished(folder)?,
    };
    let mut inputs = Inputs::new(resolver);
    for cell in cells {
        cell.check_inputs(&inputs.of(&cell.request)?)?;
    }
    Ok(())
}

/// Fills the rows that a study of another kind lacks.
fn run_table(study: &TableStudy, folder: &StudyFolder, args: &ResumeArgs, context: &Context) -> anyhow::Result<()> {
    let given = args.folder.display().to_string();
    if args.cell.is_some() || args.stage.is_some() {
        let problem = format!("the study is of the kind '{}', whose rows are no evaluations", study.kind);
        return Err(Error::config("--cell", problem, "resume all rows").into());
    }
    if !args.trust {
        let problem = format!("has a study of the kind '{}', whose rows may load code", study.kind);
        let fix =
            "give --trust if you know who wrote the folder, or run the study again: swm study run NAME --output FOLDER";
        return Err(Error::config(given, problem, fix).into());
    }
    tables::run(study, folder, context)?;
    export_table::show(&study.results(folder)?, context.json)
}
