//! `swm study report`: writes one page of a study, with figures and tables beside it.

use super::expand::shell;
use super::export::Format;
use crate::cli::{emit, emit_json, output_folder};
use clap::Args;
use serde_json::json;
use std::path::{Path, PathBuf};
use swm_core::{Error, Result, files};
use swm_eval::{AnyStudy, StudyFolder};
use swm_report::{StudyPage, TablePage};

/// Arguments of `swm study report`.
#[derive(Args)]
pub struct ReportArgs {
    /// The folder of the study
    folder: PathBuf,
    /// Folder of the page (default: the folder `report` in that of the study)
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Title (default: that of the study)
    #[arg(long)]
    title: Option<String>,
}

/// The tables beside the page.
const TABLES: [(&str, Format); 3] =
    [("table.csv", Format::Csv), ("table.tex", Format::Latex), ("table.md", Format::Markdown)];

/// Runs `swm study report`.
pub fn report(args: &ReportArgs, as_json: bool) -> anyhow::Result<()> {
    let folder = StudyFolder::new(&args.folder);
    // Before the folder of the page is made, which may lie in that of the study.
    folder.open()?;
    let output = match &args.output {
        Some(output) => output.clone(),
        None => {
            let own = args.folder.join("report");
            // A downloaded folder does not choose where the page goes.
            files::check_no_link(&own)?;
            own
        }
    };
    let names: Vec<&str> = std::iter::once("index.html").chain(TABLES.map(|(name, _)| name)).collect();
    let _lock = output_folder::claim(&output, &names)?;
    check_figures(&output)?;
    let (tables, path) = write_page(&folder, args.title.clone(), &output)?;
    for (name, text) in tables {
        files::write(&output.join(name), text.as_bytes())?;
    }
    if as_json {
        return emit_json(&json!({"report": path.to_string_lossy()}));
    }
    emit(&format!("{}\n", path.display()));
    Ok(())
}

/// The names and the contents of the tables beside a page.
type Tables = [(&'static str, String); 3];

/// Writes the page of a study and its figures to a folder; returns the tables and the path of the page.
///
/// # Errors
/// When the study or its results are damaged, or writing fails.
pub fn write_page(folder: &StudyFolder, title: Option<String>, output: &Path) -> Result<(Tables, PathBuf)> {
    Ok(match &folder.open()? {
        AnyStudy::Evaluations(study) => {
            let results = study.results(folder)?;
            let tables = TABLES.map(|(name, format)| (name, format.write(&results)));
            let command = command(if study.ray.is_some() { "break" } else { "run" }, &study.arguments);
            let page = StudyPage { results, published: study.published.clone(), title, command };
            (tables, swm_report::write_study(&page, output)?)
        }
        AnyStudy::Table(study) => {
            let results = study.results(folder)?;
            let tables = TABLES.map(|(name, format)| (name, format.write_table(&results)));
            let page = TablePage { results, title, command: command("run", &study.arguments) };
            (tables, swm_report::write_table(&page, output)?)
        }
    })
}

/// The command that runs the study again. It names a folder of its own, so that equal studies have equal pages.
fn command(command: &str, arguments: &[String]) -> Option<String> {
    let name = Path::new(arguments.first()?).file_stem()?.to_str()?;
    let words = ["swm", "study", command].into_iter().map(str::to_owned);
    let output = ["--output".to_owned(), name.to_owned()];
    Some(shell(&words.chain(arguments.iter().cloned()).chain(output).collect::<Vec<_>>()))
}

/// Checks that the folder of figures does not exist, or lies beside a page of this program.
fn check_figures(output: &Path) -> Result<()> {
    let figures = output.join("figures");
    files::check_no_link(&figures)?;
    if !figures.exists() || output.join("index.html").exists() {
        return Ok(());
    }
    let fix = "give another folder with --output";
    Err(Error::config(figures.display().to_string(), "exists and was not written by this program", fix))
}
