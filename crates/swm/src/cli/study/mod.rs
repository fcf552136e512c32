//! `swm study`: many evaluations with one table.

mod any_file;
mod breaking;
mod chosen;
mod colour;
mod csv;
mod drift;
mod expand;
mod export;
mod export_table;
mod file;
mod online;
mod published;
mod report;
mod resume;
mod shipped;
mod table_kind;
mod tables;
mod text_check;
mod variants;

use super::config::count;
use super::eval::run_options;
use super::on_ray::study::check_output;
use super::on_ray::{OnRayArgs, Request};
use super::progress::control;
use super::recipes::Datasets;
use super::results_tables::{compared, percent};
use super::run_record::now;
use super::{Context, emit, emit_json, output_folder, table};
use crate::resolver::HomeResolver;
use any_file::{AnyFile, Size};
use clap::{Args, Subcommand, ValueEnum as _};
pub(super) use expand::shell;
use export::Format;
pub use export::escape_markdown;
pub use report::write_page;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use swm_core::results::{BreakingPoint, StudyResults, Until};
use swm_core::run::Control;
use swm_core::{Error, Origin, Result, limits};
use swm_eval::{AnyStudy, Cell, Common, Study, StudyFolder};
pub use text_check::check_text;

/// Arguments of `swm study`.
#[derive(Args)]
pub struct StudyArgs {
    #[command(subcommand)]
    command: StudyCommand,
}

#[derive(Subcommand)]
enum StudyCommand {
    /// List the studies of this program
    #[command(after_help = "Example: swm study list")]
    List,
    /// Evaluate or measure the cells of a study that have no results
    ///
    /// A study is a file of tables with the options of `swm eval` (docs/studies.md), or the name of a study of this
    /// program. An interrupted study continues.
    #[command(after_help = "Example: swm study run paper/factors --output factors episodes=20")]
    Run(RunArgs),
    /// Evaluate the cells that a study's folder lacks
    ///
    /// The folder is all that is needed: it may come from another machine.
    #[command(after_help = "Example: swm study resume factors")]
    Resume(resume::ResumeArgs),
    /// Write the hash of a study before its first result
    ///
    /// The hash covers the question, all cells with the hashes of their datasets and weights, and the families. Publish it: the
    /// page of the study says whether it still is the registered one.
    #[command(after_help = "Example: swm study register paper/factors --output factors")]
    Register(RunArgs),
    /// Find the change of a factor at which a policy loses half of its success
    ///
    /// Evaluates eight levels from the default of the factor towards another value, then three inside the first interval in
    /// which success falls below half. The folder is that of a study.
    #[command(after_help = "Example: swm study break zoo:two-room/pldm --factor agent.color --towards cyan -o cyan")]
    Break(breaking::BreakArgs),
    /// Show how many cells are done, and their results
    #[command(after_help = "Example: swm study status factors")]
    Status {
        /// The folder of the study
        folder: PathBuf,
    },
    /// Write one HTML page, with figures and tables beside it
    ///
    /// The page shows what is done, so it can be written while the study runs. Figures are SVG and PNG files in the folder
    /// `figures`; the table is written as CSV, LaTeX and Markdown.
    #[command(after_help = "Example: swm study report factors --output page")]
    Report(report::ReportArgs),
    /// Print the results as CSV, LaTeX or Markdown
    #[command(after_help = "Example: swm study export factors --format latex")]
    Export {
        /// The folder of the study
        folder: PathBuf,
        /// The format
        #[arg(long, value_enum, default_value_t = Format::Csv)]
        format: Format,
    },
}

/// Arguments of `swm study run`.
#[derive(Args)]
struct RunArgs {
    /// The path of a file, or the name of a study of this program
    study: String,
    /// Options of all evaluations, which replace the defaults of the study
    #[arg(value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Run the small size of the study: minutes on two cores
    #[arg(long)]
    small: bool,
    /// Folder of the study
    #[arg(short, long, value_name = "DIR", required_unless_present = "commands")]
    output: Option<PathBuf>,
    /// Parallel environments; results do not depend on their number
    #[arg(long, default_value_t = 16, value_parser = count::<1, { limits::ENVS.max }>)]
    envs: usize,
    /// Allow the file to name what loads code or opens connections
    ///
    /// docs/security.md says what files may do without it.
    #[arg(long)]
    trust: bool,
    /// Print a `swm eval` command for each cell, and evaluate nothing
    #[arg(long, conflicts_with_all = ["output", "until"])]
    commands: bool,
    /// Play starts until a rule is met: ci=5, decided or decided=10
    ///
    /// ci=5 ends a cell when the 95 % interval of its success rate is at most 5 percentage points wide on each side.
    /// decided=10 ends it when its gap is told apart from zero or shown to be below 10 points. `episodes` is the most. All
    /// intervals are confidence sequences then.
    #[arg(long, value_name = "RULE")]
    until: Option<Until>,
    #[command(flatten)]
    on: OnRayArgs,
}

