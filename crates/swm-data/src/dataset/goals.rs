//! Goal sampling for goal-conditioned learning: every clip gets a row of the dataset as its goal.
//!
//! Goals are drawn from a mixture of distributions relative to the *anchor*, the step of the clip that counts as the
//! current step. Goals in the future are a whole number of model steps (frameskips) after the anchor.
//!
//! [`GoalMixture::default`] and the exclusion of clips without a future step are the same as in the reference
//! implementation's `GoalDataset`. The geometric distribution with discount γ is the one used for hindsight relabelling
//! in goal-conditioned reinforcement learning (Eysenbach et al. 2022, OGBench): the goal is `k` model steps ahead with
//! probability `(1 - γ) γ^(k - 1)`. A goal beyond the end of the episode becomes the last model step of the episode.

use crate::dataset::clips::ClipSpec;
use crate::dataset::reader::{Episode, StepRange};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};

/// Mixture of goal distributions. The probabilities add up to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoalMixture {
    /// Probability of the last row of the episode.
    pub last: f64,
    /// Probability of a later step of the episode, uniformly distributed.
    pub future: f64,
    /// Probability of a later step of the episode, geometrically distributed: see [`GoalMixture::discount`].
    pub geometric: f64,
    /// Probability of a row of the whole dataset, uniformly distributed.
    pub random: f64,
    /// Probability of the anchor itself.
    pub current: f64,
    /// γ of the geometric distribution, in `[0, 1)`. The goal is `1 / (1 - γ)` steps ahead on average.
    pub discount: f64,
}

impl GoalMixture {
    const ZERO: Self = Self { last: 0.0, future: 0.0, geometric: 0.0, random: 0.0, current: 0.0, discount: 0.99 };
    /// The goal is always the last row of the episode.
    pub const LAST: Self = Self { last: 1.0, ..Self::ZERO };
    /// The goal is always a later step of the episode, uniformly distributed.
    pub const FUTURE: Self = Self { future: 1.0, ..Self::ZERO };
    /// The goal is always a row of the whole dataset, uniformly distributed.
    pub const RANDOM: Self = Self { random: 1.0, ..Self::ZERO };

    /// The goal is always a later step of the episode, geometrically distributed.
    pub const fn geometric(discount: f64) -> Self {
        Self { geometric: 1.0, discount, ..Self::ZERO }
    }
}

impl Default for GoalMixture {
    fn default() -> Self {
        Self { random: 0.3, geometric: 0.5, current: 0.2, ..Self::ZERO }
    }
}

/// Goals to load with every clip. They become the columns `NAME_COLUMN` (`[1, shape…]`) and `NAME_offset`: the number
/// of rows from the anchor to the goal: 0 for the anchor itself, and -1 for an earlier row or one of another episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoalSpec {
    /// Prefix of the goal's columns. Goals with different names are drawn independently.
    pub name: String,
    /// Columns of the goal's row to load.
    pub columns: Vec<String>,
    /// The step of the clip that counts as the current step; the last step for `None`.
    pub anchor: Option<usize>,
    /// The distribution of goals.
    pub mixture: GoalMixture,
}

/// A drawn goal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Goal {
    /// Position of the goal's episode.
    pub episode: usize,
    /// Row of the goal within the episode.
    pub row: usize,
    /// Number of rows from the anchor to the goal; -1 for an earlier row or one of another episode.
    pub offset: i64,
}

impl GoalSpec {
    /// Checks the mixture and the anchor.
    ///
    /// # Errors
    /// If the probabilities are negative or do not add up to 1, or the discount or the anchor is out of range.
    pub fn check(&self, clip: &ClipSpec) -> Result<()> {
        let GoalMixture { last, future, geometric, random, current, discount } = self.mixture;
        let probabilities = [last, future, geometric, random, current];
        if !probabilities.iter().all(|probability| (0.0..=1.0).contains(probability))
            || (probabilities.iter().sum::<f64>() - 1.0).abs() > 1e-6
        {
            return Err(Error::OutOfSpace {
                what: format!("the probabilities of '{}' (last, future, geometric, random, current)", self.name),
                given: format!("{probabilities:?}"),
                expected: "values of at least 0 that add up to 1".to_owned(),
            });
        }
        if !(0.0..1.0).contains(&discount) {
            return Err(Error::OutOfSpace {
                what: format!("the discount of '{}'", self.name),
                given: discount.to_string(),
                expected: "at least 0 and below 1".to_owned(),
            });
        }
        if let Some(anchor) = self.anchor.filter(|anchor| *anchor >= clip.num_steps) {
            return Err(Error::OutOfSpace {
                what: format!("the anchor of '{}'", self.name),
                given: anchor.to_string(),
                expected: format!("a step of the clip, below {}", clip.num_steps),
            });
        }
        Ok(())
    }

