//! [`ErrorAndSuccess`]: whether a model's prediction error tells failed episodes from solved ones.

use super::{Prediction, score};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// The area under the curve of an error that says nothing about success.
const CHANCE: f64 = 0.5;
/// How far from chance an area may be that counts as no prediction.
const MARGIN: f64 = 0.05;
/// The number of points at which densities are compared.
const POINTS: usize = 1000;

/// The prediction errors of solved and failed trajectories, and how well they tell them apart.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorAndSuccess {
    /// The mean error of each solved trajectory, in the order of the starts.
    pub solved: Vec<f64>,
    /// The mean error of each failed trajectory.
    pub failed: Vec<f64>,
    /// How well the error tells failed trajectories from solved ones; `None` unless there are both.
    pub discrimination: Option<Discrimination>,
}

/// How well an error tells failed trajectories from solved ones.
///
/// The area under the receiver operating characteristic (AUC) is the probability that a failed trajectory has a larger error
/// than a solved one, where equal errors count half: 0.5 for an error that says nothing.
///
/// Its interval is Newcombe's method 5 ("Confidence intervals for an effect size measure based on the Mann-Whitney statistic,
/// part 2", 2006), which neither leaves [0, 1] nor vanishes for an AUC of 1. Its variance is multiplied by the design effect:
/// the variance with trajectories of one recorded episode as a cluster (Obuchowski, "Nonparametric analysis of clustered ROC
/// curve data", 1997) relative to that of independent trajectories (DeLong et al. 1988), and at least 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Discrimination {
    /// The AUC.
    pub auc: f64,
    /// The lower end of its 95 % interval.
    pub low: f64,
    /// The upper end.
    pub high: f64,
    /// The variance of the AUC relative to that of independent trajectories.
    pub design_effect: f64,
    /// The area that the densities of the errors of solved and failed trajectories share, from 0 to 1: normal kernels on the
    /// logarithm of the error, with Scott's bandwidth. `None` for fewer than two different errors of a kind.
    pub overlap: Option<f64>,
    /// What the interval says.
    pub verdict: Predicts,
}

/// Whether the error predicts success.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Predicts {
    /// The interval excludes 0.5: errors of failed trajectories are larger, or smaller.
    #[serde(rename = "predicts")]
    Yes,
    /// The interval lies inside [0.45, 0.55].
    #[serde(rename = "does not predict")]
    No,
    /// Neither.
    #[serde(rename = "undecided")]
    Undecided,
}

impl fmt::Display for Predicts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Yes => "predicts",
            Self::No => "does not predict",
            Self::Undecided => "undecided",
        })
    }
}

impl ErrorAndSuccess {
    /// The errors of the trajectories whose outcome is known. Trajectories of one recorded episode form a cluster.
    pub fn of(prediction: &Prediction) -> Self {
        let known = prediction.trajectories.iter();
        Self::of_errors(known.filter_map(|known| Some((known.success?, known.error(), known.start[0]))))
    }

    /// The success, the error and the cluster of trajectories.
    pub(super) fn of_errors(trajectories: impl Iterator<Item = (bool, f64, usize)>) -> Self {
        let known: Vec<(bool, f64, usize)> = trajectories.filter(|(_, error, _)| error.is_finite()).collect();
        let of = |success: bool| {
            let members = known.iter().filter(|(found, ..)| *found == success);
            members.map(|(_, error, cluster)| (*error, *cluster)).collect::<Vec<_>>()
        };
        let (solved, failed) = (of(true), of(false));
        let discrimination = Discrimination::of(&failed, &solved);
        let errors = |of: Vec<(f64, usize)>| of.into_iter().map(|(error, _)| error).collect();
        Self { solved: errors(solved), failed: errors(failed), discrimination }
    }
}

