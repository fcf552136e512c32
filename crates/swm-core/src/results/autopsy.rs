//! [`Autopsy`]: why a planning policy fails, from runs in which parts of its planning are replaced.
//!
//! An [`Ingredient`] replaces one part of the policy by a better one. Every arm plays all starts with a set of ingredients; the
//! first arm has none. Which starts are failures is decided by a run that is not part of any arm, because failures that were
//! selected by an arm would seem to recover in every other arm. The *value* of an arm is its success on these failures, and
//! the contribution of an ingredient is its [Shapley value](Game): its mean marginal value over all orders in which
//! ingredients can be added. Contributions sum to the value of the arm with all ingredients minus that of the first arm.
//!
//! Intervals and ranks come from a bootstrap that resamples starts with all their outcomes, so that arms stay paired; starts
//! from one recorded episode form a cluster.

use super::shapley::{Coalition, Game};
use super::{Counting, EpisodeResult, Proportion, Run};
use crate::{Error, Key, Result};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

/// A part of planning that is replaced by a better one.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ingredient {
    /// S: ten times as many candidates.
    Search,
    /// R: a new plan after every model step.
    Replanning,
    /// D: the true dynamics. Plans are simulated in the environment, and the cost is that of the resulting frame.
    Dynamics,
    /// C: the distance of the states that a probe reads from latents, instead of the distance of latents.
    Probe,
    /// E: the environment's distance to the goal by its success criterion, instead of the distance of latents or of probed
    /// states. It can be computed of simulated states only, and so comes after the true dynamics, and after the probe.
    Distance,
}

impl Ingredient {
    /// All ingredients, in the order of tables.
    pub const ALL: [Self; 5] = [Self::Search, Self::Replanning, Self::Dynamics, Self::Probe, Self::Distance];

    /// The letter in tables.
    pub fn letter(self) -> char {
        match self {
            Self::Search => 'S',
            Self::Replanning => 'R',
            Self::Dynamics => 'D',
            Self::Probe => 'C',
            Self::Distance => 'E',
        }
    }

    /// What the ingredient replaces, in a few words.
    pub fn summary(self) -> &'static str {
        match self {
            Self::Search => "search x 10",
            Self::Replanning => "replan every step",
            Self::Dynamics => "true dynamics",
            Self::Probe => "probe distance",
            Self::Distance => "true distance",
        }
    }

    /// What the policy lacks if this ingredient is the culprit.
    pub fn meaning(self) -> &'static str {
        match self {
            Self::Search => "the search does not find the plans that its cost prefers",
            Self::Replanning => "plans are executed for too long before the next one",
            Self::Dynamics => "the model predicts wrong latents for the actions of plans",
            Self::Probe => "latents contain the state, but their distance does not say how far the goal is",
            Self::Distance => "a small distance of latents does not mean that the goal is near",
        }
    }

    /// Whether this ingredient can be added only after another one.
    fn is_after(self, other: Self) -> bool {
        self == Self::Distance && matches!(other, Self::Dynamics | Self::Probe)
    }
}

/// The game of some ingredients.
pub fn game(ingredients: &[Ingredient]) -> Game {
    let before = |ingredient: &Ingredient| {
        let is_before = |(_, other): &(usize, &Ingredient)| ingredient.is_after(**other);
        ingredients.iter().enumerate().filter(is_before).map(|(i, _)| 1 << i).sum()
    };
    Game::new(ingredients.iter().map(before).collect())
}

/// The ingredients of a coalition.
pub fn members(ingredients: &[Ingredient], coalition: Coalition) -> Vec<Ingredient> {
    let is_member = |(i, _): &(usize, &Ingredient)| coalition & (1 << i) != 0;
    ingredients.iter().enumerate().filter(is_member).map(|(_, ingredient)| *ingredient).collect()
}

/// The letters of a set of ingredients, or a dash for none.
pub fn letters(set: &[Ingredient]) -> String {
    if set.is_empty() { "–".to_owned() } else { set.iter().map(|ingredient| ingredient.letter()).collect() }
}

/// The runs of one arm: the same starts with each planning seed.
#[derive(Clone, Debug)]
pub struct ArmRuns {
    /// The ingredients.
    pub ingredients: Vec<Ingredient>,
    /// One run for each planning seed.
    pub runs: Vec<Run>,
}