/// Runs `swm study`.
pub fn study(args: &StudyArgs, json: bool, context: impl FnOnce() -> Result<Context>) -> anyhow::Result<()> {
    match &args.command {
        StudyCommand::List => list(json),
        StudyCommand::Run(args) => run(args, false, &context()?),
        StudyCommand::Resume(args) => resume::run(args, &context()?),
        StudyCommand::Register(args) => run(args, true, &context()?),
        StudyCommand::Break(args) => breaking::run(args, &context()?),
        StudyCommand::Status { folder } => {
            let folder = StudyFolder::new(folder);
            match folder.open()? {
                AnyStudy::Evaluations(study) => show(&study.results(&folder)?, json),
                AnyStudy::Table(study) => export_table::show(&study.results(&folder)?, json),
            }
        }
        StudyCommand::Report(args) => report::report(args, json),
        StudyCommand::Export { folder, format } => {
            emit(&format.of(&StudyFolder::new(folder))?);
            Ok(())
        }
    }
}

fn list(json: bool) -> anyhow::Result<()> {
    if json {
        return emit_json(&shipped()?);
    }
    let studies = shipped::all()?;
    emit(&table(
        &["study", "question"],
        studies.iter().map(|(name, file)| vec![(*name).to_owned(), file.texts()[1].to_owned()]),
    ));
    Ok(())
}

/// Returns the name, title and question of every study of this program.
///
/// # Errors
/// When a file is invalid, which is a bug.
pub fn shipped() -> Result<Value> {
    let studies = shipped::all()?.into_iter().map(|(name, file)| {
        let [title, question] = file.texts();
        json!({"name": name, "title": title, "question": question})
    });
    Ok(studies.collect())
}

/// Returns the results of the study in a folder.
///
/// # Errors
/// When the folder has no study, or it is damaged.
pub fn results(folder: &Path) -> Result<Value> {
    let folder = StudyFolder::new(folder);
    let value = match folder.open()? {
        AnyStudy::Evaluations(study) => serde_json::to_value(study.results(&folder)?),
        AnyStudy::Table(study) => serde_json::to_value(study.results(&folder)?),
    };
    value.map_err(|error| Error::external("writing the results of a study", error))
}

/// Returns the table of the study in a folder, in a format by its name.
///
/// # Errors
/// When there is no such format, the folder has no study, or it is damaged.
pub fn export(folder: &Path, format: &str) -> Result<String> {
    let names =
        Format::value_variants().iter().filter_map(|format| Some(format.to_possible_value()?.get_name().to_owned()));
    let names: Vec<String> = names.collect();
    let names = names.iter().map(String::as_str);
    let found = Format::from_str(format, false);
    let found = found
        .map_err(|_| Error::unknown("format", format, names, "choose one of the formats of `swm study export`"))?;
    found.of(&StudyFolder::new(folder))
}

/// Returns the study of one policy under one condition. `settings` are options of `swm eval`, each KEY=VALUE.
///
/// # Errors
/// When a name does not exist, a setting is invalid, or the settings make several evaluations.
pub(super) fn single(
    [title, question, name, policy]: [&str; 4],
    settings: &[String],
    resolver: &HomeResolver,
    control: &mut Control<'_>,
) -> Result<Study> {
    let table = |name: &str, options| file::Table {
        at: file::OF_THE_COMMAND.to_owned(),
        name: name.to_owned(),
        options,
        ..file::Table::default()
    };
    if let Some(given) = settings.iter().find(|setting| setting.starts_with("policy=")) {
        let problem = format!("the model is '{policy}', and evaluated alone");
        return Err(Error::config(given, problem, "remove the setting, or give another model"));
    }
    let options = BTreeMap::from([(file::POLICY.to_owned(), vec![policy.to_owned()])]);
    let file = file::StudyFile {
        title: title.to_owned(),
        question: question.to_owned(),
        families: Common::by_default(),
        defaults: file::Table::default(),
        starts: vec![file::Table::default()],
        conditions: vec![table("in distribution", BTreeMap::new())],
        policies: vec![table(name, options)],
        published: vec![],
        datasets: Datasets::default(),
    };
    expand::study(&file, settings, resolver, control)
}

