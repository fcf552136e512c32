//! `swm study`: many evaluations with one table.

mod breaking;
mod colour;
mod expand;
mod export;
mod file;
mod published;
mod report;
mod shipped;
mod variants;

use super::config::count;
use super::eval::run_options;
use super::progress::control;
use super::results_tables::{compared, percent};
use super::{Context, emit, emit_json, table};
use crate::resolver::HomeResolver;
use clap::{Args, Subcommand};
use export::Format;
use serde_json::json;
use std::path::PathBuf;
use swm_core::limits;
use swm_core::results::{BreakingPoint, StudyResults, Until};
use swm_eval::{Study, StudyFolder};

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
    /// Evaluate the cells of a study that have no results
    ///
    /// A study is a file of tables with the options of `swm eval` (docs/studies.md), or the name of a study of this
    /// program. An interrupted study continues.
    #[command(after_help = "Example: swm study run paper/factors --output factors episodes=20")]
    Run(RunArgs),
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
}

/// Runs `swm study`.
pub fn study(args: &StudyArgs, json: bool, context: impl FnOnce() -> swm_core::Result<Context>) -> anyhow::Result<()> {
    match &args.command {
        StudyCommand::List => list(json),
        StudyCommand::Run(args) => run(args, &context()?),
        StudyCommand::Break(args) => breaking::run(args, &context()?),
        StudyCommand::Status { folder } => {
            let folder = StudyFolder::new(folder);
            show(&folder.study()?.results(&folder)?, json)
        }
        StudyCommand::Report(args) => report::report(args, json),
        StudyCommand::Export { folder, format } => {
            let folder = StudyFolder::new(folder);
            emit(&format.write(&folder.study()?.results(&folder)?));
            Ok(())
        }
    }
}

fn list(json: bool) -> anyhow::Result<()> {
    let studies = shipped::all()?;
    if json {
        let studies =
            studies.iter().map(|(name, file)| json!({"name": name, "title": file.title, "question": file.question}));
        return emit_json(&studies.collect::<Vec<_>>());
    }
    emit(&table(
        &["study", "question"],
        studies.iter().map(|(name, file)| vec![(*name).to_owned(), file.question.clone()]),
    ));
    Ok(())
}

fn run(args: &RunArgs, context: &Context) -> anyhow::Result<()> {
    let (file, origin) = shipped::find(&args.study, args.trust)?;
    let resolver = HomeResolver::new(origin);
    // Settings on the command line are the user's own.
    let own_env = args.settings.iter().find_map(|setting| setting.strip_prefix("env="));
    let resolver = own_env.into_iter().fold(resolver, HomeResolver::with_env);
    if args.commands {
        for arguments in expand::commands(&file, &args.settings, &resolver)? {
            emit(&format!("swm {}\n", expand::shell(&arguments)));
        }
        return Ok(());
    }
    let Some(output) = &args.output else { return Ok(()) };
    let mut study: Study = expand::study(&file, &args.settings, &resolver, &mut control(context))?;
    study.arguments = std::iter::once(shipped::short_name(&args.study)).chain(args.settings.iter().cloned()).collect();
    study = with_rule(study, args.until)?;
    let folder = StudyFolder::new(output);
    let _lock = folder.create(&study)?;
    study.run(&folder, &resolver, &run_options(args.envs, None, context), &mut control(context))?;
    show(&study.results(&folder)?, context.json)
}

/// The study with the rule that ends it, if there is one.
fn with_rule(mut study: Study, until: Option<Until>) -> swm_core::Result<Study> {
    let Some(until) = until else { return Ok(study) };
    study.arguments.extend(["--until".to_owned(), until.to_string()]);
    let study = study.until(until);
    study.check()?;
    Ok(study)
}

/// A column of the table that is shown if its cells differ: its title, and its text in a row.
type OptionalColumn = (&'static str, fn(&swm_core::results::StudyRow) -> String);

/// Prints the results.
fn show(results: &StudyResults, json: bool) -> anyhow::Result<()> {
    if json {
        return emit_json(results);
    }
    emit(&format!("{}: {} of {} cells\n", results.title, results.done, results.cells));
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
    let rows = results.rows.iter().map(|row| {
        let mut cells: Vec<String> = shown.iter().map(|(_, of)| of(row)).collect();
        let gap = row.gap.as_ref().map_or(["–"; 3].map(str::to_owned), compared);
        let floor = format!("{:.0} %", 100.0 * row.floor.rate);
        cells.extend([
            row.condition.clone(),
            row.policy.clone(),
            percent(&row.success),
            row.success.n.to_string(),
            floor,
        ]);
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
