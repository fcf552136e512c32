//! The pages of results, studies and autopsies in the lab: those of `swm report`, `swm study report` and `swm autopsy`.

use crate::cli::study;
use crate::cli::training_curves::of_results;
use serde::Deserialize;
use std::path::Path;
use swm_core::results::Autopsy;
use swm_core::{Error, Result, files};
use swm_eval::{AnyStudy, StudyFolder};
use swm_lab::reports::{Kind, Reports, Summary};
use swm_report::ReportOptions;

/// The largest page of an autopsy that is shown, in bytes.
const MOST_BYTES: u64 = 64 << 20;
/// Runs of results that a list shows.
const MOST_LINES: usize = 8;

/// Makes the pages of the command line.
pub struct Pages;

/// What a list shows of an `autopsy.json`.
#[derive(Deserialize)]
struct FoundAutopsy {
    model: String,
    env: String,
    autopsy: Autopsy,
}

/// Summarises an autopsy.
fn autopsy(file: &Path) -> Result<Summary> {
    let damaged = |error| Error::corrupt(file, format!("is not an autopsy ({error})"), "run the autopsy again");
    let found: FoundAutopsy = serde_json::from_slice(&files::read(file, MOST_BYTES)?).map_err(damaged)?;
    let failures = format!("{} of {} starts fail", found.autopsy.repairs.len(), found.autopsy.starts);
    let title = format!("{} in {}", found.model, found.env);
    Ok(Summary { title, lines: vec![failures, found.autopsy.finding.to_string()] })
}

impl Reports for Pages {
    fn summary(&self, kind: Kind, folder: &Path) -> Result<Summary> {
        if kind == Kind::Autopsy {
            return autopsy(&folder.join(kind.file()));
        }
        if kind == Kind::Study {
            let (found, cells) = (StudyFolder::new(folder).open()?, folder.join("cells"));
            let (title, count) = match &found {
                AnyStudy::Evaluations(study) => (study.title.clone(), study.cells.len()),
                AnyStudy::Table(study) => (study.title.clone(), study.cells.len()),
            };
            let entries = std::fs::read_dir(cells).into_iter().flatten().flatten();
            let done = entries.filter(|entry| entry.path().extension().is_some_and(|end| end == "json")).count();
            return Ok(Summary { title, lines: vec![format!("{} of {count} cells", done.min(count))] });
        }
        let results = swm_report::read_results(&folder.join(kind.file()))?;
        let runs = results.runs.iter().take(MOST_LINES).map(|run| {
            let rate = if run.success.n == 0 { "–".to_owned() } else { format!("{:.0} %", 100.0 * run.success.rate) };
            let condition = if run.condition == "in distribution" { "" } else { run.condition.as_str() };
            format!("{}: {rate} of {} {condition}", run.policy, run.episodes.len()).trim_end().to_owned()
        });
        Ok(Summary { title: results.env.clone(), lines: runs.collect() })
    }

    fn page(&self, kind: Kind, folder: &Path) -> Result<String> {
        if kind == Kind::Autopsy {
            // Its frames were rendered when it was made: the page is the stored one.
            let page = folder.join("index.html");
            let damaged = |error| Error::corrupt(&page, format!("is no text ({error})"), "run the autopsy again");
            return String::from_utf8(files::read(&page, MOST_BYTES)?).map_err(damaged);
        }
        if kind == Kind::Study {
            // The page of a study has files of figures beside it, which a page in the lab does not show.
            let scratch = tempfile::tempdir().map_err(|error| Error::external("making a folder for a page", error))?;
            let (_, page) = study::write_page(&StudyFolder::new(folder), None, scratch.path())?;
            return std::fs::read_to_string(&page).map_err(|error| Error::io(page, "reading a page", error));
        }
        let file = folder.join(kind.file());
        let read = vec![(file.clone(), swm_report::read_results(&file)?)];
        if read[0].1.sequential {
            let problem = "its study ran with --until, so the intervals for a fixed number of episodes do not hold";
            return Err(Error::config(file.display().to_string(), problem, "show the study"));
        }
        swm_report::render(&read, &ReportOptions { training: of_results(&read), ..ReportOptions::default() })
    }
}
