//! Evaluating: how often a policy reaches the goal from given starts, and how long it takes.
//!
//! What counts is [`Counting`]'s business, and [`judge`](crate::judge) applies it. Strict counting, the default, finds
//! a start that already satisfies the goal right after the reset, does not play it, and counts it apart from the success
//! rate, which comes with its 95 % Wilson interval.
//!
//! A factor-shifted evaluation is the same with starts whose variation request samples or pins factors.

use crate::Starts;
use crate::filming::{Filming, Videos};
use crate::judge::{Judge, Seen};
use crate::world::{Play, World};
use serde::Serialize;
use std::time::Instant;
use swm_core::results::{Counting, EpisodeResult, Proportion, Run, Summary, Timing};
use swm_core::run::{Control, Progress};
use swm_core::{Batch, ColumnIndices, EnvPool, Error, Key, Policy, Result};

/// How to evaluate.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EvalConfig {
    /// Who acts: `random`, `expert`, or a checkpoint's name.
    pub policy: String,
    /// The condition: `in distribution`, or what is shifted.
    pub condition: String,
    /// Steps an episode may take; all the world allows for `None`.
    pub budget: Option<usize>,
    /// Which episodes count, and as what.
    pub counting: Counting,
    /// Videos of the first episodes, if wanted.
    #[serde(skip)]
    pub videos: Option<Videos>,
}

impl World {
    /// Plays every start once and judges it. Each slot takes the next start when it is free; what an episode
    /// brings depends on the start alone.
    ///
    /// Compat counting of episodic starts goes on beyond the last start until as many episodes as there are starts have
    /// finished, as the implementation it follows does.
    ///
    /// # Errors
    /// When the budget exceeds what the world plays, the counting contradicts itself or the world, videos are wanted of a
    /// world without pictures, the policy or an environment fails, or the run is stopped.
    pub fn evaluate(
        &mut self,
        policy: &mut dyn Policy,
        starts: &Starts,
        config: &EvalConfig,
        control: &mut Control<'_>,
    ) -> Result<Run> {
        let limit = self.pool().max_episode_steps();
        let budget = config.budget.unwrap_or(limit);
        if budget == 0 || budget > limit {
            return Err(Error::config(
                "evaluation budget",
                format!("{budget} steps in a world that truncates episodes after {limit}"),
                "choose at least 1 and at most that, or raise the world's max_episode_steps",
            ));
        }
        let episodic = starts.goal_offset().is_none();
        check_counting(config.counting, budget, episodic.then_some(self.pool().len()))?;
        let videos =
            config.videos.as_ref().map(|videos| Filming::new(videos, self.pool(), starts.len())).transpose()?;
        let mut judging = Judging {
            starts,
            first_to_finish: episodic && matches!(config.counting, Counting::Compat { .. }),
            columns: ColumnIndices::of(self.pool().infos().schema())?,
            slots: vec![(0, Judge::new(config.counting, budget)); self.pool().len()],
            episodes: vec![],
            finished: vec![],
            satisfied: 0,
            steps: 0,
            videos,
        };
        policy.take_latencies();
        let begun = Instant::now();
        self.play(policy, &mut judging, control)?;
        let timing =
            Timing { plan_seconds: Summary::of(&policy.take_latencies()), wall_seconds: begun.elapsed().as_secs_f64() };
        let Judging { mut episodes, mut finished, satisfied, videos, .. } = judging;
        finished.sort_unstable();
        let videos = videos.map(|videos| videos.write(&finished)).unwrap_or_default();
        let episodes: Vec<EpisodeResult> = finished.iter().map(|&i| std::mem::take(&mut episodes[i])).collect();
        let run = Run::new(&config.condition, &config.policy, config.counting, episodes, timing);
        // Episodic compat counts a selection that strict counting would not have made.
        let both = matches!(config.counting, Counting::Compat { .. }) && !episodic;
        let strict = both.then(|| Proportion::wilson(satisfied, run.episodes.len() - run.solved_at_start));
        Ok(Run { strict, videos, ..run })
    }
}

