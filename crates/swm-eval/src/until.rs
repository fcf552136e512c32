//! Evaluates in stages until a rule is met: [`EvalRequest::run_until`].
//!
//! A start is the same in all stages and its episode depends on nothing else, so results that grew equal those that were
//! played at once, and an evaluation that was interrupted ends as one that was not.

use crate::reproduce::Checked;
use crate::request::{EvalRequest, PolicyKind, StartsRequest};
use crate::runner::{Episodes, Resolver, RunOptions};
use std::sync::{Mutex, PoisonError};
use swm_core::results::{Counting, Stopping, Until};
use swm_core::run::{Control, Event};
use swm_core::{Error, Result, Results};

/// The number of starts of the first stage.
pub(crate) const FIRST: usize = 10;

/// What is wrong with starts that a rule cannot end.
pub(crate) const SEVERAL_STARTS: &str = "several starts may come from one recorded episode, and the statistics that hold at any number of starts need independent ones";
/// What to do about it.
pub(crate) const ONE_START: &str =
    "take one start from each episode: run it again with this version, in another folder";

/// The numbers of starts of the stages: each has half as many again as the one before, rounded up to tens.
pub(crate) fn stages() -> impl Iterator<Item = usize> {
    std::iter::successors(Some(FIRST), |n| Some((n + n / 2).next_multiple_of(10)))
}

impl EvalRequest {
    /// Evaluates the first starts, then more of them until the results meet the rule or have the episodes of this request.
    /// All runs have the same starts.
    ///
    /// `earlier` are results of this request that were interrupted, and `keep` receives the results of every stage. The
    /// statistics of all results are those of an evaluation that its results end ([`Results::stopped`]). Videos are those of
    /// the first stage.
    ///
    /// # Errors
    /// As [`EvalRequest::run`], when the rule cannot be followed, the dataset has fewer starts than this request, or `earlier`
    /// are results of another request, data or weights.
    pub fn run_until(
        &self,
        until: Until,
        earlier: Option<Results>,
        resolver: &dyn Resolver,
        options: &RunOptions,
        keep: &mut dyn FnMut(&Results) -> Result<()>,
        control: &mut Control<'_>,
    ) -> Result<Results> {
        self.check_rule(until, options)?;
        // What a stage shows would be the interval of a fixed number.
        let outer = Mutex::new(control);
        let lock = || outer.lock().unwrap_or_else(PoisonError::into_inner);
        let mut control = Control::new().with_poll(|| lock().check()).with_events(|event| match event {
            Event::Finished { stage, .. } => lock().emit(Event::Finished { stage, metrics: &[] }),
            event => lock().emit(event),
        });
        let control = &mut control;
        let mut found = earlier.map(|earlier| self.continued(earlier, until)).transpose()?;
        let stages = self.stages();
        loop {
            let episodes = found.as_ref().map_or(0, Results::episodes);
            if let Some(results) = found.take_if(|results| episodes >= self.episodes || is_met(results)) {
                return Ok(results);
            }
            let stage = stages.iter().find(|stage| **stage > episodes).copied().unwrap_or(self.episodes);
            let results = self.run_stage(stage, found.as_ref(), resolver, options, control)?;
            let results = results.stopped(until, self.episodes);
            keep(&results)?;
            found = Some(results);
        }
    }

    /// The numbers of starts after which a rule is applied; the last one is the number of episodes of this request.
    pub fn stages(&self) -> Vec<usize> {
        stages().take_while(|stage| *stage < self.episodes).chain([self.episodes]).collect()
    }

    /// Evaluates the first `episodes` starts; those that `earlier` has, results of the stage before, are not played again.
    /// Videos are those of the first stage. The statistics of the results are those of a fixed number of episodes.
    ///
    /// # Errors
    /// As [`EvalRequest::run`], when the dataset has fewer starts than this request, or `earlier` are results of another
    /// request, data or weights.
    pub fn run_stage(
        &self,
        episodes: usize,
        earlier: Option<&Results>,
        resolver: &dyn Resolver,
        options: &RunOptions,
        control: &mut Control<'_>,
    ) -> Result<Results> {
        if let StartsRequest::Dataset { dataset, .. } = &self.starts {
            self.picks(&*resolver.dataset(dataset)?)?;
        }
        let request = Self { episodes: episodes.min(self.episodes), ..self.clone() };
        let Some(earlier) = earlier else { return request.run_episodes(Episodes::All, resolver, options, control) };
        if !self.is_of(earlier)? {
            let fix = "give the results of the stage before";
            return Err(Error::config("the results to continue", "are those of another request", fix));
        }
        let checked = Checked { resolver, manifest: &earlier.manifest };
        let options = RunOptions { videos: None, ..options.clone() };
        request.run_episodes(Episodes::After(earlier), &checked, &options, control)
    }

    /// Checks that this evaluation can end by the rule.
    ///
    /// # Errors
    /// When the counting allows no more episodes, several starts may come from one recorded episode, there are more videos than
    /// episodes of the first stage, or nothing is compared.
    pub fn check_rule(&self, until: Until, options: &RunOptions) -> Result<()> {
        let invalid = |problem: String, fix: &str| Err(Error::config("--until", problem, fix));
        let videos = options.videos.as_ref().map_or(0, |(_, count)| *count);
        if matches!(self.counting, Counting::Compat { .. }) && self.starts == StartsRequest::Episodic {
            return invalid(
                "compat counting of drawn starts counts the episodes that finish first, so none can follow later"
                    .to_owned(),
                "use strict counting, or take starts from a dataset",
            );
        }
        if self.may_repeat_episodes() {
            return invalid(SEVERAL_STARTS.to_owned(), ONE_START);
        }
        if videos > FIRST {
            let problem = format!("{videos} videos of each run, and the first stage has {FIRST} episodes");
            return invalid(problem, "record at most as many");
        }
        let is_alone = self.policies.iter().all(|policy| policy.kind == PolicyKind::Random);
        if matches!(until, Until::Decided(_)) && is_alone && self.conditions.len() == 1 {
            return invalid(
                "there is one policy under one condition, so nothing to compare".to_owned(),
                "give ci=5, a second policy or a shift",
            );
        }
        Ok(())
    }

    /// Checks that interrupted results are those of this request, and applies the rule to them.
    fn continued(&self, earlier: Results, until: Until) -> Result<Results> {
        let wrong = |problem: String, fix: &str| Err(Error::config("the results to continue", problem, fix));
        let episodes = earlier.episodes();
        if earlier.stopping.is_none() {
            return wrong(
                "have a number of episodes that was fixed in advance".to_owned(),
                "give another folder for results that a rule ends",
            );
        }
        if !self.is_of(&earlier)? || episodes != Self::of(&earlier.manifest)?.episodes {
            return wrong("are those of another request".to_owned(), "give the same options, or another folder");
        }
        if episodes > self.episodes {
            return wrong(format!("have {episodes} episodes"), "ask for at least as many");
        }
        Ok(earlier.stopped(until, self.episodes))
    }
}

fn is_met(results: &Results) -> bool {
    results.stopping.is_some_and(|Stopping { met, .. }| met)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stages_grow_by_half() {
        let found: Vec<usize> = stages().take(12).collect();
        assert_eq!(found, [10, 20, 30, 50, 80, 120, 180, 270, 410, 620, 930, 1400]);
    }
}