/// Runs or registers a study.
fn run(args: &RunArgs, only_register: bool, context: &Context) -> anyhow::Result<()> {
    let size = if args.small { Size::Small } else { Size::Paper };
    let (file, origin) = shipped::find(&args.study, size, args.trust)?;
    if only_register {
        args.on.refuse(&[("--on", args.on.is_given())], "remove it: a study is registered on this machine")?;
    }
    let file = match file {
        AnyFile::Evaluations(file) => file,
        AnyFile::Table(_) if only_register => {
            let fix = "register a study of evaluations";
            return Err(Error::config(&args.study, "its cells are no evaluations, and have no families", fix).into());
        }
        AnyFile::Table(file) => return run_table(&file, size, &origin, args, context),
    };
    let resolver = HomeResolver::new(origin.clone());
    // Settings on the command line are the user's own.
    let own_env = args.settings.iter().find_map(|setting| setting.strip_prefix("env="));
    let resolver = own_env.into_iter().fold(resolver, HomeResolver::with_env);
    if args.commands {
        let evaluations = expand::commands(&file, &args.settings, &resolver)?;
        for arguments in file.datasets.commands().into_iter().chain(evaluations) {
            emit(&format!("swm {}\n", shell(&arguments)));
        }
        return Ok(());
    }
    let Some(output) = &args.output else { return Ok(()) };
    let output = output_text(&args.on, output)?;
    file.datasets.check_origin(&origin)?;
    // Before datasets are collected, which may take long.
    expand::check(&file, &args.settings, &resolver)?;
    if !only_register {
        check_output(output, &file.title, args.until, &args.on)?;
    }
    file.datasets.make(&origin, context)?;
    let mut study: Study = expand::study(&file, &args.settings, &resolver, &mut control(context))?;
    study.arguments = args.arguments();
    study = with_rule(study, args.until)?;
    if args.on.is_given() {
        return submit(&args.on, Path::new(output), cluster_cells(&study, &resolver)?, context);
    }
    let folder = StudyFolder::new(Path::new(output));
    if only_register {
        let (_lock, registration) = folder.register(&study, &now())?;
        if context.json {
            let cells = study.cells.len();
            return emit_json(
                &json!({"registered": registration.hash, "cells": cells, "unproven_date": registration.date}),
            );
        }
        let date = registration.date.unwrap_or_default();
        emit(&format!("{}\ndate of this machine's clock, unproven: {date}\n", registration.hash));
        return Ok(());
    }
    let _lock = folder.create(&study)?;
    study.run(&folder, &resolver, &run_options(args.envs, None, context), &mut control(context))?;
    show(&study.results(&folder)?, context.json)
}

/// What a cluster needs to know of a study: its cells with their ids, and the stages of a rule that ends it.
fn cluster_cells(study: &Study, resolver: &HomeResolver) -> Result<Value> {
    let ids = study.cells.iter().map(Cell::id).collect::<Result<Vec<_>>>()?;
    let mut cells = json!({"study": study, "ids": ids});
    if study.until.is_some() {
        study.check_starts(resolver)?;
        cells["stages"] = json!(study.stages());
    }
    Ok(cells)
}

/// The study with the rule that ends it, if there is one.
fn with_rule(mut study: Study, until: Option<Until>) -> Result<Study> {
    let Some(until) = until else { return Ok(study) };
    study.arguments.extend(["--until".to_owned(), until.to_string()]);
    let study = study.until(until);
    study.check()?;
    Ok(study)
}

