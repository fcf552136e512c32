//! Goals for goal-conditioned learning: for every clip, a row of the dataset that it shall lead to.
//!
//! Goals come from a mixture of places. Those of the future lie a whole number of model steps (frameskips) behind the
//! *anchor*, the step of the clip that is thought of as now. The mixture of [`GoalMixture::default`], and the rule that
//! clips without a future are left out, are those of the reference's `GoalDataset`; the geometric law with discount
//! γ is that of hindsight relabelling in GCRL (Eysenbach et al. 2022, OGBench): the goal is `k` steps ahead with
//! probability `(1 - γ) γ^(k - 1)`, and what would lie behind the end of the episode is its last such step.

use crate::dataset::clips::ClipSpec;
use crate::dataset::reader::{Episode, StepRange};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use swm_core::{Error, Key, Result};

/// From where goals are drawn: the chance of each place. The chances add up to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoalMixture {
    /// The last row of the episode.
    pub last: f64,
    /// A later step of the episode, all of them equally likely.
    pub future: f64,
    /// A later step of the episode, nearer ones more likely: see [`GoalMixture::discount`].
    pub geometric: f64,
    /// Any row of any episode, all rows equally likely.
    pub random: f64,
    /// The anchor itself.
    pub current: f64,
    /// γ of the geometric law, in 0 .. 1; on average the goal lies `1 / (1 - γ)` steps ahead.
    pub discount: f64,
}

impl GoalMixture {
    const NOTHING: Self = Self { last: 0.0, future: 0.0, geometric: 0.0, random: 0.0, current: 0.0, discount: 0.99 };
    /// Always the last row of the episode.
    pub const LAST: Self = Self { last: 1.0, ..Self::NOTHING };
    /// Always a later step of the episode, all of them equally likely.
    pub const FUTURE: Self = Self { future: 1.0, ..Self::NOTHING };
    /// Always any row of the dataset.
    pub const RANDOM: Self = Self { random: 1.0, ..Self::NOTHING };

    /// Always a later step of the episode, nearer ones more likely.
    pub const fn geometric(discount: f64) -> Self {
        Self { geometric: 1.0, discount, ..Self::NOTHING }
    }
}

impl Default for GoalMixture {
    fn default() -> Self {
        Self { random: 0.3, geometric: 0.5, current: 0.2, ..Self::NOTHING }
    }
}

/// Goals to load with every clip, as the columns `NAME_COLUMN`, `[1, shape…]`, and `NAME_offset`: rows from the anchor to
/// the goal, -1 where the goal is not in what follows the anchor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GoalSpec {
    /// What its columns' names begin with. Two kinds of goals of one clip are drawn independently, by their names.
    pub name: String,
    /// The columns of the goal.
    pub columns: Vec<String>,
    /// The step of the clip that counts as now; the last one for `None`.
    pub anchor: Option<usize>,
    /// Where goals are drawn from.
    pub mixture: GoalMixture,
}

/// A goal that was drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Goal {
    /// The position of its episode.
    pub episode: usize,
    /// Its row in the episode.
    pub row: usize,
    /// Rows from the anchor to it, -1 if it does not follow it.
    pub offset: i64,
}

impl GoalSpec {
    /// Checks the mixture and the anchor.
    ///
    /// # Errors
    /// When they make no sense; says why.
    pub fn check(&self, clip: &ClipSpec) -> Result<()> {
        let GoalMixture { last, future, geometric, random, current, discount } = self.mixture;
        let chances = [last, future, geometric, random, current];
        if !chances.iter().all(|chance| (0.0..=1.0).contains(chance))
            || (chances.iter().sum::<f64>() - 1.0).abs() > 1e-6
        {
            return Err(Error::OutOfSpace {
                what: format!("the chances of '{}' (last, future, geometric, random, current)", self.name),
                given: format!("{chances:?}"),
                expected: "chances of at least 0 that add up to 1".to_owned(),
            });
        }
        if !(0.0..1.0).contains(&discount) {
            return Err(Error::OutOfSpace {
                what: format!("the discount of '{}'", self.name),
                given: discount.to_string(),
                expected: "at least 0 and below 1".to_owned(),
            });
        }
        if self.anchor.is_some_and(|anchor| anchor >= clip.num_steps) {
            return Err(Error::OutOfSpace {
                what: format!("the anchor of '{}'", self.name),
                given: format!("{:?}", self.anchor),
                expected: format!("a step of the clip, below {}", clip.num_steps),
            });
        }
        Ok(())
    }

    /// The anchor's row, counted from the clip's first.
    fn anchor_row(&self, clip: &ClipSpec) -> usize {
        self.anchor.unwrap_or_else(|| clip.num_steps.saturating_sub(1)) * clip.frameskip
    }

    /// Rows an episode must have from a clip's first on, so that there is a goal.
    pub(crate) fn reach(&self, clip: &ClipSpec) -> usize {
        let later = self.mixture.future > 0.0 || self.mixture.geometric > 0.0;
        self.anchor_row(clip) + 1 + if later { clip.frameskip } else { 0 }
    }

