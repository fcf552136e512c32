//! [`Judge`]: what an episode comes to, step by step, as the protocol counts.

use swm_core::results::{Counting, EpisodeResult};

/// What a world said of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    /// The reward.
    pub reward: f32,
    /// The observation satisfies the goal.
    pub success: bool,
    /// The episode is over because of where the world is.
    pub terminated: bool,
    /// The episode is over because of the clock.
    pub truncated: bool,
}

/// Judges one episode after another.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Judge {
    counting: Counting,
    /// Steps an episode may take.
    budget: usize,
    /// Steps in a row, up to now, that satisfied the goal.
    held: usize,
    /// Whether any step satisfied the goal.
    satisfied: bool,
}

impl Judge {
    pub fn new(counting: Counting, budget: usize) -> Self {
        Self { counting, budget, held: 0, satisfied: false }
    }

    /// An episode begins.
    pub fn begin(&mut self) {
        *self = Self::new(self.counting, self.budget);
    }

    /// Whether an episode whose start is solved, or not, is played at all.
    pub fn plays(&self, solved_at_start: bool) -> bool {
        matches!(self.counting, Counting::Compat { .. }) || !solved_at_start
    }

    /// Whether strict counting, with nothing to be held, calls the episode a success. It ends an episode no later than the
    /// other counting does, so an episode played for that tells both.
    pub fn satisfied(&self) -> bool {
        self.satisfied
    }

    /// Notes a step in `episode`; whether the episode goes on.
    pub fn step(&mut self, episode: &mut EpisodeResult, seen: Seen) -> bool {
        episode.steps += 1;
        episode.total_reward += f64::from(seen.reward);
        self.satisfied |= seen.success;
        let failed = match self.counting {
            Counting::Strict { hold } => {
                self.held = if seen.success { self.held + 1 } else { 0 };
                episode.success = self.held >= hold;
                if episode.success && hold > 1 {
                    episode.reached = Some(episode.steps + 1 - hold);
                }
                // A world that terminates at its goal is played on while the goal is to be held.
                seen.terminated && !seen.success
            }
            Counting::Compat { .. } => {
                episode.success = seen.terminated;
                false
            }
        };
        !(episode.success || failed || seen.truncated || episode.steps >= self.budget)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Plays steps, one letter each: `.` nothing, `s` goal satisfied, `g` satisfied and terminated (a goal world), `f`
    /// terminated without success (a fall), `c` the clock. The verdict: success, steps played, steps to the goal.
    fn verdict(counting: Counting, budget: usize, steps: &str) -> (bool, usize, Option<usize>) {
        let mut judge = Judge::new(counting, budget);
        let mut episode = EpisodeResult::default();
        for step in steps.chars() {
            let seen = Seen {
                reward: 1.0,
                success: "sg".contains(step),
                terminated: "gf".contains(step),
                truncated: step == 'c',
            };
            if !judge.step(&mut episode, seen) {
                break;
            }
        }
        assert_eq!(episode.total_reward, episode.steps as f64);
        (episode.success, episode.steps, episode.time_to_goal())
    }

    #[test]
    fn strict_succeeds_at_the_first_step_that_satisfies_the_goal() {
        let strict = Counting::Strict { hold: 1 };
        assert_eq!(verdict(strict, 9, "..g"), (true, 3, Some(3)));
        assert_eq!(verdict(strict, 9, "..s."), (true, 3, Some(3)));
        assert_eq!(verdict(strict, 9, "..f."), (false, 3, None), "falling is no success");
        assert_eq!(verdict(strict, 9, "..cs"), (false, 3, None), "the clock");
        assert_eq!(verdict(strict, 2, "..s"), (false, 2, None), "the budget");
        assert_eq!(verdict(strict, 3, "..s"), (true, 3, Some(3)), "the last step of the budget counts");
    }

    #[test]
    fn a_goal_to_be_held_must_be_held() {
        let held = Counting::Strict { hold: 3 };
        assert_eq!(verdict(held, 9, ".ggg."), (true, 4, Some(2)), "played on past termination");
        assert_eq!(verdict(held, 9, ".ss.sss."), (true, 7, Some(5)), "losing it starts anew");
        assert_eq!(verdict(held, 9, ".ss.s.ss."), (false, 9, None));
        assert_eq!(verdict(held, 3, ".ss"), (false, 3, None), "the budget ends it");
        assert_eq!(verdict(held, 9, "ssf"), (false, 3, None), "failing ends it");
    }

    #[test]
    fn compat_counts_every_termination() {
        let compat = Counting::Compat { envs: 1 };
        assert_eq!(verdict(compat, 9, "..s.g"), (true, 5, Some(5)), "success that does not terminate is none");
        assert_eq!(verdict(compat, 9, "..f"), (true, 3, Some(3)), "falling is a success");
        assert_eq!(verdict(compat, 9, "..c"), (false, 3, None));
        assert_eq!(verdict(compat, 2, "..g"), (false, 2, None));
    }
}