    /// The anchor's row, counted from the clip's first row.
    fn anchor_row(&self, clip: &ClipSpec) -> usize {
        self.anchor.unwrap_or_else(|| clip.num_steps.saturating_sub(1)) * clip.frameskip
    }

    /// Number of rows, counted from the clip's first row, that an episode must have for a goal to exist.
    pub(crate) fn reach(&self, clip: &ClipSpec) -> usize {
        let needs_future_step = self.mixture.future > 0.0 || self.mixture.geometric > 0.0;
        self.anchor_row(clip) + 1 + if needs_future_step { clip.frameskip } else { 0 }
    }

    /// Draws the goal of a clip.
    pub(crate) fn draw(&self, spec: &ClipSpec, clip: &StepRange, goals: &Goals, key: Key) -> Goal {
        let mixture = self.mixture;
        let now = clip.start + self.anchor_row(spec);
        let end = goals.length(clip.episode) - 1;
        // Number of model steps after the anchor.
        let steps = (end - now) / spec.frameskip;
        let mut rng = key.rng();
        let mut remaining = rng.random::<f64>();
        let mut chosen = |probability: f64| {
            let hit = remaining < probability;
            remaining -= probability;
            hit
        };
        let (episode, row) = if chosen(mixture.random) {
            goals.row(rng.random_range(0..goals.rows as u64) as usize)
        } else if chosen(mixture.geometric) {
            // Draws `k` from the geometric distribution by inverse transform sampling.
            let u = 1.0 - rng.random::<f64>();
            let k = 1.0 + (u.ln() / mixture.discount.ln()).floor();
            (clip.episode, now + k.clamp(1.0, steps as f64) as usize * spec.frameskip)
        } else if chosen(mixture.future) {
            (clip.episode, now + rng.random_range(1..=steps as u64) as usize * spec.frameskip)
        } else if chosen(mixture.last) {
            (clip.episode, end)
        } else {
            (clip.episode, now)
        };
        let follows = episode == clip.episode && row >= now;
        Goal { episode, row, offset: if follows { (row - now) as i64 } else { -1 } }
    }
}

/// The rows that goals are drawn from.
#[derive(Clone, Debug, Default)]
pub(crate) struct Goals {
    /// Length of every episode of the dataset, in rows.
    lengths: Vec<usize>,
    /// `(position, number of rows in the preceding used episodes)` of each episode that random goals are drawn from.
    used: Vec<(usize, usize)>,
    rows: usize,
}

impl Goals {
    /// The rows of the episodes at `positions`.
    pub fn new(episodes: &[Episode], positions: &[usize]) -> Self {
        let mut goals = Self { lengths: episodes.iter().map(|episode| episode.length).collect(), ..Self::default() };
        for &position in positions {
            goals.used.push((position, goals.rows));
            goals.rows += goals.lengths[position];
        }
        goals
    }

    fn length(&self, position: usize) -> usize {
        self.lengths[position]
    }