impl Discrimination {
    /// Compares errors, each with its cluster; `None` if there are none of a kind.
    fn of(failed: &[(f64, usize)], solved: &[(f64, usize)]) -> Option<Self> {
        if failed.is_empty() || solved.is_empty() {
            return None;
        }
        let wins = |above: f64, below: f64| match above.total_cmp(&below) {
            std::cmp::Ordering::Greater => 1.0,
            std::cmp::Ordering::Equal => 0.5,
            std::cmp::Ordering::Less => 0.0,
        };
        let share = |error: f64, others: &[(f64, usize)], is_failed: bool| {
            let sum: f64 =
                others.iter().map(|(other, _)| if is_failed { wins(error, *other) } else { wins(*other, error) }).sum();
            sum / others.len() as f64
        };
        let of_failed: Vec<(f64, usize)> =
            failed.iter().map(|(error, at)| (share(*error, solved, true), *at)).collect();
        let of_solved: Vec<(f64, usize)> =
            solved.iter().map(|(error, at)| (share(*error, failed, false), *at)).collect();
        let auc = of_failed.iter().map(|(share, _)| share).sum::<f64>() / failed.len() as f64;
        let design_effect = design_effect(&of_failed, &of_solved, auc);
        let [low, high] = interval(auc, failed.len(), solved.len(), design_effect);
        let verdict = if low >= CHANCE - MARGIN && high <= CHANCE + MARGIN {
            Predicts::No
        } else if low > CHANCE || high < CHANCE {
            Predicts::Yes
        } else {
            Predicts::Undecided
        };
        let errors = |of: &[(f64, usize)]| of.iter().map(|(error, _)| *error).collect::<Vec<_>>();
        let densities = Density::of(&errors(failed)).zip(Density::of(&errors(solved)));
        let overlap = densities.map(|(failed, solved)| failed.overlap(&solved));
        Some(Self { auc, low, high, design_effect, overlap, verdict })
    }
}

/// The design effect of the clusters. `failed` and `solved` have the structural component and the cluster of each trajectory.
///
/// Where all components are equal, as with perfect separation, it is the mean size of the clusters.
fn design_effect(failed: &[(f64, usize)], solved: &[(f64, usize)], auc: f64) -> f64 {
    #[derive(Default)]
    struct Cluster {
        failed: f64,
        solved: f64,
        of_failed: f64,
        of_solved: f64,
    }
    let mut clusters: BTreeMap<usize, Cluster> = BTreeMap::new();
    for (share, at) in failed {
        let cluster = clusters.entry(*at).or_default();
        cluster.failed += 1.0;
        cluster.of_failed += share - auc;
    }
    for (share, at) in solved {
        let cluster = clusters.entry(*at).or_default();
        cluster.solved += 1.0;
        cluster.of_solved += share - auc;
    }
    let [m, n] = [failed.len(), solved.len()].map(|count| count as f64);
    let all = clusters.len() as f64;
    let with = |of: fn(&Cluster) -> f64| clusters.values().filter(|cluster| of(cluster) > 0.0).count() as f64;
    let sum = |of: &dyn Fn(&Cluster) -> f64| clusters.values().map(of).sum::<f64>();
    let spread = |of: &[(f64, usize)]| of.iter().map(|(share, _)| (share - auc).powi(2)).sum::<f64>();
    let corrected = |count: f64| if count > 1.0 { count / (count - 1.0) } else { f64::INFINITY };
    let independent = corrected(m) * spread(failed) / (m * m) + corrected(n) * spread(solved) / (n * n);
    if !(independent.is_finite() && independent > 0.0) {
        return ((m + n) / all).max(1.0);
    }
    let clustered = corrected(with(|cluster| cluster.failed)) * sum(&|cluster| cluster.of_failed.powi(2)) / (m * m)
        + corrected(with(|cluster| cluster.solved)) * sum(&|cluster| cluster.of_solved.powi(2)) / (n * n)
        + 2.0 * corrected(all) * sum(&|cluster| cluster.of_failed * cluster.of_solved) / (m * n);
    // With one cluster of a kind nothing is known about the variance between clusters.
    if clustered.is_finite() { (clustered / independent).max(1.0) } else { (m + n).max(1.0) }
}