/// The outcome of an autopsy.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Autopsy {
    /// The number of starts that count.
    pub starts: usize,
    /// The success rate of the run that selects the failures.
    pub selection: Proportion,
    /// The number of planning seeds of every arm.
    pub planning_seeds: usize,
    /// The contributions of the ingredients to success on the failures.
    pub contributions: Vec<Contribution>,
    /// The arms, the unchanged policy first.
    pub arms: Vec<Arm>,
    /// What the arms show.
    pub finding: Finding,
    /// The failures, each with the smallest sets of ingredients that solve it.
    pub repairs: Vec<Repair>,
}

/// A share from 0 to 1, or a difference of shares, with its 95 % bootstrap interval.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Estimate {
    /// The estimate.
    pub value: f64,
    /// The lower end.
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

/// What an ingredient contributes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contribution {
    /// The ingredient.
    pub ingredient: Ingredient,
    /// Its Shapley value: the share of the failures that it recovers.
    pub recovered: Estimate,
    /// The share of the failures that it recovers without ingredients that it could do without.
    pub alone: Estimate,
    /// The share of resamples in which it contributes more than every other ingredient.
    pub first: f64,
}

/// The success of the policy with some ingredients.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Arm {
    /// The ingredients.
    pub ingredients: Vec<Ingredient>,
    /// The success rate over all starts and planning seeds.
    pub success: Estimate,
    /// The success rate on the failures minus that of the unchanged policy.
    pub recovered: Estimate,
    /// The success rate of the unchanged policy on the starts that are no failures, minus that of this arm.
    pub harmed: Estimate,
}

/// What an autopsy finds.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Finding {
    /// The unchanged policy is not shown to solve less than [`Autopsy::HEALTHY`] of the starts: there is nothing to explain.
    Healthy,
    /// There are fewer than [`Autopsy::MIN_FAILURES`] failures.
    TooFew,
    /// One ingredient ranks first, and recovers failures without the others.
    Culprit(Ingredient),
    /// Several ingredients contribute, and none of them explains the failures alone.
    Joint(Vec<Ingredient>),
    /// No ingredient is shown to contribute more than the others.
    Undecided,
}

/// A failure and what solves it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Repair {
    /// The index of the start, counted from 0.
    pub start: usize,
    /// The dataset row of the start, `[episode, step]`, if it was recorded.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub row: Option<[usize; 2]>,
    /// The smallest sets of ingredients with which most planning seeds solve the start: one empty set if the unchanged policy
    /// does, and none if no arm does.
    pub sets: Vec<Vec<Ingredient>>,
}

/// The outcomes of the starts of one cluster.
#[derive(Clone, Default)]
struct Cluster {
    /// The number of failures, and of starts that are none.
    counts: [f64; 2],
    /// For each arm, the sum of the success rates on failures, and on the other starts.
    sums: Vec<[f64; 2]>,
}

/// What one sample of clusters shows.
struct Sampled {
    contributions: Vec<f64>,
    /// For each ingredient, what it recovers when it is added as early as possible.
    alone: Vec<f64>,
    /// For each arm: success on all starts, recovered, harmed.
    arms: Vec<[f64; 3]>,
}

impl Autopsy {
    /// The share of resamples in which a culprit ranks first.
    pub const SURE: f64 = 0.95;
    /// The share of the failures that a finding explains at least.
    pub const MIN_SHARE: f64 = 0.2;
    /// The success rate of a policy that needs no explanation.
    pub const HEALTHY: f64 = 0.8;
    /// The share of resamples in which the unchanged policy solves less than that, if there is something to explain.
    pub const SHOWN: f64 = 0.9;
    /// The smallest number of failures, or of recorded episodes with failures, that can be explained.
    pub const MIN_FAILURES: usize = 5;
    /// The smallest number of planning seeds.
    pub const MIN_SEEDS: usize = 3;
    /// The number of resamples of the bootstrap.
    pub const RESAMPLES: usize = 2000;

    /// What was found on the failures: nothing if there are none.
    pub fn on_failures<T>(&self, found: T) -> Option<T> {
        (!self.repairs.is_empty()).then_some(found)
    }

    /// What was found on the starts that the selection run solved: nothing if there are none.
    pub fn on_solved<T>(&self, found: T) -> Option<T> {
        (self.starts > self.repairs.len()).then_some(found)
    }

