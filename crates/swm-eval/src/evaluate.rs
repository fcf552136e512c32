//! Evaluation: the success rate and the time to goal of a policy from given starts.
//!
//! [`Counting`] defines the episodes that count and the success criterion. Strict counting, the default, does not play
//! a start that is solved right after the reset and counts it separately from the success rate, which has a 95 % Wilson
//! confidence interval.
//!
//! An evaluation under a shift is an evaluation whose starts sample or pin factors of variation.

use crate::played::PlayedRecording;
use crate::starts::Starts;
use crate::success_criterion::{StepOutcome, SuccessCriterion};
use crate::video_recording::{VideoRecording, Videos};
use crate::world::{Play, World};
use serde::Serialize;
use std::time::Instant;
use swm_core::results::{Counting, EpisodeResult, Proportion, Run, Summary, Timing};
use swm_core::run::{Control, Progress};
use swm_core::{Batch, ColumnIndices, EnvPool, Error, Key, Policy, Result};

/// Settings of an evaluation.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct EvalConfig {
    /// The name of the policy: `random`, `expert`, or a checkpoint's name.
    pub policy: String,
    /// The condition: `in distribution`, or a description of the shift.
    pub condition: String,
    /// The time limit of an episode, in steps; `None` for the world's time limit.
    pub budget: Option<usize>,
    /// The episodes that count, and the success criterion.
    pub counting: Counting,
    /// Repeats the policy's draws with another stream; `None` for the stream of the starts' seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub planning_seed: Option<u64>,
    /// Videos of the first episodes, if any.
    #[serde(skip)]
    pub videos: Option<Videos>,
}

impl World {
    /// Plays every start once. A free slot takes the next start; the result of an episode depends only on its start.
    ///
    /// Compat counting of episodic starts continues beyond the last start, until the number of finished episodes equals
    /// the number of starts, as in the reference implementation.
    ///
    /// # Errors
    /// When the budget exceeds the world's time limit, the counting is invalid for the budget or the world, videos are
    /// requested of a world without frames, the policy or an environment fails, or the run is stopped.
    pub fn evaluate(
        &mut self,
        policy: &mut dyn Policy,
        starts: &Starts,
        config: &EvalConfig,
        control: &mut Control<'_>,
    ) -> Result<Run> {
        self.evaluate_recorded(policy, starts, config, None, control)
    }

    /// As [`World::evaluate`]; also keeps the first steps of every episode, if `played` is given.
    pub(crate) fn evaluate_recorded(
        &mut self,
        policy: &mut dyn Policy,
        starts: &Starts,
        config: &EvalConfig,
        played: Option<&mut PlayedRecording>,
        control: &mut Control<'_>,
    ) -> Result<Run> {
        let limit = self.pool().max_episode_steps();
        let budget = config.budget.unwrap_or(limit);
        if budget == 0 || budget > limit {
            return Err(Error::config(
                "evaluation budget",
                format!("{budget} steps in a world that truncates episodes after {limit}"),
                "choose at least 1 and at most the time limit, or raise the world's max_episode_steps",
            ));
        }
        let episodic = starts.goal_offset().is_none();
        check_counting(config.counting, budget, episodic.then_some(self.pool().len()))?;
        let videos =
            config.videos.as_ref().map(|videos| VideoRecording::new(videos, self.pool(), starts.len())).transpose()?;
        let mut evaluation = Evaluation {
            starts,
            planning_seed: config.planning_seed,
            first_to_finish: episodic && matches!(config.counting, Counting::Compat { .. }),
            columns: ColumnIndices::of(self.pool().infos().schema())?,
            slots: vec![(0, SuccessCriterion::new(config.counting, budget)); self.pool().len()],
            episodes: vec![],
            finished: vec![],
            satisfied: 0,
            steps: 0,
            videos,
            played,
        };
        policy.take_latencies();
        let begun = Instant::now();
        self.play(policy, &mut evaluation, control)?;
        let timing =
            Timing { plan_seconds: Summary::of(&policy.take_latencies()), wall_seconds: begun.elapsed().as_secs_f64() };
        let Evaluation { mut episodes, mut finished, satisfied, videos, .. } = evaluation;
        finished.sort_unstable();
        let videos = videos.map(|videos| videos.write(&finished)).unwrap_or_default();
        let episodes: Vec<EpisodeResult> = finished.iter().map(|&i| std::mem::take(&mut episodes[i])).collect();
        let run = Run::new(&config.condition, &config.policy, config.counting, episodes, timing);
        // Episodic compat counting selects episodes that strict counting would not have selected.
        let has_strict_rate = matches!(config.counting, Counting::Compat { .. }) && !episodic;
        let strict = has_strict_rate.then(|| Proportion::wilson(satisfied, run.episodes.len() - run.solved_at_start));
        Ok(Run { strict, videos, ..run })
    }
}

