//! The pages of results and studies in the lab: those of `swm report` and `swm study report`.

use crate::cli::study;
use crate::cli::training_curves::of_results;
use std::path::Path;
use swm_core::{Error, Result};
use swm_eval::{AnyStudy, StudyFolder};
use swm_lab::reports::{Kind, Reports, Summary};
use swm_report::ReportOptions;

/// Runs of results that a list shows.
const MOST_LINES: usize = 8;

/// Makes the pages of the command line.
pub struct Pages;

impl Reports for Pages {
    fn summary(&self, kind: Kind, folder: &Path) -> Result<Summary> {
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
            let rate = 100.0 * run.success.rate;
            let condition = if run.condition == "in distribution" { "" } else { run.condition.as_str() };
            format!("{}: {rate:.0} % of {} {condition}", run.policy, run.episodes.len()).trim_end().to_owned()
        });
        Ok(Summary { title: results.env.clone(), lines: runs.collect() })
    }

    fn page(&self, kind: Kind, folder: &Path) -> Result<String> {
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
