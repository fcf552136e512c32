//! [`BreakingPoint`]: the smallest change of a factor of variation at which success is broken.
//!
//! Along a ray, from the default of a factor towards another value, success is evaluated at eight levels, all from the same
//! starts, and at three more levels inside the first interval in which its estimate crosses half of the unshifted success.
//! Which levels these are depends on the outcomes. The intervals are therefore corrected for all 32 levels that could have
//! been evaluated, so that those of the levels that were evaluated hold together with 95 %.

use super::{Comparing, Counting, EpisodeResult, Family, Paired, Run, Verdict, betting};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The factor that a study changes along a ray.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Ray {
    /// The key of the factor.
    pub factor: String,
    /// The success rate below which success is broken in absolute terms, from 0 to 1.
    pub below: f64,
    /// Whether the levels have an order: colours and numbers have one, shapes have none.
    pub ordered: bool,
}

impl Ray {
    /// The number of levels of the first grid, the last of which is the end of the ray.
    pub const GRID: usize = 8;
    /// The number of levels inside an interval of the grid.
    pub const INSIDE: usize = 3;
    /// The number of levels that could be evaluated.
    pub const LEVELS: usize = Self::GRID * (1 + Self::INSIDE);
    /// The variable of a study that holds the change, as a share of the ray.
    pub const VARIABLE: &str = "change";
}

/// Where success breaks for one policy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BreakingPoint {
    /// The factor and the bound.
    pub ray: Ray,
    /// The policy.
    pub policy: String,
    /// The success rate without a change.
    pub unshifted: f64,
    /// The evaluated levels by their change, the smallest first.
    pub levels: Vec<Level>,
    /// Where success falls below half of the unshifted success.
    pub half: Crossing,
    /// Where success falls below the bound.
    pub bound: Crossing,
    /// Pairs of levels of the grid, the smaller change first, between which success rises: the paired test tells the later
    /// one apart as higher, corrected for all 36 pairs of the grid and the unshifted condition. Without any, success may be
    /// monotone.
    pub rises: Vec<[String; 2]>,
}

/// One change of the factor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Level {
    /// The condition.
    pub condition: String,
    /// The share of the ray.
    pub change: f64,
    /// The success rate.
    pub rate: f64,
    /// How it compares with half of the unshifted success on the same starts.
    pub half: Side,
    /// How it compares with the bound.
    pub bound: Side,
}

/// On which side of a threshold success is shown to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The interval lies above the threshold.
    Above,
    /// The interval lies below the threshold.
    Below,
    /// The interval contains the threshold.
    Undecided,
}

/// Where success falls below a threshold along a ray.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Crossing {
    /// The condition of the largest change up to which success is shown to be above at every level; the unshifted condition, if
    /// the first level is undecided. `None` if even the unshifted success is not shown to be above.
    pub above: Option<String>,
    /// The condition of the smallest change at which success is shown to be below.
    pub below: Option<String>,
    /// Neighbouring levels between which the estimates cross, in either direction, by their changes.
    pub estimates: Vec<[f64; 2]>,
}

/// A change, the name of its condition, and the outcomes.
pub type Evaluated<'a> = (f64, &'a Run);

