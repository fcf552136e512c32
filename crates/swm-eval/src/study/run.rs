//! Runs the cells of a study that have no results.

use super::cell::Study;
use super::folder::StudyFolder;
use crate::runner::{Resolver, RunOptions};
use std::sync::{Mutex, PoisonError};
use swm_core::Result;
use swm_core::run::{Control, Event, Progress, Stage};

/// The name of the stage.
const STAGE: &str = "study";

impl Study {
    /// Evaluates the cells that have no results in the folder, in order, and stores each when it is done. Returns the
    /// number of evaluated cells.
    ///
    /// The stage is `study`, its unit an episode of the policies; the random-policy floor is not counted.
    ///
    /// # Errors
    /// As [`EvalRequest::run`](crate::EvalRequest::run) and [`StudyFolder::store`]. Cells that are done stay stored.
    pub fn run(
        &self,
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<usize> {
        let mut missing = vec![];
        for cell in &self.cells {
            if folder.results(cell)?.is_none() {
                missing.push(cell);
            }
        }
        let total = missing.iter().map(|cell| cell.request.episodes).sum();
        control.emit(Event::Started(Stage { name: STAGE, subject: &[&self.title], total, unit: "episodes" }));
        let mut done = 0;
        for cell in &missing {
            control.check()?;
            let outer = Mutex::new(&mut *control);
            let lock = || outer.lock().unwrap_or_else(PoisonError::into_inner);
            let mut is_policy = false;
            let mut inner = Control::new().with_poll(|| lock().check()).with_events(|event| match event {
                Event::Started(stage) => is_policy = stage.subject.first() == Some(&cell.policy()),
                Event::Progress(progress) if is_policy => {
                    lock().progress(Progress { stage: STAGE, done: done + progress.done, total, ..progress });
                }
                Event::Log(line) => lock().emit(Event::Log(line)),
                _ => {}
            });
            let results = cell.request.run(resolver, options, &mut inner)?;
            drop(inner);
            folder.store(cell, results)?;
            done += cell.request.episodes;
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[("cells", missing.len() as f64)] });
        Ok(missing.len())
    }
}
