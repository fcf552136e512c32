//! Confidence sequences and e-values: statistics that hold although the results decide when an evaluation stops.
//!
//! A Wilson interval and a score test hold for a number of episodes that is fixed in advance. Computed again and again until
//! one of them pleases, they are wrong more often than they say. Here, a gambler bets against the hypothesis that outcomes between 0
//! and 1 have the mean m. Under the hypothesis the expected capital stays 1, so the capital ever reaches 1 / α with a
//! probability of at most α (Ville 1939): it is an *e-value*. The means against which the capital is below 1 / α make an
//! interval that holds at all numbers of outcomes at once: a *confidence sequence* (Waudby-Smith and Ramdas, "Estimating
//! means of bounded random variables by betting", 2023).
//!
//! The gambler is Cover's universal portfolio of two stocks ("Universal portfolios", 1991; as a confidence sequence, Orabona
//! and Jun, "Tight concentrations and confidence sequences from the regret of universal portfolio", 2024). The bet with the
//! share q multiplies the capital by x q / m + (1 − x) (1 − q) / (1 − m) at the outcome x, and the capital is spread over
//! shares with the distribution Beta(1/2, 1/2). Every product is log-convex in m, so their mixture is, and the means that
//! are not rejected are an interval.
//!
//! For outcomes 0 and 1 the mixture is a ratio of Beta functions. For others it is the mean over the 256 nodes of the
//! Gauss–Chebyshev rule, which is a mixture too, so no property depends on its accuracy; up to 511 outcomes it equals the
//! integral. Outcomes must be independent, or at least have the mean m whatever came before. Several starts from one recorded episode
//! have not: what solves one tends to solve the next. Evaluations that their results end therefore take one start from each episode,
//! and for a fixed number of starts the mean over each episode is one outcome. With paired outcomes, x is 1 where only the first side succeeded, 0 where only the second did, and 1/2
//! otherwise: against equal rates, m = 1/2, only pairs that differ change the capital, and the bet is on a fair coin.

use statrs::function::beta::ln_beta;
use std::f64::consts::PI;

/// The number of shares over which the capital is spread.
const SHARES: usize = 256;
/// Halvings of an interval whose length is at most 1.
const HALVINGS: usize = 60;

/// Outcomes between 0 and 1, each with the number of its occurrences.
pub(super) type Outcomes<'a> = &'a [(f64, usize)];

/// Returns the interval of a rate at a level, which holds at all `n` at once.
pub(super) fn rate(successes: usize, n: usize, level: f64) -> [f64; 2] {
    let estimate = if n == 0 { 0.5 } else { successes as f64 / n as f64 };
    let holds = |rate: f64| log_capital_of_rate(successes, n.saturating_sub(successes), rate) < -level.ln();
    // At 0 and 1, the capital of a rate is infinite, except for outcomes that are all failures or all successes.
    let low = if successes == 0 { 0.0 } else { end(&holds, estimate, 0.0, None) };
    let high = if successes == n { 1.0 } else { end(&holds, estimate, 1.0, None) };
    [low, high]
}

/// Returns the interval of a mean at a level, which holds at all numbers of outcomes at once. It lies on one side of
/// `hypothesis` exactly if the capital against it reaches 1 / `level`.
pub(super) fn mean(outcomes: Outcomes<'_>, hypothesis: f64, level: f64) -> [f64; 2] {
    let n: usize = outcomes.iter().map(|(_, count)| count).sum();
    let sum: f64 = outcomes.iter().map(|(x, count)| x * *count as f64).sum();
    let estimate = if n == 0 { hypothesis } else { sum / n as f64 };
    let only = |extreme: f64| outcomes.iter().all(|(x, count)| *count == 0 || *x == extreme);
    let holds = |mean: f64| log_capital(outcomes, mean) < -level.ln();
    let low = if only(0.0) { 0.0 } else { end(&holds, estimate, 0.0, Some(hypothesis)) };
    let high = if only(1.0) { 1.0 } else { end(&holds, estimate, 1.0, Some(hypothesis)) };
    [low, high]
}

/// Returns an interval that lies on the same side of `hypothesis` as [`mean`]'s: the estimate alone if the capital rejects the
/// hypothesis, which takes one capital instead of a search for the ends.
pub(super) fn against(outcomes: Outcomes<'_>, hypothesis: f64, level: f64) -> [f64; 2] {
    if hypothesis <= 0.0 || hypothesis >= 1.0 {
        // The capital is not finite there.
        return mean(outcomes, hypothesis, level);
    }
    if log_capital(outcomes, hypothesis) < -level.ln() {
        return [0.0, 1.0];
    }
    let n: usize = outcomes.iter().map(|(_, count)| count).sum();
    [outcomes.iter().map(|(x, count)| x * *count as f64).sum::<f64>() / n.max(1) as f64; 2]
}

