//! Runs the cells of a study that have no results.

use super::cell::{Cell, Study};
use super::folder::StudyFolder;
use crate::request::EvalRequest;
use crate::runner::{Episodes, Resolver, RunOptions};
use std::sync::{Mutex, PoisonError};
use swm_core::run::{Control, Event, Progress, Stage};
use swm_core::{Error, Result, Results};

/// The name of the stage.
const STAGE: &str = "study";

/// A cell to evaluate, its results so far, and the number of its episodes then.
pub(super) type Work<'a> = (&'a Cell, Option<Results>, usize);

impl Study {
    /// Evaluates the cells that have no results in the folder, in order, and stores each when it is done; in stages, if a rule
    /// ends the study. Then measures how much the conditions change the first frames. Returns the number of evaluated cells.
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
        if let Some(until) = self.until {
            let evaluated = self.run_until(until, folder, resolver, options, control)?;
            self.measure_distances(folder, resolver, options, control)?;
            return Ok(evaluated);
        }
        let mut missing: Vec<Work<'_>> = vec![];
        for cell in &self.cells {
            if folder.results(cell)?.is_none() {
                missing.push((cell, None, cell.request.episodes));
            }
        }
        self.evaluate(&missing, folder, resolver, options, control)?;
        self.measure_distances(folder, resolver, options, control)?;
        Ok(missing.len())
    }

    /// Evaluates the cell with this id: its first `episodes` starts, or all of them, except those whose results the folder has.
    /// Several machines evaluate the cells of a study in this way.
    ///
    /// # Errors
    /// When there is no such cell, or as [`Study::run`].
    pub fn run_cell(
        &self,
        id: &str,
        episodes: Option<usize>,
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<()> {
        for cell in &self.cells {
            if cell.id()? == id {
                let (earlier, most) = (folder.results(cell)?, cell.request.episodes);
                let wanted = episodes.map_or(most, |episodes| episodes.min(most));
                if earlier.as_ref().map_or(0, Results::episodes) >= wanted {
                    return Ok(());
                }
                return self.evaluate(&[(cell, earlier, wanted)], folder, resolver, options, control);
            }
        }
        Err(Error::config(format!("--cell {id}"), "the study has no such cell", "give the id of one of its cells"))
    }

    /// Evaluates cells in order, and stores each when it is done.
    pub(super) fn evaluate(
        &self,
        work: &[Work<'_>],
        folder: &StudyFolder,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<()> {
        let played = |earlier: &Option<Results>| earlier.as_ref().map_or(0, Results::episodes);
        let total = work.iter().map(|(_, earlier, episodes)| episodes - played(earlier)).sum();
        control.emit(Event::Started(Stage { name: STAGE, subject: &[&self.title], total, unit: "episodes" }));
        let mut done = 0;
        for (cell, earlier, episodes) in work {
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
            let request = EvalRequest { episodes: *episodes, ..cell.request.clone() };
            let episodes_to_play = earlier.as_ref().map_or(Episodes::All, Episodes::After);
            let results = request.run_episodes(episodes_to_play, resolver, options, &mut inner)?;
            drop(inner);
            folder.store(cell, results)?;
            done += episodes - played(earlier);
        }
        control.emit(Event::Finished { stage: STAGE, metrics: &[("cells", work.len() as f64)] });
        Ok(())
    }
}
