//! Evaluates a study in stages until its rule is met.
//!
//! After stage k, every cell that is not met has the first n(k) of its starts: 10, 20, 30, 50, 80, 120 and so on, half as
//! many again. A start is the same in all stages and its episode depends on nothing else, so the files of a study that was
//! interrupted are those of one that was not, and a cell that grew is equal to one that was evaluated at once.

use super::cell::{Cell, Study};
use super::folder::StudyFolder;
use super::run::Work;
use crate::request::StartsRequest;
use crate::runner::{Resolver, RunOptions};
use crate::until::stages;
use std::collections::BTreeSet;
use swm_core::results::{Run, Timing, Until};
use swm_core::run::Control;
use swm_core::{Result, Results};

impl Study {
    /// The numbers of starts after which a rule is applied; the last one is the largest number of episodes of a cell. A cell with
    /// fewer episodes plays all of them.
    pub fn stages(&self) -> Vec<usize> {
        let most = self.cells.iter().map(|cell| cell.request.episodes).max().unwrap_or_default();
        stages().take_while(|stage| *stage < most).chain([most]).collect()
    }

    /// Evaluates the first starts of all cells, then more starts of those that the rule leaves open, up to the episodes of
    /// their requests. Returns the number of cells that were evaluated further.
    pub(super) fn run_until(
        &self,
        until: Until,
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<usize> {
        self.check_starts(resolver)?;
        let mut evaluated = BTreeSet::new();
        let mut open: BTreeSet<String> = self.cells.iter().map(Cell::id).collect::<Result<_>>()?;
        for stage in self.stages() {
            let mut work: Vec<Work<'_>> = vec![];
            for cell in &self.cells {
                let id = cell.id()?;
                if !open.contains(&id) {
                    continue;
                }
                let (earlier, wanted) = (folder.results(cell)?, stage.min(cell.request.episodes));
                if earlier.as_ref().map_or(0, Results::episodes) < wanted {
                    work.push((cell, earlier, wanted));
                    evaluated.insert(id);
                }
            }
            if !work.is_empty() {
                self.evaluate(&work, folder, resolver, options, control)?;
            }
            open = self.open_after(until, folder, stage)?;
            if open.is_empty() {
                break;
            }
        }
        Ok(evaluated.len())
    }

    /// The ids of the cells that need more starts than those of a stage. What later stages added does not matter, so a study that
    /// continues decides as it did before. Cells without results count as not done.
    ///
    /// # Errors
    /// When results are damaged.
    pub fn open_after(&self, until: Until, folder: &StudyFolder, stage: usize) -> Result<BTreeSet<String>> {
        let mut done = vec![];
        for cell in &self.cells {
            if let Some(results) = folder.results(cell)? {
                done.push((cell, first(results, stage)));
            }
        }
        let rows = self.tabulate(&done)?.rows;
        Ok(self.open(until, &rows, &done))
    }

    /// Checks that datasets have as many starts as the requests have episodes, before the first episode is played.
    ///
    /// # Errors
    /// When one has fewer, or cannot be read.
    pub fn check_starts(&self, resolver: &dyn Resolver) -> Result<()> {
        let mut checked: Vec<(&StartsRequest, u64, usize)> = vec![];
        for Cell { request, .. } in &self.cells {
            let starts = (&request.starts, request.seed, request.episodes);
            if let StartsRequest::Dataset { dataset, .. } = &request.starts
                && !checked.contains(&starts)
            {
                request.picks(&*resolver.dataset(dataset)?)?;
                checked.push(starts);
            }
        }
        Ok(())
    }
}

/// Results of the first `n` episodes.
fn first(mut results: Results, n: usize) -> Results {
    for run in &mut results.runs {
        if run.episodes.len() > n {
            let episodes = run.episodes[..n].to_vec();
            *run = Run::new(&run.condition, &run.policy, results.counting, episodes, Timing::default());
        }
    }
    results
}