/// Returns the last value between `inside`, which holds, and `outside` that holds. It lies beyond `hypothesis` exactly if
/// `hypothesis` holds.
fn end(holds: &dyn Fn(f64) -> bool, mut inside: f64, mut outside: f64, hypothesis: Option<f64>) -> f64 {
    let is_between = |x: f64| (x - inside) * (x - outside) < 0.0;
    if let Some(hypothesis) = hypothesis.filter(|x| is_between(*x)) {
        *if holds(hypothesis) { &mut inside } else { &mut outside } = hypothesis;
    }
    for _ in 0..HALVINGS {
        let middle = f64::midpoint(inside, outside);
        *if holds(middle) { &mut inside } else { &mut outside } = middle;
    }
    inside
}

/// Returns the natural logarithm of the capital against the hypothesis that successes have the probability `rate`,
/// between 0 and 1.
fn log_capital_of_rate(successes: usize, failures: usize, rate: f64) -> f64 {
    let [successes, failures] = [successes, failures].map(|count| count as f64);
    ln_beta(successes + 0.5, failures + 0.5) - PI.ln() - successes * rate.ln() - failures * (-rate).ln_1p()
}

/// Returns the natural logarithm of the capital against the hypothesis that outcomes have the mean `mean`, between 0 and 1.
pub(super) fn log_capital(outcomes: Outcomes<'_>, mean: f64) -> f64 {
    let of_share = |i: usize| {
        let (sine, cosine) = ((i as f64 + 0.5) * 0.5 * PI / SHARES as f64).sin_cos();
        let payoffs = [sine * sine / mean, cosine * cosine / (1.0 - mean)];
        let logs = outcomes.iter().filter(|(_, count)| *count > 0);
        logs.map(|(x, count)| *count as f64 * (x * payoffs[0] + (1.0 - x) * payoffs[1]).ln()).sum::<f64>()
    };
    let logs: [f64; SHARES] = std::array::from_fn(of_share);
    let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    largest + (logs.iter().map(|log| (log - largest).exp()).sum::<f64>() / SHARES as f64).ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;
    use rand::Rng as _;

    /// The rates at which the level is tested.
    const RATES: [f64; 6] = [0.01, 0.1, 0.3, 0.5, 0.9, 0.99];
    const REPETITIONS: usize = 10_000;

    /// The largest share of wrong repetitions that chance explains, with three Monte Carlo errors.
    fn most(level: f64) -> f64 {
        level + 3.0 * (level * (1.0 - level) / REPETITIONS as f64).sqrt()
    }

    #[test]
    fn intervals_equal_those_of_scipy() {
        // scipy 1.17.1: brentq on special.betaln.
        for (successes, n, level, low, high) in [
            (0, 10, 0.05, 0.0, 0.3769873509906774),
            (10, 10, 0.05, 0.6230126490093226, 1.0),
            (1, 10, 0.05, 0.000465624074390634, 0.5440086761068236),
            (7, 10, 0.05, 0.2524128900850035, 0.9674848602119411),
            (49, 50, 0.05, 0.844905233456335, 0.9999597240066187),
            (450, 1400, 0.05, 0.27651572944831165, 0.3686622843676416),
            (3, 1000, 0.05, 0.0001238737540981121, 0.014312154132124558),
            (5000, 10_000, 0.05, 0.480225526233934, 0.5197744737660664),
            (37, 80, 0.05 / 13.0, 0.25512553017290057, 0.6792730172708817),
        ] {
            let found = rate(successes, n, level);
            assert!((found[0] - low).abs() < 1e-9 && (found[1] - high).abs() < 1e-9, "{successes} of {n}: {found:?}");
        }
        // Pairs: the capital's integral by mpmath 1.3 with 25 digits, its roots by the secant method.
        for (a, b, rest, level, low, high, log) in [
            (7, 1, 13, 0.05, -0.1075914869546384, 0.6387512372563923, 1.2094266550083998),
            (40, 20, 100, 0.05, -0.03182033240095118, 0.2807520684259613, 1.1205035676719064),
            (0, 25, 25, 0.05 / 12.0, -0.7545197216576875, -0.2220968554264483, 15.14187699181336),
            (0, 0, 30, 0.05, -0.14051408479908513, 0.14051408479908513, 0.0),
        ] {
            let outcomes = [(1.0, a), (0.0, b), (0.5, rest)];
            let found = mean(&outcomes, 0.5, level).map(|mean| 2.0 * mean - 1.0);
            assert!((found[0] - low).abs() < 1e-9 && (found[1] - high).abs() < 1e-9, "{a} {b} {rest}: {found:?}");
            assert!((log_capital(&outcomes, 0.5) - log).abs() < 1e-9, "{}", log_capital(&outcomes, 0.5));
        }
    }

    #[test]
    fn miscoverage_of_a_rate_is_at_most_the_level_when_the_first_exclusion_stops() {
        const EPISODES: usize = 1000;
        for (i, truth) in RATES.into_iter().enumerate() {
            // The numbers of successes whose interval holds the truth, after each number of episodes.
            let held: Vec<(usize, usize)> = (0..=EPISODES)
                .map(|n| {
                    let holds = |s: &usize| log_capital_of_rate(*s, n - s, truth) < -0.05f64.ln();
                    ((0..=n).find(holds).expect("an interval"), (0..=n).rev().find(holds).expect("an interval"))
                })
                .collect();
            let mut wrong = 0;
            for repetition in 0..REPETITIONS {
                let mut rng = Key::new(19).with("coverage").at(i as u64).at(repetition as u64).rng();
                let mut successes = 0;
                wrong += usize::from((1..=EPISODES).any(|n| {
                    successes += usize::from(rng.random_bool(truth));
                    !(held[n].0..=held[n].1).contains(&successes)
                }));
            }
            let share = wrong as f64 / REPETITIONS as f64;
            assert!(share <= most(0.05) && share > 0.002, "rate {truth}: {share}");
        }
    }

    #[test]
    fn intervals_hold_the_rates_that_the_capital_does_not_reject() {
        for n in [1, 2, 9, 40, 333] {
            for successes in 0..=n {
                let [low, high] = rate(successes, n, 0.05);
                for truth in RATES {
                    let held = log_capital_of_rate(successes, n - successes, truth) < -0.05f64.ln();
                    assert_eq!((low..=high).contains(&truth), held, "{successes} of {n}: {low} {high}, {truth}");
                }
                let by_nodes = mean(&[(1.0, successes), (0.0, n - successes)], 0.5, 0.05);
                assert!((by_nodes[0] - low).abs() < 1e-9 && (by_nodes[1] - high).abs() < 1e-9, "{by_nodes:?}");
            }
        }
        assert_eq!(rate(0, 0, 0.05), [0.0, 1.0]);
    }

    #[test]
    fn wrong_verdicts_on_pairs_are_at_most_the_level_when_the_first_one_stops() {
        // Equal rates, of which a share of pairs differs; each look after ten pairs.
        for (i, discordant) in [0.05, 0.3, 1.0].into_iter().enumerate() {
            let (mut wrong, level) = (0, 0.05f64 / 3.0);
            for repetition in 0..REPETITIONS {
                let mut rng = Key::new(19).with("pairs").at(i as u64).at(repetition as u64).rng();
                let (mut a, mut b) = (0, 0);
                wrong += usize::from((0..40).any(|_| {
                    for _ in 0..10 {
                        if rng.random_bool(discordant) {
                            *if rng.random_bool(0.5) { &mut a } else { &mut b } += 1;
                        }
                    }
                    log_capital_of_rate(a, b, 0.5) >= -level.ln()
                }));
            }
            let share = wrong as f64 / REPETITIONS as f64;
            assert!(share <= most(level), "{discordant} differ: {share}");
        }
    }

    #[test]
    fn miscoverage_of_a_difference_is_at_most_the_level() {
        // Chances that only the first and only the second side succeeds. Looks at 10, 20, 40 ... pairs.
        for (i, [first, second]) in [[0.3, 0.1], [0.02, 0.6], [0.2, 0.2]].into_iter().enumerate() {
            let (mut wrong, repetitions) = (0, 2000);
            for repetition in 0..repetitions {
                let mut rng = Key::new(19).with("difference").at(i as u64).at(repetition).rng();
                let (mut a, mut b, mut n) = (0, 0, 0);
                wrong += usize::from([10, 20, 40, 80, 160, 320].into_iter().any(|pairs| {
                    while n < pairs {
                        let draw = rng.random::<f64>();
                        a += usize::from(draw < first);
                        b += usize::from((first..first + second).contains(&draw));
                        n += 1;
                    }
                    let truth = (1.0 + first - second) / 2.0;
                    log_capital(&[(1.0, a), (0.0, b), (0.5, n - a - b)], truth) >= -0.05f64.ln()
                }));
            }
            let share = wrong as f64 / repetitions as f64;
            assert!(share <= 0.05 + 3.0 * (0.05 * 0.95 / repetitions as f64).sqrt(), "{first} {second}: {share}");
        }
    }

    #[test]
    fn intervals_exclude_the_hypothesis_exactly_if_the_capital_rejects_it() {
        for (a, b) in (0..9).flat_map(|a| (0..9).map(move |b| (a, b))) {
            for (rest, level) in [(0, 0.05), (40, 0.05 / 3.0)] {
                let outcomes = [(1.0, a), (0.0, b), (0.5, rest)];
                let [low, high] = mean(&outcomes, 0.5, level);
                let rejected = log_capital(&outcomes, 0.5) >= -level.ln();
                let side = |[low, high]: [f64; 2]| (low > 0.5, high < 0.5);
                assert_eq!(side(against(&outcomes, 0.5, level)), side([low, high]), "{a} {b} {rest}");
                assert_eq!(rejected, low > 0.5 || high < 0.5, "{a} {b} {rest}: {low} {high}");
                assert!((0.0..=1.0).contains(&low) && low <= high && high <= 1.0, "{a} {b} {rest}: {low} {high}");
                let [other_low, other_high] = mean(&[(1.0, b), (0.0, a), (0.5, rest)], 0.5, level);
                assert!((low + other_high - 1.0).abs() < 1e-9 && (high + other_low - 1.0).abs() < 1e-9);
            }
        }
    }
}
