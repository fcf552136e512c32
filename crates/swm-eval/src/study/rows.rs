//! The rows of a study's table.

use super::cell::{Cell, Study};
use super::folder::StudyFolder;
use std::collections::BTreeMap;
use swm_core::results::{Paired, Proportion, Run, StudyResults, StudyRow};
use swm_core::{Result, Results};

impl Study {
    /// Returns the outcomes of all cells that are done.
    ///
    /// # Errors
    /// When results are damaged.
    pub fn results(&self, folder: &StudyFolder) -> Result<StudyResults> {
        let mut done: Vec<(&Cell, Results)> = vec![];
        for cell in &self.cells {
            if let Some(results) = folder.results(cell)? {
                done.push((cell, results));
            }
        }
        let unshifted = self.cells.first().map_or("", Cell::condition);
        let of_unshifted = done.iter().filter(|(cell, _)| cell.condition() == unshifted);
        let unshifted_runs: BTreeMap<String, Option<&Run>> =
            of_unshifted.map(|(cell, results)| (key(cell), runs(cell, results).map(|(run, _)| run))).collect();
        let mut rows = vec![];
        for (cell, results) in &done {
            let Some((run, floor)) = runs(cell, results) else { continue };
            let reference = unshifted_runs.get(&key(cell)).copied().flatten();
            let reference = reference.filter(|_| cell.condition() != unshifted);
            rows.push(StudyRow {
                cell: cell.id()?,
                starts: cell.starts.clone(),
                condition: cell.condition().to_owned(),
                variables: cell.variables.clone(),
                policy: cell.policy().to_owned(),
                counting: results.counting,
                seed: cell.request.seed,
                success: run.success,
                solved_at_start: run.solved_at_start,
                floor,
                gap: reference.and_then(|reference| Paired::of_runs(run, reference, results.counting)),
            });
        }
        Ok(StudyResults {
            title: self.title.clone(),
            question: self.question.clone(),
            hash: self.hash()?,
            cells: self.cells.len(),
            done: done.len(),
            rows,
        })
    }
}

/// The run of the cell's policy, and the success rate of the random-policy floor.
fn runs<'a>(cell: &Cell, results: &'a Results) -> Option<(&'a Run, Proportion)> {
    let run = |name: &str| results.runs.iter().find(|run| run.policy == name);
    let floor = results.runs.first()?.success;
    Some((run(cell.policy())?, floor))
}

/// What cells that differ in the condition only have in common.
fn key(cell: &Cell) -> String {
    let request = &cell.request;
    format!("{:?}", (&cell.starts, cell.policy(), request.seed, request.episodes, request.budget, request.counting))
}