    /// The autopsy of the ingredients that the arms have. `selection` is the run that selects the failures; there is one arm
    /// for each coalition of the [`game`] of the ingredients, in any order. The bootstrap draws with `key`.
    ///
    /// # Errors
    /// When an arm is missing or has fewer than [`Autopsy::MIN_SEEDS`] runs, runs have different starts, or no start counts.
    pub fn of(selection: &Run, arms: &[ArmRuns], counting: Counting, key: Key) -> Result<Self> {
        let ingredients: BTreeSet<Ingredient> = arms.iter().flat_map(|arm| arm.ingredients.clone()).collect();
        let ingredients = Vec::from_iter(ingredients);
        let game = game(&ingredients);
        let coalitions = game.coalitions();
        let arms = checked(selection, arms, &ingredients, &coalitions)?;
        let planning_seeds = arms.iter().map(|arm| arm.runs.len()).min().unwrap_or_default();
        let counted: Vec<usize> =
            (0..selection.episodes.len()).filter(|&start| counting.counts(&selection.episodes[start])).collect();
        if counted.is_empty() {
            return Err(wrong("no start that counts".to_owned()));
        }
        // Of each start that counts, the share of planning seeds with which each arm solves it.
        let solved = |start: usize| -> Vec<f64> {
            let share = |arm: &&ArmRuns| {
                let solved = arm.runs.iter().filter(|run| run.episodes[start].success).count();
                solved as f64 / arm.runs.len() as f64
            };
            arms.iter().map(share).collect()
        };
        let shares: BTreeMap<usize, Vec<f64>> = counted.iter().map(|&start| (start, solved(start))).collect();
        let clusters = clusters(selection, &shares);
        let marginals = Marginals::of(&game, &coalitions);
        let sampled = bootstrap(&clusters, &marginals, key);
        let observed = Sampled::of(clusters.iter(), &marginals);
        let estimate = |of: &dyn Fn(&Sampled) -> f64| Estimate::new(of(&observed), sampled.iter().map(of).collect());
        let contribution = |(i, &ingredient): (usize, &Ingredient)| {
            let is_first = |sample: &&Sampled| {
                let others = sample.contributions.iter().enumerate().filter(|(j, _)| *j != i);
                others.into_iter().all(|(_, other)| sample.contributions[i] > other + TIE)
            };
            let first = sampled.iter().filter(is_first).count() as f64 / sampled.len().max(1) as f64;
            let [recovered, alone] = [estimate(&|sample| sample.contributions[i]), estimate(&|sample| sample.alone[i])];
            Contribution { ingredient, recovered, alone, first }
        };
        let contributions: Vec<Contribution> = ingredients.iter().enumerate().map(contribution).collect();
        let arm = |(i, coalition): (usize, Coalition)| {
            let [success, recovered, harmed] = [0, 1, 2].map(|what| estimate(&|sample| sample.arms[i][what]));
            Arm { ingredients: members(&ingredients, coalition), success, recovered, harmed }
        };
        let arms: Vec<Arm> = coalitions.iter().copied().enumerate().map(arm).collect();
        let failing = clusters.iter().filter(|cluster| cluster.counts[0] > 0.0).count();
        let failures = counted.iter().copied().filter(|&start| !selection.episodes[start].success);
        let repair = |start: usize| Repair {
            start,
            row: selection.episodes[start].start,
            sets: smallest(&shares[&start], &coalitions).iter().map(|&set| members(&ingredients, set)).collect(),
        };
        Ok(Self {
            starts: counted.len(),
            selection: selection.success,
            planning_seeds,
            finding: finding(&contributions, &sampled, failing),
            contributions,
            arms,
            repairs: failures.map(repair).collect(),
        })
    }
}

/// Returns the arms in the order of the coalitions.
///
/// # Errors
/// When an arm is missing or has fewer than [`Autopsy::MIN_SEEDS`] runs, or runs have different starts.
fn checked<'a>(
    selection: &Run,
    arms: &'a [ArmRuns],
    ingredients: &[Ingredient],
    coalitions: &[Coalition],
) -> Result<Vec<&'a ArmRuns>> {
    let find = |coalition: &Coalition| {
        let set = members(ingredients, *coalition);
        let is_set = |arm: &&ArmRuns| BTreeSet::from_iter(&arm.ingredients) == BTreeSet::from_iter(&set);
        arms.iter().find(is_set).ok_or_else(|| wrong(format!("no arm {}", letters(&set))))
    };
    let arms: Vec<&ArmRuns> = coalitions.iter().map(find).collect::<Result<_>>()?;
    if let Some(few) = arms.iter().map(|arm| arm.runs.len()).min().filter(|count| *count < Autopsy::MIN_SEEDS) {
        return Err(wrong(format!("{few} planning seeds")));
    }
    let same = |run: &Run| {
        let same = |(a, b): (&EpisodeResult, &EpisodeResult)| (a.seed, a.start) == (b.seed, b.start);
        run.episodes.len() == selection.episodes.len() && run.episodes.iter().zip(&selection.episodes).all(same)
    };
    if arms.iter().flat_map(|arm| &arm.runs).all(same) {
        Ok(arms)
    } else {
        Err(wrong("runs with different starts".to_owned()))
    }
}