/// The AUCs whose standardised distance from `auc` is at most the 97.5th percentile of a normal variable.
fn interval(auc: f64, failed: usize, solved: usize, design_effect: f64) -> [f64; 2] {
    let z = score::upper_quantile(0.025);
    let [m, n] = [failed, solved].map(|count| count as f64);
    let half = f64::midpoint(m, n) - 1.0;
    let variance = |area: f64| {
        let shape = 1.0 + half * ((1.0 - area) / (2.0 - area) + area / (1.0 + area));
        design_effect * area * (1.0 - area) * shape / (m * n)
    };
    let holds = |area: f64| (auc - area).abs() <= z * variance(area).sqrt();
    let end = |mut outside: f64| {
        let mut inside = auc;
        // 60 halvings of at most 1 leave an error below 1e-18.
        for _ in 0..60 {
            let middle = f64::midpoint(inside, outside);
            *if holds(middle) { &mut inside } else { &mut outside } = middle;
        }
        inside
    };
    [end(0.0), end(1.0)]
}

/// A density of errors: the mean of normal kernels on the logarithm to base 10, with Scott's bandwidth, n^(-1/5) standard
/// deviations (Scott, "Multivariate density estimation", 1992).
#[derive(Clone, Debug)]
pub struct Density {
    logarithms: Vec<f64>,
    bandwidth: f64,
}

impl Density {
    /// The density of some errors; `None` unless two of them are positive and different.
    pub fn of(errors: &[f64]) -> Option<Self> {
        let logarithms: Vec<f64> = errors.iter().filter(|error| **error > 0.0).map(|error| error.log10()).collect();
        let n = logarithms.len() as f64;
        let mean = logarithms.iter().sum::<f64>() / n;
        let variance = logarithms.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / (n - 1.0);
        let bandwidth = variance.sqrt() * n.powf(-0.2);
        (bandwidth.is_finite() && bandwidth > 0.0).then_some(Self { logarithms, bandwidth })
    }

    /// The density at a logarithm.
    pub fn at(&self, logarithm: f64) -> f64 {
        let kernel = |value: &f64| (-0.5 * ((logarithm - value) / self.bandwidth).powi(2)).exp();
        let sum: f64 = self.logarithms.iter().map(kernel).sum();
        sum / (self.logarithms.len() as f64 * self.bandwidth * std::f64::consts::TAU.sqrt())
    }

    /// The logarithms between which almost all of the density lies.
    pub fn range(&self) -> [f64; 2] {
        let ends = |start: f64, of: fn(f64, f64) -> f64| self.logarithms.iter().copied().fold(start, of);
        let room = 4.0 * self.bandwidth;
        [ends(f64::INFINITY, f64::min) - room, ends(f64::NEG_INFINITY, f64::max) + room]
    }

    /// The area that two densities share, by the trapezoidal rule.
    fn overlap(&self, other: &Self) -> f64 {
        let [a, b] = [self.range(), other.range()];
        let (low, high) = (a[0].min(b[0]), a[1].max(b[1]));
        let step = (high - low) / (POINTS - 1) as f64;
        let shared = |i: usize| {
            let at = low + i as f64 * step;
            self.at(at).min(other.at(at))
        };
        let inner: f64 = (1..POINTS - 1).map(shared).sum();
        (step * (inner + f64::midpoint(shared(0), shared(POINTS - 1)))).min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use crate::results::Trajectory;
    use rand::Rng as _;

    type Errors = Vec<(f64, usize)>;

    /// Errors that the test's expected values were computed from, in `clusters` clusters.
    fn errors(count: usize, offset: usize, clusters: usize) -> Errors {
        (0..count).map(|i| (((i * 37 + offset) % 101 + 1) as f64 / 50.0, i % clusters)).collect()
    }

    #[test]
    fn areas_intervals_and_overlaps_equal_those_of_scipy() {
        // With scipy 1.17.1 and numpy 2.4.6: the AUC is mannwhitneyu's statistic / (m n); the variances are DeLong's and
        // Obuchowski's formulas on numpy arrays; the ends are roots found by optimize.brentq; the overlap is the trapezoidal
        // rule on gaussian_kde of log10.
        let apart = |errors: Errors| errors.into_iter().map(|(error, at)| (error, at + 1000)).collect();
        let expected: [(_, Errors, [f64; 5]); 4] = [
            (
                errors(30, 0, 30),
                apart(errors(40, 11, 40)),
                [0.4970833333333333, 0.36555913659913214, 0.6290885520289115, 1.0, 0.9775398829199159],
            ),
            (
                errors(30, 5, 6),
                errors(40, 11, 8),
                [0.5216666666666666, 0.375552312980731, 0.663525196602336, 1.2177877310838847, 0.9732471102513812],
            ),
            (
                errors(120, 3, 17),
                errors(136, 50, 23),
                [0.49136029411764703, 0.4214323255716425, 0.5617004229965402, 1.0, 0.9860264500001525],
            ),
            (
                errors(5, 60, 5),
                errors(60, 0, 9),
                [0.5416666666666666, 0.30211148274126687, 0.7611256673075901, 1.0, 0.845877865336532],
            ),
        ];
        for (failed, solved, expected) in expected {
            let found = Discrimination::of(&failed, &solved).expect("both kinds");
            let values = [found.auc, found.low, found.high, found.design_effect, found.overlap.expect("an overlap")];
            assert!(values.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9), "{values:?}, not {expected:?}");
            assert_eq!(found.verdict, Predicts::Undecided);
        }
    }

