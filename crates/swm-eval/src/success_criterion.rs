//! [`SuccessCriterion`]: decides step by step whether an episode succeeds and when it ends.

use swm_core::results::{Counting, EpisodeResult};

/// The outcome of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct StepOutcome {
    /// The reward.
    pub reward: f32,
    /// Whether the observation satisfies the goal.
    pub success: bool,
    /// Whether the environment reached a terminal state.
    pub terminated: bool,
    /// Whether the time limit ended the episode.
    pub truncated: bool,
}

/// The success criterion of a slot, with the state of its present episode.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SuccessCriterion {
    counting: Counting,
    /// The time limit of an episode, in steps.
    budget: usize,
    /// The number of consecutive steps that satisfied the goal, up to the last step.
    held: usize,
    /// Whether any step satisfied the goal.
    satisfied: bool,
}

impl SuccessCriterion {
    /// The criterion of a counting, before the first step of an episode.
    pub fn new(counting: Counting, budget: usize) -> Self {
        Self { counting, budget, held: 0, satisfied: false }
    }

    /// Starts a new episode.
    pub fn reset(&mut self) {
        *self = Self::new(self.counting, self.budget);
    }

    /// Whether an episode is played, given whether it is solved at the start.
    pub fn plays(&self, solved_at_start: bool) -> bool {
        matches!(self.counting, Counting::Compat { .. }) || !solved_at_start
    }

    /// Whether strict counting with a hold of 1 counts the episode as a success. Strict counting ends an episode no
    /// later than compat counting, so one run gives both results.
    pub fn satisfied(&self) -> bool {
        self.satisfied
    }

    /// Adds a step to `episode`; returns whether the episode continues.
    pub fn step(&mut self, episode: &mut EpisodeResult, outcome: StepOutcome) -> bool {
        episode.steps += 1;
        episode.total_reward += f64::from(outcome.reward);
        self.satisfied |= outcome.success;
        let failed = match self.counting {
            Counting::Strict { hold } => {
                self.held = if outcome.success { self.held + 1 } else { 0 };
                episode.success = self.held >= hold;
                if episode.success && hold > 1 {
                    episode.reached = Some(episode.steps + 1 - hold);
                }
                // An environment that terminates at its goal continues while the goal has to be held.
                outcome.terminated && !outcome.success
            }
            Counting::Compat { .. } => {
                episode.success = outcome.terminated;
                false
            }
        };
        !(episode.success || failed || outcome.truncated || episode.steps >= self.budget)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Plays steps, one letter each: `.` nothing, `s` goal satisfied, `g` satisfied and terminated, `f` terminated
    /// without success, `c` the time limit. Returns the success, the steps played, and the time to goal.
    fn result_of(counting: Counting, budget: usize, steps: &str) -> (bool, usize, Option<usize>) {
        let mut criterion = SuccessCriterion::new(counting, budget);
        let mut episode = EpisodeResult::default();
        for step in steps.chars() {
            let outcome = StepOutcome {
                reward: 1.0,
                success: "sg".contains(step),
                terminated: "gf".contains(step),
                truncated: step == 'c',
            };
            if !criterion.step(&mut episode, outcome) {
                break;
            }
        }
        assert_eq!(episode.total_reward, episode.steps as f64);
        (episode.success, episode.steps, episode.time_to_goal())
    }

    #[test]
    fn strict_counting_succeeds_at_the_first_step_that_satisfies_the_goal() {
        let strict = Counting::Strict { hold: 1 };
        assert_eq!(result_of(strict, 9, "..g"), (true, 3, Some(3)));
        assert_eq!(result_of(strict, 9, "..s."), (true, 3, Some(3)));
        assert_eq!(result_of(strict, 9, "..f."), (false, 3, None), "a termination without success is a failure");
        assert_eq!(result_of(strict, 9, "..cs"), (false, 3, None), "the time limit ends the episode");
        assert_eq!(result_of(strict, 2, "..s"), (false, 2, None), "the budget ends the episode");
        assert_eq!(result_of(strict, 3, "..s"), (true, 3, Some(3)), "the last step of the budget counts");
    }

    #[test]
    fn hold_requires_consecutive_steps() {
        let held = Counting::Strict { hold: 3 };
        assert_eq!(result_of(held, 9, ".ggg."), (true, 4, Some(2)), "the episode continues after a termination");
        assert_eq!(result_of(held, 9, ".ss.sss."), (true, 7, Some(5)), "an interruption resets the count");
        assert_eq!(result_of(held, 9, ".ss.s.ss."), (false, 9, None));
        assert_eq!(result_of(held, 3, ".ss"), (false, 3, None), "the budget ends the episode");
        assert_eq!(result_of(held, 9, "ssf"), (false, 3, None), "a failure ends the episode");
    }

    #[test]
    fn compat_counting_counts_every_termination_as_a_success() {
        let compat = Counting::Compat { envs: 1 };
        assert_eq!(result_of(compat, 9, "..s.g"), (true, 5, Some(5)), "success without termination does not count");
        assert_eq!(result_of(compat, 9, "..f"), (true, 3, Some(3)), "any termination is a success");
        assert_eq!(result_of(compat, 9, "..c"), (false, 3, None));
        assert_eq!(result_of(compat, 2, "..g"), (false, 2, None));
    }
}
