//! The fit of an exponential decay to success rates: the chance of success is `exp(a - b x)`.

/// A fitted decay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Decay {
    /// The logarithm of the chance of success at 0; at most 0 where `x` is 0.
    pub intercept: f64,
    /// The rate `b`: success falls by the factor `exp(-b)` for each unit of `x`.
    pub rate: f64,
    /// The lower end of the 95 % interval of the rate.
    pub low: f64,
    /// The upper end.
    pub high: f64,
}

/// Successes of `n` episodes at `x`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    pub x: f64,
    pub successes: f64,
    pub n: f64,
}

/// Half of the 95 % quantile of the chi-squared distribution with one degree of freedom.
const HALF_QUANTILE: f64 = 1.920_729_410_347_062;
/// Steps of a search by sections, each of which keeps 0.618 of the interval.
const STEPS: usize = 90;

impl Decay {
    /// The most likely decay of independent counts, with the interval of its profile likelihood. `None` for fewer than
    /// three different `x`, a negative `x`, no success, or nothing but successes.
    pub(super) fn fit(points: &[Point]) -> Option<Self> {
        let mut different: Vec<f64> = points.iter().map(|point| point.x).collect();
        different.sort_by(f64::total_cmp);
        different.dedup();
        let valid = |p: &Point| p.x >= 0.0 && p.x.is_finite() && p.n > 0.0 && (0.0..=p.n).contains(&p.successes);
        let (successes, n) = points.iter().fold((0.0, 0.0), |(s, n), point| (s + point.successes, n + point.n));
        if different.len() < 3 || !points.iter().all(valid) || successes == 0.0 || successes == n {
            return None;
        }
        let scale = different.last().copied()?;
        // The likelihood is concave in both parameters, so its profile is concave in the rate. Beyond these rates, the
        // chance changes by a factor of e^40 over the data.
        let profile = |rate: f64| likelihood(points, best_intercept(points, rate), rate);
        let (least, most) = (-40.0 / scale, 40.0 / scale);
        let rate = maximum(&profile, least, most);
        let floor = profile(rate) - HALF_QUANTILE;
        let end = |outside: f64| crossing(|rate| profile(rate) - floor, rate, outside);
        Some(Self { intercept: best_intercept(points, rate), rate, low: end(least), high: end(most) })
    }

    /// The chance of success at `x`.
    pub(super) fn at(&self, x: f64) -> f64 {
        (self.intercept - self.rate * x).exp().min(1.0)
    }
}

/// The logarithm of the likelihood, without its constant.
fn likelihood(points: &[Point], intercept: f64, rate: f64) -> f64 {
    let term = |point: &Point| {
        let log = (intercept - rate * point.x).min(0.0);
        let failures = point.n - point.successes;
        // Without failures, the second term is 0 even where success is certain.
        let failed = if failures > 0.0 { failures * (-log.exp_m1()).max(f64::MIN_POSITIVE).ln() } else { 0.0 };
        point.successes * log + failed
    };
    points.iter().map(term).sum()
}

/// The most likely intercept for a rate, at which no chance is above 1.
fn best_intercept(points: &[Point], rate: f64) -> f64 {
    let highest = points.iter().map(|point| rate * point.x).fold(f64::INFINITY, f64::min);
    maximum(&|intercept| likelihood(points, intercept, rate), highest - 40.0, highest)
}

/// The maximum of a concave function, by golden sections.
fn maximum(function: &dyn Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    let golden = (5f64.sqrt() - 1.0) / 2.0;
    let (mut left, mut right) = (high - golden * (high - low), low + golden * (high - low));
    let (mut at_left, mut at_right) = (function(left), function(right));
    for _ in 0..STEPS {
        if at_left < at_right {
            (low, left, at_left) = (left, right, at_right);
            right = low + golden * (high - low);
            at_right = function(right);
        } else {
            (high, right, at_right) = (right, left, at_left);
            left = high - golden * (high - low);
            at_left = function(left);
        }
    }
    f64::midpoint(low, high)
}

/// Where a function that is positive inside and negative outside crosses 0; `outside` if it does not.
fn crossing(function: impl Fn(f64) -> f64, mut inside: f64, mut outside: f64) -> f64 {
    if function(outside) > 0.0 {
        return outside;
    }
    for _ in 0..STEPS {
        let middle = f64::midpoint(inside, outside);
        if function(middle) > 0.0 { inside = middle } else { outside = middle }
    }
    f64::midpoint(inside, outside)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points(x: &[f64], successes: &[f64], n: f64) -> Vec<Point> {
        x.iter().zip(successes).map(|(x, successes)| Point { x: *x, successes: *successes, n }).collect()
    }

    #[test]
    fn fits_are_those_of_scipy_and_statsmodels() {
        // The profile likelihood by scipy.optimize (minimize_scalar, brentq) of scipy 1.17; the rate of the first is that
        // of statsmodels' GLM with a binomial family and a log link, too.
        let counts = |x: &[f64], successes: &[f64], n| Decay::fit(&points(x, successes, n)).expect("a fit");
        let found = [
            counts(&[0.0, 1.0, 2.0, 4.0, 6.0, 8.0, 12.0, 16.0], &[45.0, 41.0, 38.0, 30.0, 24.0, 17.0, 10.0, 6.0], 50.0),
            counts(&[0.0, 1.0, 2.0, 4.0, 8.0, 16.0], &[47.0, 44.0, 43.0, 30.0, 9.0, 1.0], 50.0),
            counts(&[1.0, 2.0, 3.0], &[9.0, 10.0, 9.0], 10.0),
        ];
        let expected = [
            [-0.086_643_882, 0.118_264_846, 0.095_937_497, 0.142_192_921],
            [-0.033_638_134, 0.157_247_297, 0.126_214_222, 0.193_213_510],
            [-0.068_992_872, 0.0, -0.126_389_387, 0.126_389_387],
        ];
        for (decay, expected) in found.iter().zip(expected) {
            let given = [decay.intercept, decay.rate, decay.low, decay.high];
            assert!(given.iter().zip(expected).all(|(given, expected)| (given - expected).abs() < 1e-6), "{decay:?}");
        }
    }

    #[test]
    fn counts_without_a_decay_have_no_fit() {
        let x = [0.0, 1.0, 2.0];
        for (x, successes) in [
            (&x[..], [0.0, 0.0, 0.0]),
            (&x, [10.0, 10.0, 10.0]),
            (&[0.0, 1.0, 1.0], [9.0, 5.0, 4.0]),
            (&[-1.0, 0.0, 1.0], [9.0, 5.0, 4.0]),
            (&[0.0, 1.0, f64::INFINITY], [9.0, 5.0, 4.0]),
            (&x, [9.0, f64::NAN, 4.0]),
            (&x, [9.0, 11.0, 4.0]),
        ] {
            assert_eq!(Decay::fit(&points(x, &successes, 10.0)), None, "{x:?} {successes:?}");
        }
        let all_fail = Decay::fit(&points(&x, &[10.0, 0.0, 0.0], 10.0)).expect("an extreme decay");
        assert!(all_fail.low > 1.0 && all_fail.high.is_finite(), "{all_fail:?}");
    }
}