/// The largest difference of two contributions that counts as equal.
const TIE: f64 = 1e-12;

fn wrong(given: String) -> Error {
    Error::mismatch(
        "an autopsy",
        given,
        format!(
            "an arm of at least {} planning seeds for each set of ingredients, all on the same starts",
            Autopsy::MIN_SEEDS
        ),
    )
}

/// The clusters of the starts that count: starts from one recorded episode, or one start that was drawn.
fn clusters(selection: &Run, shares: &BTreeMap<usize, Vec<f64>>) -> Vec<Cluster> {
    let mut clusters: BTreeMap<(bool, usize), Cluster> = BTreeMap::new();
    for (&start, solved) in shares {
        let episode = &selection.episodes[start];
        let cluster = clusters.entry(episode.start.map_or((false, start), |[episode, _]| (true, episode))).or_default();
        let kind = usize::from(episode.success);
        cluster.counts[kind] += 1.0;
        cluster.sums.resize(solved.len(), [0.0; 2]);
        cluster.sums.iter_mut().zip(solved).for_each(|(sum, share)| sum[kind] += share);
    }
    clusters.into_values().collect()
}

/// For each ingredient, the marginal values that its contribution is the weighted sum of: the arms before and after it is
/// added, and the weight.
struct Marginals(Vec<Vec<(usize, usize, f64)>>);

impl Marginals {
    /// The marginal values of a game whose arms have these coalitions.
    fn of(game: &Game, coalitions: &[Coalition]) -> Self {
        let arm = |coalition| coalitions.binary_search(&coalition).unwrap_or_default();
        let of_player = |marginals: Vec<(Coalition, Coalition, f64)>| {
            marginals.into_iter().map(|(before, after, weight)| (arm(before), arm(after), weight)).collect()
        };
        Self(game.marginals().into_iter().map(of_player).collect())
    }
}

/// Resamples clusters with replacement.
fn bootstrap(clusters: &[Cluster], marginals: &Marginals, key: Key) -> Vec<Sampled> {
    let mut rng = key.with("autopsy").rng();
    let mut draw = || Vec::from_iter((0..clusters.len()).map(|_| &clusters[rng.random_range(0..clusters.len())]));
    (0..Autopsy::RESAMPLES).map(|_| Sampled::of(draw().into_iter(), marginals)).collect()
}

impl Sampled {
    /// What some clusters show; there is at least one. Without a failure, nothing is recovered.
    fn of<'a>(clusters: impl Iterator<Item = &'a Cluster>, marginals: &Marginals) -> Self {
        let mut total = Cluster::default();
        for cluster in clusters {
            total.sums.resize(cluster.sums.len(), [0.0; 2]);
            for kind in 0..2 {
                total.counts[kind] += cluster.counts[kind];
                total.sums.iter_mut().zip(&cluster.sums).for_each(|(sum, more)| sum[kind] += more[kind]);
            }
        }
        let Cluster { counts, sums } = total;
        let rate = |arm: usize, kind: usize| if counts[kind] > 0.0 { sums[arm][kind] / counts[kind] } else { 0.0 };
        let of_arm = |arm: usize| {
            let success = (sums[arm][0] + sums[arm][1]) / (counts[0] + counts[1]);
            [success, rate(arm, 0) - rate(0, 0), rate(0, 1) - rate(arm, 1)]
        };
        let marginal = |&(before, after, _): &(usize, usize, f64)| rate(after, 0) - rate(before, 0);
        let contribution =
            |marginals: &Vec<(usize, usize, f64)>| marginals.iter().map(|arms| arms.2 * marginal(arms)).sum();
        Self {
            contributions: marginals.0.iter().map(contribution).collect(),
            // The smallest coalition has the lowest number.
            alone: marginals.0.iter().map(|marginals| marginals.first().map_or(0.0, marginal)).collect(),
            arms: (0..sums.len()).map(of_arm).collect(),
        }
    }
}