    #[test]
    fn verdicts_follow_the_interval() {
        let of = |failed: &[f64], solved: &[f64]| {
            let own = |errors: &[f64], first: usize| errors.iter().copied().zip(first..).collect::<Vec<_>>();
            Discrimination::of(&own(failed, 0), &own(solved, failed.len())).expect("both kinds")
        };
        let apart = of(&[3.0, 4.0, 5.0, 6.0, 7.0], &[1.0, 2.0, 0.5, 0.7, 0.1]);
        assert!((apart.auc, apart.high) == (1.0, 1.0) && apart.low > 0.5 && apart.low < 0.9, "{apart:?}");
        assert_eq!(apart.verdict, Predicts::Yes);
        let few = of(&[3.0], &[1.0]);
        assert!((few.verdict, few.overlap) == (Predicts::Undecided, None) && few.low < 0.5, "{few:?}");
        let grid: Vec<f64> = (0..2000).map(|i| 1.0 + f64::from(i) / 500.0).collect();
        let same = of(&grid, &grid);
        assert!((same.auc, same.verdict) == (0.5, Predicts::No) && same.overlap.is_some_and(|o| o > 0.999), "{same:?}");
        assert_eq!(of(&[0.0, 0.0], &[0.0]).overlap, None);
        assert!(Discrimination::of(&[], &[(1.0, 0)]).is_none());
    }

    #[test]
    fn intervals_hold_their_level_with_clusters() {
        // Failed and solved trajectories of 30 episodes with errors of their own: independent intervals would miss often.
        let (mut rng, mut missed, mut missed_independent) = (Key::new(3).with("clusters").rng(), 0, 0);
        for _ in 0..400 {
            let (mut failed, mut solved) = (vec![], vec![]);
            for cluster in 0..30 {
                let (own, kind): (f64, f64) = (rng.random(), rng.random());
                for _ in 0..8 {
                    let error = 2.0 * own + rng.random::<f64>();
                    let is_failed = rng.random::<f64>() < 0.2 + 0.6 * kind;
                    if is_failed { &mut failed } else { &mut solved }.push((error, cluster));
                }
            }
            let found = Discrimination::of(&failed, &solved).expect("both kinds");
            let [low, high] = interval(found.auc, failed.len(), solved.len(), 1.0);
            missed += usize::from(found.low > 0.5 || found.high < 0.5);
            missed_independent += usize::from(low > 0.5 || high < 0.5);
        }
        // 5 % of 400 are 20, with a standard deviation of 4.4.
        assert!(missed <= 36 && missed_independent > 40, "{missed} and {missed_independent} of 400");
    }

    #[test]
    fn errors_of_unknown_outcomes_are_left_out() {
        let trajectory = |success, error| Trajectory { start: [1, 0], success, errors: vec![error] };
        let all = [(Some(true), 1.0), (None, 9.0), (Some(false), 2.0), (Some(true), f64::NAN)];
        let prediction = Prediction::new(5, 1.0, all.map(|(success, error)| trajectory(success, error)).to_vec());
        let found = ErrorAndSuccess::of(&prediction);
        assert_eq!((&found.solved[..], &found.failed[..]), (&[1.0][..], &[2.0][..]));
        assert_eq!(found.discrimination.map(|found| found.auc), Some(1.0));
    }
}