/// Runs a study whose cells are no evaluations.
fn run_table(
    file: &tables::TableFile,
    size: Size,
    origin: &Origin,
    args: &RunArgs,
    context: &Context,
) -> anyhow::Result<()> {
    let Some(output) = &args.output else {
        let fix = "run it with --output DIR";
        return Err(Error::config("--commands", "no cell of this study is an evaluation", fix).into());
    };
    if args.until.is_some() {
        let fix = "run it without the option";
        return Err(Error::config("--until", "no cell of this study has episodes", fix).into());
    }
    let mut study = file.study(size, &args.settings, origin)?;
    study.arguments = args.arguments();
    let datasets = file.datasets(size)?;
    datasets.check_origin(origin)?;
    check_output(output_text(&args.on, output)?, &study.title, None, &args.on)?;
    datasets.make(origin, context)?;
    if args.on.is_given() {
        return submit(&args.on, output, file.cluster_cells(&study)?, context);
    }
    let folder = StudyFolder::new(output);
    tables::run(&study, &folder, context)?;
    export_table::show(&study.results(&folder)?, context.json)
}

/// Hands the cells of a study over to a cluster.
fn submit(on: &OnRayArgs, output: &Path, cells: Value, context: &Context) -> anyhow::Result<()> {
    let output = output_text(on, output)?;
    on.submit(&Request { kind: "study", output, replaced: &["-o", "--output"], cells }, context)
}

/// An output as text, which paths of a cluster are. Without one, it is a folder of this machine.
fn output_text<'a>(on: &OnRayArgs, output: &'a Path) -> Result<&'a str> {
    if !on.is_given() {
        output_folder::check_local(output)?;
    }
    let fix = "give another folder with --output";
    output.to_str().ok_or_else(|| Error::config(output.display().to_string(), "is no valid UTF-8", fix))
}

impl RunArgs {
    /// The name of the study, its size and its settings, for the command that runs it again.
    fn arguments(&self) -> Vec<String> {
        let small = self.small.then(|| "--small".to_owned());
        std::iter::once(shipped::short_name(&self.study)).chain(small).chain(self.settings.iter().cloned()).collect()
    }
}

/// A column of the table that is shown if its cells differ: its title, and its text in a row.
type OptionalColumn = (&'static str, fn(&swm_core::results::StudyRow) -> String);

/// Prints the results.
fn show(results: &StudyResults, json: bool) -> anyhow::Result<()> {
    if json {
        return emit_json(results);
    }
    emit(&format!("{}: {} of {} cells\n", results.title, results.done, results.cells));
    if let Some(registration) = &results.registration {
        emit(&format!("{registration}\n"));
    }
    let several = |of: fn(&swm_core::results::StudyRow) -> String| {
        results.rows.first().is_some_and(|first| results.rows.iter().any(|row| of(row) != of(first)))
    };
    let optional: [OptionalColumn; 3] = [
        ("starts", |row| row.starts.clone()),
        ("counting", |row| row.counting.name().to_owned()),
        ("seed", |row| row.seed.to_string()),
    ];
    let shown: Vec<_> = optional.into_iter().filter(|(_, of)| several(*of)).collect();
    let mut header: Vec<&str> = shown.iter().map(|(name, _)| *name).collect();
    header.extend(["condition", "policy", "success [95 %]", "n", "floor", "gap [95 %]", "p, corrected", "verdict"]);
    let rows = results.rows.iter().zip(export::conditions(results)).map(|(row, condition)| {
        let mut cells: Vec<String> = shown.iter().map(|(_, of)| of(row)).collect();
        let gap = row.gap.as_ref().map_or(["–"; 3].map(str::to_owned), compared);
        let floor = if row.floor.n == 0 { "–".to_owned() } else { format!("{:.0} %", 100.0 * row.floor.rate) };
        cells.extend([condition, row.policy.clone(), percent(&row.success), row.success.n.to_string(), floor]);
        cells.extend(gap);
        cells
    });
    emit(&table(&header, rows));
    for sentence in results.breaking.iter().flat_map(BreakingPoint::sentences) {
        emit(&format!("{sentence}\n"));
    }
    for note in results.notes_on_rule() {
        emit(&format!("{note}\n"));
    }
    for family in &results.families {
        emit(&format!("{}: {family}\n", family.name));
    }
    let over_seeds = export::over_seeds(results);
    if !over_seeds.is_empty() {
        let header = ["condition", "policy", "training seeds, %", "mean", "new seed [95 %]", "IQM [95 %]"];
        emit(&format!("\n{}", table(&header, over_seeds.into_iter())));
    }
    Ok(())
}