impl BreakingPoint {
    /// The breaking point of a policy from its runs under the levels of a ray, all with the same first starts. `compare` is the
    /// paired comparison for a fixed number of episodes, or that for a number that the results decided.
    ///
    /// `None` if no level can be compared with the unshifted run.
    pub fn of(
        ray: &Ray,
        unshifted: &Run,
        levels: &[Evaluated<'_>],
        counting: Counting,
        compare: Comparing,
    ) -> Option<Self> {
        let mut levels = levels.to_vec();
        levels.sort_by(|a, b| a.0.total_cmp(&b.0));
        let compared = levels.iter().filter_map(|&(change, run)| {
            let rate = run.success.rate;
            compare(run, unshifted, counting)?;
            let (half, bound) = (side_of_half(run, unshifted, counting), side_of_bound(run, counting, ray.below));
            Some(Level { condition: run.condition.clone(), change, rate, half, bound })
        });
        let compared: Vec<Level> = compared.collect();
        if compared.is_empty() {
            return None;
        }
        let start = (unshifted.condition.as_str(), unshifted.success.rate);
        let crossing = |threshold: f64, at_start: Side, of: fn(&Level) -> Side| {
            if ray.ordered { Crossing::of(start, &compared, threshold, at_start, of) } else { Crossing::default() }
        };
        let half = crossing(unshifted.success.rate / 2.0, Side::Above, |level| level.half);
        let bound = crossing(ray.below, side_of_bound(unshifted, counting, ray.below), |level| level.bound);
        let grid =
            || levels.iter().filter(|(change, _)| (change * Ray::GRID as f64).fract() == 0.0).map(|(_, run)| *run);
        let rises = if ray.ordered {
            rises(&Vec::from_iter(std::iter::once(unshifted).chain(grid())), counting, compare)
        } else {
            vec![]
        };
        let (ray, policy) = (ray.clone(), unshifted.policy.clone());
        Some(Self { ray, policy, unshifted: unshifted.success.rate, levels: compared, half, bound, rises })
    }

    /// The interval of changes in which the estimate first falls below half of the unshifted success.
    pub fn first(&self) -> Option<[f64; 2]> {
        self.half.estimates.first().copied()
    }

    /// What the levels show, in sentences.
    pub fn sentences(&self) -> Vec<String> {
        let Self { ray, policy, unshifted, .. } = self;
        let half = format!("half of its unshifted {} %", percent(*unshifted, 0));
        let bound = format!("{} %", percent(ray.below, 0));
        if !ray.ordered {
            let list = |side: Side| {
                let names = self.levels.iter().filter(|level| level.half == side).map(|level| level.condition.as_str());
                Some(names.collect::<Vec<_>>().join(", ")).filter(|names| !names.is_empty())
            };
            let [below, above, undecided] = [Side::Below, Side::Above, Side::Undecided].map(list);
            let parts = [("below", below), ("above", above), ("not decided", undecided)];
            let parts = parts.into_iter().filter_map(|(word, names)| Some(format!("{word}: {}", names?)));
            return vec![format!("{policy}, against {half}: {}.", parts.collect::<Vec<_>>().join("; "))];
        }
        let mut sentences = vec![self.half.sentence(policy, &half), self.bound.sentence(policy, &bound)];
        let several = self.half.estimates.len() > 1;
        if let [[from, to], ..] = &self.rises[..] {
            let more = self.rises.len() - 1;
            let more = if more > 0 { format!(" and {more} more") } else { String::new() };
            sentences.push(format!("{policy} is not monotone: success rises from “{from}” to “{to}”{more}."));
        }
        if several {
            let shares = self.half.estimates.iter().map(|ends| between(*ends)).collect::<Vec<_>>();
            sentences.push(format!(
                "The estimates of {policy} cross {half} {} times: {}.",
                shares.len(),
                shares.join(", ")
            ));
        }
        sentences
    }
}

impl Crossing {
    fn of(
        (unshifted, rate): (&str, f64),
        levels: &[Level],
        threshold: f64,
        at_start: Side,
        side: fn(&Level) -> Side,
    ) -> Self {
        let first = (at_start == Side::Above).then_some(unshifted);
        let above = first.map(|first| {
            let shown = levels.iter().take_while(|level| side(level) == Side::Above).last();
            shown.map_or(first, |level| level.condition.as_str()).to_owned()
        });
        let below = levels.iter().find(|level| side(level) == Side::Below).map(|level| level.condition.clone());
        let points: Vec<(f64, f64)> =
            std::iter::once((0.0, rate)).chain(levels.iter().map(|level| (level.change, level.rate))).collect();
        let crosses = |pair: &&[(f64, f64)]| (pair[0].1 < threshold) != (pair[1].1 < threshold);
        let estimates = points.windows(2).filter(crosses).map(|pair| [pair[0].0, pair[1].0]).collect();
        Self { above, below, estimates }
    }