impl Estimate {
    /// An estimate with the percentiles of its resamples.
    fn new(value: f64, mut resampled: Vec<f64>) -> Self {
        resampled.sort_by(f64::total_cmp);
        let percentile = |share: f64| {
            let at = share * resampled.len().saturating_sub(1) as f64;
            let ends = [at.floor(), at.ceil()].map(|at| resampled.get(at as usize).copied().unwrap_or(value));
            ends[0] + (ends[1] - ends[0]) * at.fract()
        };
        Self { value, low: percentile(0.025), high: percentile(0.975) }
    }
}

/// What the arms show.
fn finding(contributions: &[Contribution], sampled: &[Sampled], failing: usize) -> Finding {
    let unhealthy = sampled.iter().filter(|sample| sample.arms[0][0] < Autopsy::HEALTHY).count();
    if (unhealthy as f64) < Autopsy::SHOWN * sampled.len() as f64 {
        return Finding::Healthy;
    }
    if failing < Autopsy::MIN_FAILURES {
        return Finding::TooFew;
    }
    let explains = |Contribution { recovered, alone, .. }: &Contribution| {
        recovered.value >= Autopsy::MIN_SHARE && recovered.low > 0.0 && alone.low > 0.0
    };
    let culprit = contributions.iter().find(|found| found.first >= Autopsy::SURE && explains(found));
    if let Some(culprit) = culprit {
        return Finding::Culprit(culprit.ingredient);
    }
    // Ingredients that all contribute, and of which one or the other ranks first.
    let contributes = |i: &usize| contributions[*i].recovered.low > 0.0;
    let joint: Vec<usize> = (0..contributions.len()).filter(contributes).collect();
    let share = |sample: &Sampled| joint.iter().map(|&i| sample.contributions[i]).sum::<f64>();
    let together: f64 = joint.iter().map(|&i| contributions[i].recovered.value).sum();
    let are_first = sampled.iter().filter(|sample| {
        let outside = (0..contributions.len()).filter(|i| !joint.contains(i)).map(|i| sample.contributions[i]);
        let most = joint.iter().map(|&i| sample.contributions[i]).fold(f64::NEG_INFINITY, f64::max);
        share(sample) > 0.0 && outside.into_iter().all(|other| most > other + TIE)
    });
    let is_sure = are_first.count() as f64 >= Autopsy::SURE * sampled.len() as f64;
    if joint.len() > 1 && together >= Autopsy::MIN_SHARE && is_sure {
        return Finding::Joint(joint.into_iter().map(|i| contributions[i].ingredient).collect());
    }
    Finding::Undecided
}

/// The smallest coalitions with which more than half of the planning seeds solve a start; of several, those with most.
fn smallest(shares: &[f64], coalitions: &[Coalition]) -> Vec<Coalition> {
    let solving = || shares.iter().zip(coalitions).filter(|(share, _)| **share > 0.5);
    let Some(size) = solving().map(|(_, coalition)| coalition.count_ones()).min() else { return vec![] };
    let smallest = || solving().filter(|(_, coalition)| coalition.count_ones() == size);
    let most = smallest().map(|(share, _)| *share).fold(0.0, f64::max);
    smallest().filter(|(share, _)| **share >= most).map(|(_, coalition)| *coalition).collect()
}

impl fmt::Display for Finding {
    /// A sentence without its full stop.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Healthy => write!(
                f,
                "healthy: the unchanged policy is not shown to solve less than {:.0} % of the starts",
                100.0 * Autopsy::HEALTHY
            ),
            Self::TooFew => write!(f, "too few: fewer than {} failures", Autopsy::MIN_FAILURES),
            Self::Culprit(culprit) => write!(f, "culprit: {} ({})", culprit.summary(), culprit.meaning()),
            Self::Joint(joint) => {
                let names: Vec<&str> = joint.iter().map(|ingredient| ingredient.summary()).collect();
                write!(f, "joint: {}; none of them explains the failures alone", names.join(" and "))
            }
            Self::Undecided => write!(f, "undecided: no ingredient is shown to recover more than the others"),
        }
    }
}

#[cfg(test)]
mod tests;