    /// Converts a row, counted over all used episodes, to an episode position and a row within that episode.
    fn row(&self, row: usize) -> (usize, usize) {
        let at = self.used.partition_point(|&(_, before)| before <= row) - 1;
        let (position, before) = self.used[at];
        (position, row - before)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CLIP: StepRange = StepRange::new(1, 4, 6);

    fn episodes() -> Vec<Episode> {
        [9, 40, 3].into_iter().enumerate().map(|(i, length)| Episode { index: i as i64, length }).collect()
    }

    fn spec() -> ClipSpec {
        ClipSpec { num_steps: 3, frameskip: 2, columns: vec![] }
    }

    fn goal(mixture: GoalMixture, anchor: Option<usize>) -> GoalSpec {
        GoalSpec { name: "goal".to_owned(), columns: vec![], anchor, mixture }
    }

    fn drawn(mixture: GoalMixture) -> Vec<Goal> {
        let goals = Goals::new(&episodes(), &[1, 2]);
        let spec = spec();
        (0..20_000).map(|i| goal(mixture, None).draw(&spec, &CLIP, &goals, Key::new(3).at(i))).collect()
    }

    #[test]
    fn last_current_future_and_random_goals_have_the_expected_rows() {
        // The anchor is row 4 + 2 * 2 = 8 of 40, so 15 steps follow it: rows 10, 12 .. 38.
        assert!(drawn(GoalMixture::LAST).iter().all(|goal| (goal.episode, goal.row, goal.offset) == (1, 39, 31)));
        let current = GoalMixture { random: 0.0, geometric: 0.0, current: 1.0, ..GoalMixture::default() };
        assert!(drawn(current).iter().all(|goal| (goal.row, goal.offset) == (8, 0)));
        let mut counts = [0; 40];
        for goal in drawn(GoalMixture::FUTURE) {
            assert_eq!((goal.episode, goal.offset), (1, goal.row as i64 - 8));
            counts[goal.row] += 1;
        }
        for (row, &count) in counts.iter().enumerate() {
            let possible = row >= 10 && row % 2 == 0;
            // The tolerance is five standard deviations of the count in 20000 draws with probability 1/15.
            assert!(if possible { (count as f64 - 1333.3).abs() < 180.0 } else { count == 0 }, "{row}: {count}");
        }
        let mut rows = [0; 2];
        for goal in drawn(GoalMixture::RANDOM) {
            assert!(goal.episode > 0, "a goal from an unused episode");
            assert_eq!(goal.offset, if goal.episode == 1 && goal.row >= 8 { goal.row as i64 - 8 } else { -1 });
            rows[goal.episode - 1] += 1;
        }
        assert!((rows[1] as f64 - 20_000.0 * 3.0 / 43.0).abs() < 180.0, "{rows:?}");
    }

    #[test]
    fn geometric_goals_have_the_expected_frequencies() {
        let discount: f64 = 0.8;
        let goals = drawn(GoalMixture::geometric(discount));
        for k in 1..=15_usize {
            let frequency = goals.iter().filter(|goal| goal.offset == 2 * k as i64).count() as f64 / 20_000.0;
            let before = discount.powi(k as i32 - 1);
            // Goals beyond the end of the episode become the last step of the episode.
            let expected = if k == 15 { before } else { before * (1.0 - discount) };
            assert!((frequency - expected).abs() < 5.0 * (expected / 20_000.0).sqrt(), "{k}: {frequency} {expected}");
        }
        let nearest = drawn(GoalMixture::geometric(0.0));
        assert!(nearest.iter().all(|goal| goal.offset == 2), "a discount of 0 always draws the next step");
    }

    #[test]
    fn default_mixture_draws_the_anchor_and_goals_of_two_names_differ() {
        let goals = drawn(GoalMixture::default());
        let current = goals.iter().filter(|goal| goal.offset == 0).count() as f64;
        // A fifth of the goals are the anchor, and so are some of the random goals.
        assert!((current - 20_000.0 * (0.2 + 0.3 / 43.0)).abs() < 300.0, "{current}");
        let rows_of = |name: &str| {
            let goals = Goals::new(&episodes(), &[1, 2]);
            let spec = spec();
            let one = GoalSpec { name: name.to_owned(), ..goal(GoalMixture::FUTURE, None) };
            (0..50).map(|i| one.draw(&spec, &CLIP, &goals, Key::new(3).at(i).with(name)).row).collect::<Vec<_>>()
        };
        assert_ne!(rows_of("value_goal"), rows_of("actor_goal"));
    }

    #[test]
    fn future_goals_require_rows_after_the_clip_and_invalid_specs_are_rejected() {
        let spec = spec();
        assert_eq!(goal(GoalMixture::LAST, None).reach(&spec), 5);
        assert_eq!(goal(GoalMixture::FUTURE, None).reach(&spec), 7);
        assert_eq!(goal(GoalMixture::FUTURE, Some(0)).reach(&spec), 3);
        let message = |goal: GoalSpec| goal.check(&spec).expect_err("an invalid spec").to_string();
        assert!(message(goal(GoalMixture { last: 0.4, ..GoalMixture::FUTURE }, None)).contains("add up to 1"));
        assert!(message(goal(GoalMixture::geometric(1.0), None)).contains("below 1"));
        assert!(message(goal(GoalMixture::LAST, Some(3))).contains("below 3"));
        assert!(goal(GoalMixture::default(), Some(2)).check(&spec).is_ok());
    }
}