/// Rejects a counting that is invalid for the budget or the world. `slots`, the number of environments of the world, is
/// given for episodic evaluations.
fn check_counting(counting: Counting, budget: usize, slots: Option<usize>) -> Result<()> {
    match (counting, slots) {
        (Counting::Strict { hold }, _) if hold == 0 || hold > budget => Err(Error::config(
            "steps to hold the goal",
            format!("{hold} in a budget of {budget} steps"),
            "choose at least 1 and at most the budget",
        )),
        (Counting::Compat { envs }, Some(slots)) if envs != slots => Err(Error::config(
            "compat counting",
            format!("it counts the first episodes to finish among {envs} environments, and the world has {slots}"),
            "give the world as many environments, or use strict counting, which accepts any number",
        )),
        _ => Ok(()),
    }
}

/// An evaluation in progress.
struct Evaluation<'a> {
    starts: &'a Starts,
    planning_seed: Option<u64>,
    /// Whether episodes start until enough episodes have finished, instead of one episode for each start.
    first_to_finish: bool,
    columns: ColumnIndices,
    /// The episode and the success criterion of each slot.
    slots: Vec<(usize, SuccessCriterion)>,
    /// Every started episode.
    episodes: Vec<EpisodeResult>,
    /// The indices of the finished episodes, in the order in which the episodes finished.
    finished: Vec<usize>,
    /// The number of episodes that were not solved at the start and whose goal was satisfied at some step.
    satisfied: usize,
    steps: usize,
    videos: Option<VideoRecording>,
    played: Option<&'a mut PlayedRecording>,
}

impl Evaluation<'_> {
    fn finish(&mut self, slot: usize, control: &mut Control<'_>) {
        let (episode, criterion) = self.slots[slot];
        self.finished.push(episode);
        self.satisfied += usize::from(criterion.satisfied() && !self.episodes[episode].solved_at_start);
        control.progress(Progress {
            stage: "evaluate",
            done: self.finished.len(),
            total: self.starts.len(),
            unit: "episodes",
            metrics: &[("steps", self.steps as f64)],
        });
    }

    fn record_frame(&mut self, slot: usize, pool: &EnvPool) {
        if let Some(videos) = &mut self.videos {
            videos.push(self.slots[slot].0, slot, pool);
        }
    }
}

impl Play for Evaluation<'_> {
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
        let key = self.starts.key(episode);
        self.planning_seed.map_or(key, |seed| key.with("planning seed").at(seed))
    }

    fn start(&mut self, pool: &mut EnvPool, starting: &[(usize, usize)]) -> Result<()> {
        for &(slot, episode) in starting {
            self.slots[slot].0 = episode;
            self.slots[slot].1.reset();
        }
        self.starts.start(pool, starting)
    }

    fn started(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        self.record_frame(slot, pool);
        let solved = pool.infos().row(slot).at::<u8>(self.columns.success)[0] != 0;
        let (episode, criterion) = self.slots[slot];
        self.episodes[episode].solved_at_start = solved;
        let plays = criterion.plays(solved);
        if !plays {
            self.finish(slot, control);
        } else if let Some(played) = &mut self.played {
            played.start(episode, slot, pool);
        }
        Ok(plays)
    }

    fn acted(&mut self, slot: usize, _: &EnvPool, actions: &Batch) {
        if let Some(played) = &mut self.played {
            played.act(self.slots[slot].0, slot, actions);
        }
    }

    fn stepped(&mut self, slot: usize, pool: &EnvPool, control: &mut Control<'_>) -> Result<bool> {
        // Lower slots may have finished the evaluation in this step.
        if self.over() {
            return Ok(false);
        }
        self.record_frame(slot, pool);
        if let Some(played) = &mut self.played {
            played.step(self.slots[slot].0, slot, pool);
        }
        self.steps += 1;
        let row = pool.infos().row(slot);
        let flag = |column| row.at::<u8>(column)[0] != 0;
        let outcome = StepOutcome {
            reward: row.at::<f32>(self.columns.reward)[0],
            success: flag(self.columns.success),
            terminated: flag(self.columns.terminated),
            truncated: flag(self.columns.truncated),
        };
        let (episode, criterion) = &mut self.slots[slot];
        let continues = criterion.step(&mut self.episodes[*episode], outcome);
        if !continues {
            self.finish(slot, control);
        }
        Ok(continues)
    }
}