    fn sentence(&self, policy: &str, threshold: &str) -> String {
        let shown = match (&self.above, &self.below) {
            (Some(above), Some(below)) => {
                format!("the success of {policy} falls below {threshold} between “{above}” and “{below}”")
            }
            (Some(above), None) => {
                format!("the success of {policy} is above {threshold} up to “{above}”, and below it at no level")
            }
            (None, Some(below)) => {
                format!(
                    "the success of {policy} is below {threshold} at “{below}”, and not shown to be above it before"
                )
            }
            (None, None) => format!("no level shows whether the success of {policy} is above or below {threshold}"),
        };
        let estimate = self.estimates.first().map_or_else(
            || "the estimates do not cross it".to_owned(),
            |ends| format!("the estimates cross it {}", between(*ends)),
        );
        format!("With 95 % for all levels together, {shown}; {estimate}.")
    }
}

/// The ends of an interval of changes.
fn between([low, high]: [f64; 2]) -> String {
    format!("between {} and {} % of the way", percent(low, 1), percent(high, 1))
}

/// A share in percent, or a dash if it is none.
fn percent(share: f64, decimals: usize) -> String {
    if (0.0..=1.0).contains(&share) { format!("{:.decimals$}", 100.0 * share) } else { "–".to_owned() }
}

/// The side of half of the unshifted success: the mean of X − X₀ / 2 over starts that count in both runs, with X and X₀ the
/// outcomes with and without the change, which is from −1/2 to 1.
fn side_of_half(run: &Run, unshifted: &Run, counting: Counting) -> Side {
    let pairs = run.episodes.iter().zip(&unshifted.episodes);
    let counted = pairs.filter(|(with, without)| counting.counts(with) && counting.counts(without));
    let share = |success: bool| f64::from(u8::from(success));
    let outcome = |(with, without): (&EpisodeResult, &EpisodeResult)| {
        (with.start, (1.0 + 2.0 * share(with.success) - share(without.success)) / 3.0)
    };
    side_of_mean(counted.map(outcome), 1.0 / 3.0)
}

fn side_of_bound(run: &Run, counting: Counting, bound: f64) -> Side {
    let counted = run.episodes.iter().filter(|episode| counting.counts(episode));
    side_of_mean(counted.map(|episode| (episode.start, f64::from(u8::from(episode.success)))), bound)
}

/// The side of a threshold on which the mean of outcomes lies, each with the recorded row that its start comes from. Starts of
/// one recorded episode are not independent, so their mean is one outcome.
fn side_of_mean(outcomes: impl Iterator<Item = (Option<[usize; 2]>, f64)>, threshold: f64) -> Side {
    let mut episodes: BTreeMap<(Option<usize>, usize), (f64, usize)> = BTreeMap::new();
    for (i, (start, outcome)) in outcomes.enumerate() {
        let (sum, count) = episodes.entry(start.map_or((None, i), |[episode, _]| (Some(episode), 0))).or_default();
        *sum += outcome;
        *count += 1;
    }
    // Equal outcomes are counted; those between 0 and 1 have the order of their bits.
    let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
    for (sum, count) in episodes.into_values() {
        *counts.entry((sum / count as f64).clamp(0.0, 1.0).to_bits()).or_default() += 1;
    }
    let outcomes: Vec<(f64, usize)> = counts.into_iter().map(|(bits, count)| (f64::from_bits(bits), count)).collect();
    let [low, high] = betting::against(&outcomes, threshold, 0.05 / Ray::LEVELS as f64);
    match (low > threshold, high < threshold) {
        (true, _) => Side::Above,
        (_, true) => Side::Below,
        _ => Side::Undecided,
    }
}

/// The pairs of conditions, the earlier one first, between which success is shown to rise.
fn rises(runs: &[&Run], counting: Counting, compare: Comparing) -> Vec<[String; 2]> {
    let pairs = (0..runs.len()).flat_map(|later| (0..later).map(move |earlier| [earlier, later]));
    let mut compared: Vec<([usize; 2], Paired)> =
        pairs.filter_map(|[i, j]| Some(([i, j], compare(runs[j], runs[i], counting)?))).collect();
    let mut tables: Vec<&mut Paired> = compared.iter_mut().map(|(_, table)| table).collect();
    Family::correct("", &mut tables, (Ray::GRID + 1) * Ray::GRID / 2);
    compared.sort_by_key(|([i, j], _)| (*i, *j));
    let higher = compared.iter().filter(|(_, table)| table.verdict == Verdict::Higher);
    higher.map(|([i, j], _)| [*i, *j].map(|run| runs[run].condition.clone())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use crate::results::{EpisodeResult, Timing};
    use rand::Rng as _;

    const RAY: Ray = Ray { factor: String::new(), below: 0.5, ordered: true };

    /// A run in which a start succeeds below the rate of the condition, by its own difficulty.
    fn run(condition: &str, rate: f64, n: u64, key: Key) -> Run {
        let episodes = (0..n).map(|seed| {
            let difficulty: f64 = key.at(seed).rng().random();
            EpisodeResult { success: difficulty < rate, ..EpisodeResult::new(seed) }
        });
        Run::new(condition, "model", Counting::default(), episodes.collect(), Timing::default())
    }

    fn point(rates: &[f64], n: u64, seed: u64) -> BreakingPoint {
        let key = Key::new(seed);
        let unshifted = run("plain", rates[0], n, key);
        let runs: Vec<Run> =
            rates[1..].iter().enumerate().map(|(i, rate)| run(&format!("{}/8", i + 1), *rate, n, key)).collect();
        let levels: Vec<Evaluated<'_>> = runs.iter().zip(1..).map(|(run, i)| (f64::from(i) / 8.0, run)).collect();
        BreakingPoint::of(&RAY, &unshifted, &levels, Counting::default(), Paired::of_runs).expect("eight levels")
    }

    #[test]
    fn success_that_falls_has_one_crossing_inside_its_interval() {
        let found = point(&[0.9, 0.9, 0.88, 0.8, 0.3, 0.1, 0.05, 0.0, 0.0], 100, 1);
        assert_eq!(found.half.estimates, [[0.375, 0.5]]);
        assert_eq!((found.first(), found.half.above.as_deref()), (Some([0.375, 0.5]), Some("3/8")));
        assert!(matches!(found.half.below.as_deref(), Some("4/8" | "5/8")), "{found:?}");
        assert_eq!((found.bound.above.as_deref(), found.rises.len()), (Some("3/8"), 0));
        let sentences = found.sentences();
        assert!(sentences.len() == 2 && sentences[0].contains("between “3/8” and “"), "{sentences:?}");
        assert!(sentences[1].contains("below 50 %") && sentences[1].ends_with("between 37.5 and 50.0 % of the way."));
    }

    #[test]
    fn success_that_rises_again_is_not_monotone() {
        let found = point(&[0.9, 0.9, 0.2, 0.1, 0.1, 0.2, 0.8, 0.9, 0.9], 100, 2);
        assert_eq!(found.half.estimates, [[0.125, 0.25], [0.625, 0.75]]);
        assert!(found.rises.contains(&["3/8".to_owned(), "8/8".to_owned()]), "{:?}", found.rises);
        let sentences = found.sentences().join(" ");
        assert!(sentences.contains("is not monotone") && sentences.contains("2 times"), "{sentences}");
        let robust = point(&[0.9; 9], 100, 3);
        assert!(robust.half.below.is_none() && robust.half.above.as_deref() == Some("8/8"), "{robust:?}");
        let useless = point(&[0.0; 9], 100, 3);
        assert_eq!((useless.half.below, useless.half.estimates), (None, vec![]));
        assert!(useless.bound.above.is_none() && useless.bound.below.is_some());
    }

    #[test]
    fn few_starts_decide_nothing() {
        let found = point(&[0.9, 0.9, 0.88, 0.8, 0.3, 0.1, 0.05, 0.0, 0.0], 6, 1);
        assert_eq!((found.half.above.as_deref(), found.half.below.as_deref()), (Some("plain"), None));
        assert!(found.levels.iter().all(|level| level.half == Side::Undecided));
    }

    /// The share of repetitions in which a level is wrongly decided, with `starts` from each recorded episode. Success is exactly
    /// half of the unshifted success at all levels, so that every decision is wrong. What solves one start of an episode solves
    /// all.
    fn wrong(starts: u64, repetitions: u64) -> f64 {
        let mut wrong = 0;
        for repetition in 0..repetitions {
            let run = |condition: &str, level: u64, rate: f64| {
                let episodes = (0..60 * starts).map(|seed| {
                    let episode = seed / starts;
                    let mut rng = Key::new(repetition).at(level).at(episode).rng();
                    let start = Some([episode as usize, seed as usize]);
                    EpisodeResult { success: rng.random_bool(rate), start, ..EpisodeResult::new(seed) }
                });
                Run::new(condition, "model", Counting::default(), episodes.collect(), Timing::default())
            };
            let decided = |level: u64| {
                let [with, without] = [run("level", 2 * level, 0.4), run("plain", 2 * level + 1, 0.8)];
                let counting = Counting::default();
                let sides = [side_of_half(&with, &without, counting), side_of_bound(&with, counting, 0.4)];
                sides.iter().any(|side| *side != Side::Undecided)
            };
            wrong += usize::from((0..Ray::GRID as u64).any(decided));
        }
        wrong as f64 / repetitions as f64
    }

    #[test]
    fn wrong_sides_are_at_most_the_level() {
        assert!(wrong(1, 400) < 0.05);
        // If starts counted as independent, about half of these would be decided.
        assert!(wrong(5, 100) < 0.05);
    }

    #[test]
    fn starts_of_one_episode_are_one_outcome() {
        let episodes = |starts: usize| {
            let of = (0..40 * starts).map(move |i| (Some([i / starts, i]), f64::from(u8::from(i / starts < 30))));
            side_of_mean(of, 0.5)
        };
        assert_eq!((episodes(1), episodes(5)), (Side::Undecided, Side::Undecided));
        let independent = (0..200).map(|i| (None, f64::from(u8::from(i < 150))));
        assert_eq!(side_of_mean(independent, 0.5), Side::Above);
    }
}