/// Refuses a counting that contradicts itself, the budget, or the world; `slots` are those of an episodic evaluation.
fn check_counting(counting: Counting, budget: usize, slots: Option<usize>) -> Result<()> {
    match (counting, slots) {
        (Counting::Strict { hold }, _) if hold == 0 || hold > budget => Err(Error::config(
            "steps to hold the goal",
            format!("{hold} in a budget of {budget} steps"),
            "choose at least 1 and at most the budget",
        )),
        (Counting::Compat { envs }, Some(slots)) if envs != slots => Err(Error::config(
            "compat counting",
            format!("it counts the first to finish among {envs} environments, and the world has {slots}"),
            "give the world as many, or count strictly, which depends on no such number",
        )),
        _ => Ok(()),
    }
}

struct Judging<'a> {
    starts: &'a Starts,
    /// Whether episodes begin until enough have finished, instead of one a start.
    first_to_finish: bool,
    columns: ColumnIndices,
    /// The episode each slot plays, and its judge.
    slots: Vec<(usize, Judge)>,
    /// Every episode begun.
    episodes: Vec<EpisodeResult>,
    /// Those that are done, as they finished.
    finished: Vec<usize>,
    /// Episodes with an unsolved start and a step that satisfied the goal.
    satisfied: usize,
    steps: usize,
    videos: Option<Filming>,
}

impl Judging<'_> {
    fn finish(&mut self, slot: usize, control: &mut Control<'_>) {
        let (episode, judge) = self.slots[slot];
        self.finished.push(episode);
        self.satisfied += usize::from(judge.satisfied() && !self.episodes[episode].solved_at_start);
        control.progress(Progress {
            stage: "evaluate",
            done: self.finished.len(),
            total: self.starts.len(),
            unit: "episodes",
            metrics: &[("steps", self.steps as f64)],
        });
    }

    fn film(&mut self, slot: usize, pool: &EnvPool) {
        if let Some(videos) = &mut self.videos {
            videos.frame(self.slots[slot].0, slot, pool);
        }
    }
}

impl Play for Judging<'_> {
    fn next(&mut self) -> Option<usize> {
        if !self.more() {
            return None;
        }
        let episode = self.episodes.len();
        let start = self.starts.pick(episode);
        self.episodes.push(EpisodeResult { start, ..EpisodeResult::new(self.starts.reset_seed(episode)) });
        Some(episode)
    }

    fn more(&self) -> bool {
        let so_far = if self.first_to_finish { self.finished.len() } else { self.episodes.len() };
        so_far < self.starts.len()
    }

    fn over(&self) -> bool {
        self.finished.len() == self.starts.len()
    }

    fn key(&self, episode: usize) -> Key {
        self.starts.key(episode)
    }

    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        for &(slot, episode) in starting {
            self.slots[slot].0 = episode;
            self.slots[slot].1.begin();
        }
        self.starts.start(pool, starting)
    }

    fn started(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        self.film(slot, pool);
        let solved = pool.infos().row(slot).at::<u8>(self.columns.success)[0] != 0;
        let (episode, judge) = self.slots[slot];
        self.episodes[episode].solved_at_start = solved;
        let plays = judge.plays(solved);
        if !plays {
            self.finish(slot, control);
        }
        Ok(plays)
    }

    fn acted(&mut self, _: usize, _: &EnvPool, _: &Batch) {}

    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        // Enough have finished, in this very step and in slots before this one.
        if self.over() {
            return Ok(false);
        }
        self.film(slot, pool);
        self.steps += 1;
        let row = pool.infos().row(slot);
        let flag = |place| row.at::<u8>(place)[0] != 0;
        let seen = Seen {
            reward: row.at::<f32>(self.columns.reward)[0],
            success: flag(self.columns.success),
            terminated: flag(self.columns.terminated),
            truncated: flag(self.columns.truncated),
        };
        let (episode, judge) = &mut self.slots[slot];
        let goes_on = judge.step(&mut self.episodes[*episode], seen);
        if !goes_on {
            self.finish(slot, control);
        }
        Ok(goes_on)
    }
}