    /// Draws the goal of a clip.
    #[allow(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        clippy::cast_precision_loss,
        clippy::cast_possible_wrap
    )]
    pub(crate) fn draw(&self, spec: &ClipSpec, clip: &StepRange, goals: &Goals, key: Key) -> Goal {
        let mixture = self.mixture;
        let now = clip.start + self.anchor_row(spec);
        let end = goals.length(clip.episode) - 1;
        // Steps that are left behind the anchor.
        let steps = (end - now) / spec.frameskip;
        let mut rng = key.rng();
        let mut place = rng.random::<f64>();
        let mut chosen = |chance: f64| {
            let hit = place < chance;
            place -= chance;
            hit
        };
        let (episode, row) = if chosen(mixture.random) {
            goals.row(rng.random_range(0..goals.rows as u64) as usize)
        } else if chosen(mixture.geometric) {
            // The inverse of the law's distribution function at a uniform number.
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
    /// Rows of every episode of the dataset.
    lengths: Vec<usize>,
    /// `(position, rows before it)` of those that are used.
    used: Vec<(usize, usize)>,
    rows: usize,
}

impl Goals {
    /// The rows of the episodes at these positions.
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

    /// The episode and the row in it.
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
    fn each_place_is_where_it_says() {
        // The anchor is row 4 + 2 * 2 = 8 of 40: steps 10, 12 .. 38 are left, 15 of them.
        assert!(drawn(GoalMixture::LAST).iter().all(|goal| (goal.episode, goal.row, goal.offset) == (1, 39, 31)));
        let current = GoalMixture { random: 0.0, geometric: 0.0, current: 1.0, ..GoalMixture::default() };
        assert!(drawn(current).iter().all(|goal| (goal.row, goal.offset) == (8, 0)));
        let mut seen = [0; 40];
        for goal in drawn(GoalMixture::FUTURE) {
            assert_eq!((goal.episode, goal.offset), (1, goal.row as i64 - 8));
            seen[goal.row] += 1;
        }
        for (row, &count) in seen.iter().enumerate() {
            let possible = row >= 10 && row % 2 == 0;
            // Five standard deviations of 20000 draws at 1 of 15.
            assert!(if possible { (count as f64 - 1333.3).abs() < 180.0 } else { count == 0 }, "{row}: {count}");
        }
        let mut rows = [0; 2];
        for goal in drawn(GoalMixture::RANDOM) {
            assert!(goal.episode > 0, "an episode that is not used");
            assert_eq!(goal.offset, if goal.episode == 1 && goal.row >= 8 { goal.row as i64 - 8 } else { -1 });
            rows[goal.episode - 1] += 1;
        }
        assert!((rows[1] as f64 - 20_000.0 * 3.0 / 43.0).abs() < 180.0, "{rows:?}");
    }

    #[test]
    fn the_geometric_law_has_its_discount() {
        let discount: f64 = 0.8;
        let goals = drawn(GoalMixture::geometric(discount));
        for k in 1..=15_usize {
            let share = goals.iter().filter(|goal| goal.offset == 2 * k as i64).count() as f64 / 20_000.0;
            let before = discount.powi(k as i32 - 1);
            // What would lie behind the end is the last step.
            let expected = if k == 15 { before } else { before * (1.0 - discount) };
            assert!((share - expected).abs() < 5.0 * (expected / 20_000.0).sqrt(), "{k}: {share} {expected}");
        }
        let nearest = drawn(GoalMixture::geometric(0.0));
        assert!(nearest.iter().all(|goal| goal.offset == 2), "no discount, no patience");
    }

    #[test]
    fn a_mixture_mixes_and_names_are_independent() {
        let goals = drawn(GoalMixture::default());
        let current = goals.iter().filter(|goal| goal.offset == 0).count() as f64;
        // A fifth, and the random goals that hit the anchor.
        assert!((current - 20_000.0 * (0.2 + 0.3 / 43.0)).abs() < 300.0, "{current}");
        let of = |name: &str| {
            let goals = Goals::new(&episodes(), &[1, 2]);
            let spec = spec();
            let one = GoalSpec { name: name.to_owned(), ..goal(GoalMixture::FUTURE, None) };
            (0..50).map(|i| one.draw(&spec, &CLIP, &goals, Key::new(3).at(i).with(name)).row).collect::<Vec<_>>()
        };
        assert_ne!(of("value_goal"), of("actor_goal"));
    }

    #[test]
    fn clips_leave_room_for_the_goal_and_nonsense_is_refused() {
        let spec = spec();
        assert_eq!(goal(GoalMixture::LAST, None).reach(&spec), 5);
        assert_eq!(goal(GoalMixture::FUTURE, None).reach(&spec), 7);
        assert_eq!(goal(GoalMixture::FUTURE, Some(0)).reach(&spec), 3);
        let words = |goal: GoalSpec| goal.check(&spec).expect_err("nonsense").to_string();
        assert!(words(goal(GoalMixture { last: 0.4, ..GoalMixture::FUTURE }, None)).contains("add up to 1"));
        assert!(words(goal(GoalMixture::geometric(1.0), None)).contains("below 1"));
        assert!(words(goal(GoalMixture::LAST, Some(3))).contains("below 3"));
        assert!(goal(GoalMixture::default(), Some(2)).check(&spec).is_ok());
    }
}
