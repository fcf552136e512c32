//! The score test of equal rates on paired outcomes, and Tango's interval of the difference, which is its inversion.
//!
//! Tango, "Equivalence test and confidence interval for the difference in proportions for the paired-sample design",
//! 1998. The interval at a level holds exactly those differences that the test at this level does not reject.

use statrs::distribution::{ContinuousCDF as _, Normal};
use statrs::function::erf::erfc;

/// Returns the z such that a standard normal variable lies beyond z with this probability.
pub(super) fn upper_quantile(probability: f64) -> f64 {
    -Normal::standard().inverse_cdf(probability)
}

/// Returns the two-sided p-value of the hypothesis that the outcomes `only_a` and `only_b` are equally likely: the
/// statistic is (a - b) / √(f (a + b)), with the design effect f.
pub(super) fn test(only_a: usize, only_b: usize, design_effect: f64) -> f64 {
    let variance = design_effect * (only_a + only_b) as f64;
    if variance == 0.0 { 1.0 } else { erfc(only_a.abs_diff(only_b) as f64 / (2.0 * variance).sqrt()) }
}

/// Returns the design effect of clusters of pairs, each with its a - b: the variance of the sum of a - b relative to that
/// of independent pairs, Σ (a - b)² / Σ (a + b), and at least 1.
///
/// The test with this variance is that of Yang, Sun and Hardin, "A note on the tests for clustered matched-pair binary
/// data", 2010; the interval divides all counts by the design effect (Rao and Scott, "A simple method for the analysis of
/// clustered binary data", 1992), and so remains the inversion of the test at 0.
pub(super) fn design_effect(clusters: impl Iterator<Item = i64>, discordant: usize) -> f64 {
    let squares: f64 = clusters.map(|excess| (excess * excess) as f64).sum();
    if discordant == 0 { 1.0 } else { (squares / discordant as f64).max(1.0) }
}

/// Returns the interval of the difference (a - b) / n of `n` pairs: the differences whose statistic is between -z and z.
///
/// It is [-1, 1] without pairs.
pub(super) fn interval(only_a: usize, only_b: usize, n: usize, design_effect: f64, z: f64) -> [f64; 2] {
    if n == 0 {
        return [-1.0, 1.0];
    }
    let [a, b, n] = [only_a, only_b, n].map(|count| count as f64 / design_effect);
    [-upper(b, a, n, z), upper(a, b, n, z)]
}

/// Returns the largest difference that the test does not reject. It is below 0 exactly if the test rejects 0.
fn upper(a: f64, b: f64, n: f64, z: f64) -> f64 {
    let holds = |difference: f64| statistic(a, b, n, difference) >= -z;
    if holds(1.0) {
        return 1.0;
    }
    let (mut inside, mut outside) = ((a - b) / n, 1.0);
    if inside < 0.0 {
        *if holds(0.0) { &mut inside } else { &mut outside } = 0.0;
    }
    // The statistic falls with the difference. 60 halvings of at most 2 leave an error below 2e-18.
    for _ in 0..60 {
        let middle = 0.5 * (inside + outside);
        *if holds(middle) { &mut inside } else { &mut outside } = middle;
    }
    inside
}

