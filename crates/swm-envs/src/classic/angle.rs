//! Angles that the `state` column represents as cosine and sine.

use std::f64::consts::PI;
use swm_core::{Error, Result};

/// Tolerance of the sum of the squares of a cosine and a sine, which should be 1.
const TOLERANCE: f64 = 1e-3;

/// Checks that two values are the cosine and the sine of one angle.
///
/// # Errors
/// When the sum of their squares is not 1.
pub fn check(what: &str, cos: f64, sin: f64) -> Result<()> {
    if ((cos * cos + sin * sin) - 1.0).abs() <= TOLERANCE {
        return Ok(());
    }
    let expected = "the cosine and the sine of one angle: their squares add up to 1".to_owned();
    Err(Error::OutOfSpace { what: what.to_owned(), given: format!("{:?}", [cos, sin]), expected })
}

/// Returns the angle of a cosine and a sine, in radians.
///
/// If cosine and sine are single-precision values, as in observations, the result is the middle of the interval of
/// angles that round to them. The restored angle then gives the same observation bit for bit.
pub fn from_cos_sin(cos: f64, sin: f64) -> f64 {
    if [cos, sin].iter().any(|&v| f64::from(v as f32) != v) {
        return sin.atan2(cos);
    }
    // The interval of double-precision values that round to a single-precision value.
    let rounding_interval = |v: f64| {
        let v = v as f32;
        let [below, above] = [v.next_down(), v.next_up()].map(|next| f64::midpoint(f64::from(v), f64::from(next)));
        (below.clamp(-1.0, 1.0), above.clamp(-1.0, 1.0))
    };
    let ((cos_low, cos_high), (sin_low, sin_high)) = (rounding_interval(cos), rounding_interval(sin));
    let side = if sin < 0.0 { -1.0 } else { 1.0 };
    let by_cos = [cos_high.acos() * side, cos_low.acos() * side];
    let by_sin = [sin_low.asin(), sin_high.asin()].map(|angle| if cos < 0.0 { PI * side - angle } else { angle });
    let low = by_cos[0].min(by_cos[1]).max(by_sin[0].min(by_sin[1]));
    let high = by_cos[0].max(by_cos[1]).min(by_sin[0].max(by_sin[1]));
    if low <= high { f64::midpoint(low, high) } else { sin.atan2(cos) }
}

/// Returns the rotation from one angle to another, between -π and π, in radians.
pub fn between(from: f64, to: f64) -> f64 {
    (to - from + PI).rem_euclid(2.0 * PI) - PI
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_restored_from_cosine_and_sine_give_the_same_observation() {
        for i in -20_000..=20_000 {
            let angle = f64::from(i) / 20_000.0 * PI;
            let observed = |angle: f64| [angle.cos() as f32, angle.sin() as f32];
            let [cos, sin] = observed(angle).map(f64::from);
            let back = from_cos_sin(cos, sin);
            assert!(between(angle, back).abs() < 1e-7, "{angle} was restored as {back}");
            assert_eq!(observed(back), observed(angle), "{angle}");
            assert!(check("angle", cos, sin).is_ok());
        }
        assert!(check("angle", 0.5, 0.5).is_err());
        let exact = 2.0f64;
        assert!((from_cos_sin(exact.cos(), exact.sin()) - exact).abs() < 1e-15, "double precision is not rounded");
        assert_eq!(
            from_cos_sin(0.625, 0.75),
            0.75f64.atan2(0.625),
            "a cosine and a sine whose squares do not sum to 1"
        );
    }
}