/// Returns the score statistic of the hypothesis that the rates differ by `difference`.
///
/// The variance is that of the maximum-likelihood estimate under the hypothesis: the probability q of the outcome
/// `only b` solves 2n q² + (linear) q + (constant) = 0 (Tango 1998, section 3).
fn statistic(a: f64, b: f64, n: f64, difference: f64) -> f64 {
    if difference < 0.0 {
        return -statistic(b, a, n, -difference);
    }
    let spread = difference * (1.0 - difference);
    let linear = (2.0 * n - a + b) * difference - a - b;
    // The constant is at most 0, so the larger root is not negative. The branches avoid the difference of near values.
    let constant = -b * spread;
    let root = (linear * linear - 8.0 * n * constant).sqrt();
    let q = if linear > 0.0 { -2.0 * constant / (linear + root) } else { (root - linear) / (4.0 * n) };
    let excess = a - b - n * difference;
    if excess == 0.0 { 0.0 } else { excess / (n * (2.0 * q + spread)).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use rand::Rng as _;

    /// Tables `[both, only_a, only_b, neither]`, a level, the interval and the p-value. The values come from another
    /// way of computing: the likelihood under each difference is maximised by bisection of its derivative, and the ends
    /// are found by bisection, with 40 digits (mpmath 1.4.1); p-values equal scipy 1.17.1's `2 * norm.sf`.
    const EXPECTED: [([usize; 4], f64, f64, f64, f64); 17] = [
        ([1, 1, 7, 12], 0.05, -0.5172322764213774, -0.02600303248086854, 0.03389485352468927),
        ([60, 40, 20, 40], 0.05, 0.03086453313308672, 0.2180642441668248, 0.009823274507519248),
        ([43, 0, 1, 0], 0.05, -0.1180770969821329, 0.05939323111662797, 0.3173105078629141),
        ([30, 0, 0, 0], 0.05, -0.1135133931739688, 0.1135133931739688, 1.0),
        ([0, 0, 0, 5], 0.01, -0.5702583210270093, 0.5702583210270093, 1.0),
        ([36, 12, 2, 0], 0.05, 0.06111240618634398, 0.3447087482821487, 0.007526315166457886),
        ([0, 10, 0, 0], 0.05, 0.4449344002742215, 1.0, 0.00156540225800255),
        ([0, 0, 10, 0], 0.05, -1.0, -0.4449344002742215, 0.00156540225800255),
        ([3, 4, 0, 3], 0.05, 0.01145408019195505, 0.6873262302663417, 0.04550026389635841),
        ([20, 0, 25, 5], 0.05 / 12.0, -0.6877743798512568, -0.2884446936288555, 5.733031437583878e-7),
        ([45, 9, 30, 172], 0.05 / 26.0, -0.1651796388807393, -0.007135960528534063, 0.0007718664488286608),
        ([2, 1, 0, 0], 0.05, -0.415329375673394, 0.7923403991979523, 0.3173105078629141),
        ([0, 1, 0, 0], 0.05, -0.5869013712455252, 1.0, 0.3173105078629141),
        ([0, 1, 1, 0], 0.05, -0.8109375885315386, 0.8109375885315386, 1.0),
        ([400, 37, 16, 547], 0.001, -0.003262141830423918, 0.04823249021080603, 0.003919463169260792),
        ([10, 3, 3, 34], 0.1, -0.0920807620611603, 0.0920807620611603, 1.0),
        ([49, 0, 1, 0], 0.05 / 5998.0, -0.3119859079911856, 0.2699600178351158, 0.3173105078629141),
    ];

    #[test]
    fn intervals_and_p_values_equal_those_of_another_way_of_computing() {
        for (table, level, low, high, p) in EXPECTED {
            let [_, a, b, _] = table;
            let found = interval(a, b, table.iter().sum(), 1.0, upper_quantile(level / 2.0));
            assert!((found[0] - low).abs() < 1e-9 && (found[1] - high).abs() < 1e-9, "{table:?}: {found:?}");
            assert!((test(a, b, 1.0) - p).abs() <= 1e-9 * p, "{table:?}: {}", test(a, b, 1.0));
        }
    }

    #[test]
    fn intervals_match_published_values() {
        // Fagerland, Lydersen and Laake, "Recommended tests and confidence intervals for paired binomial proportions",
        // 2014: (1, 1, 7, 12) gives -0.517 to -0.026.
        let [low, high] = interval(1, 7, 21, 1.0, upper_quantile(0.025));
        assert!((low + 0.517).abs() < 5e-4 && (high + 0.026).abs() < 5e-4, "{low} {high}");
    }

    #[test]
    fn normal_quantiles_equal_those_of_scipy() {
        // scipy.stats.norm.isf of scipy 1.17.1.
        for (probability, z) in [
            (0.025, 1.9599639845400545),
            (0.2, 0.8416212335729143),
            (0.05 / 24.0, 2.8652602385321337),
            (0.05 / 52.0, 3.1018618337400943),
            (0.05 / 11996.0, 4.456364830747281),
        ] {
            assert!((upper_quantile(probability) - z).abs() < 1e-9, "{probability}");
        }
    }

    #[test]
    fn the_interval_holds_0_exactly_if_the_test_does_not_reject() {
        for (comparisons, effect) in [(1.0, 1.0), (2.0, 1.0), (3.0, 1.7), (13.0, 1.0), (200.0, 3.1)] {
            let (level, z) = (0.05 / comparisons, upper_quantile(0.025 / comparisons));
            for (a, b) in (0..=40).flat_map(|a| (0..=40).map(move |b| (a, b))) {
                for n in [a + b, a + b + 1, 2 * (a + b) + 7] {
                    let [low, high] = interval(a, b, n, effect, z);
                    let rejected = if a > b { low > 0.0 } else { high < 0.0 };
                    assert_eq!(rejected, test(a, b, effect) < level, "{a} {b} {n} {low} {high}");
                    assert!((-1.0..=1.0).contains(&low) && low <= high && high <= 1.0, "{a} {b} {n} {low} {high}");
                    let estimate = if n == 0 { 0.0 } else { (a as f64 - b as f64) / n as f64 };
                    assert!(low <= estimate && estimate <= high, "{a} {b} {n} {low} {high}");
                    assert_eq!(interval(b, a, n, effect, z), [-high, -low]);
                }
            }
        }
    }

    #[test]
    fn pairs_that_repeat_each_other_count_once() {
        // Every pair occurs twice: the variance doubles.
        let clusters = || [2, 2, 2, 2, 2, -2, 0].into_iter();
        let effect = design_effect(clusters(), 12);
        assert_eq!(effect, 2.0);
        assert!((test(10, 2, effect) - test(5, 1, 1.0)).abs() < 1e-12);
        let (twice, once) = (interval(10, 2, 40, effect, 1.96), interval(5, 1, 20, 1.0, 1.96));
        assert!((twice[0] - once[0]).abs() < 1e-12 && (twice[1] - once[1]).abs() < 1e-12);
        // Independent pairs, and pairs that repel each other, have no design effect.
        assert_eq!(design_effect([1, -1, 1].into_iter(), 3), 1.0);
        assert_eq!(design_effect([0, 0].into_iter(), 4), 1.0);
    }

    #[test]
    fn the_test_holds_its_level_for_clustered_pairs() {
        // Clusters of 1 to 5 pairs of equal outcomes, which favour either side with the same probability.
        let (mut corrected, mut naive, repetitions) = (0, 0, 4000);
        for repetition in 0..repetitions {
            let mut rng = Key::new(5).at(repetition).rng();
            let clusters: Vec<i64> =
                (0..60).map(|_| rng.random_range(1..=5) * [-1, 0, 1][rng.random_range(0..3)]).collect();
            let sum = |sign: i64| clusters.iter().map(|excess| (sign * excess).max(0) as usize).sum();
            let (a, b): (usize, usize) = (sum(1), sum(-1));
            let effect = design_effect(clusters.iter().copied(), a + b);
            corrected += usize::from(test(a, b, effect) < 0.05);
            naive += usize::from(test(a, b, 1.0) < 0.05);
        }
        let share = |count: usize| count as f64 / repetitions as f64;
        assert!((share(corrected) - 0.05).abs() < 0.015 && share(naive) > 0.2, "{corrected} {naive}");
    }
}
