//! [`check`]: whether single precision, in which models and probes compute, tells the values of a column apart. [`Spread`]
//! collects what it needs to know.

use crate::{DType, Error, Result};

/// The smallest magnitude that is checked: below, what single precision loses is the noise of a simulator.
const SMALLEST: f64 = 1e4;
/// The standard deviation up to which values count as constant.
pub const CONSTANT: f64 = 1e-6;
/// The standard deviation up to which values that should be zero are noise of a simulator.
pub const NOISE: f64 = 1e-14;
/// The largest rounding error, in standard deviations.
const LARGEST_ERROR: f64 = 1e-2;
/// Whole numbers up to this magnitude are single-precision numbers.
const EXACT_WHOLE: f64 = 16_777_216.0;

/// Returns the largest rounding error of values of this type up to a magnitude.
pub fn rounding(dtype: DType, largest: f64) -> f64 {
    let is_exact = dtype == DType::Float32 || (dtype != DType::Float64 && largest <= EXACT_WHOLE);
    if is_exact { 0.0 } else { largest * f64::from(f32::EPSILON) / 2.0 }
}

/// Checks that single precision tells the values of element `index` of `column` apart: their largest magnitude is `largest`,
/// their standard deviation `deviation`, and rounding changes them by at most `error`.
///
/// # Errors
/// When a value is beyond its range, or values above 10,000 are rounded by more than a hundredth of their standard deviation.
pub fn check(column: &str, index: usize, largest: f64, deviation: f64, error: f64) -> Result<()> {
    let is_rounded = largest >= SMALLEST && deviation > CONSTANT && error > LARGEST_ERROR * deviation;
    if largest <= f64::from(f32::MAX) && !is_rounded {
        return Ok(());
    }
    Err(Error::config(
        format!("column '{column}', element {index}"),
        format!(
            "its values, up to {largest:e} with a standard deviation of {deviation:.3e}, are rounded too coarsely in single \
             precision"
        ),
        "subtract an offset or divide by a scale when you collect, or leave the column out",
    ))
}

/// The magnitude and the standard deviation of the values of one element of a column.
#[derive(Clone, Copy, Debug, Default)]
pub struct Spread {
    /// The first value, from which differences are taken, so that an offset does not hide them.
    first: Option<f64>,
    count: f64,
    sum: f64,
    squares: f64,
    largest: f64,
    /// The largest rounding error.
    error: f64,
}

impl Spread {
    /// Whether columns of this type may have values that single precision does not hold.
    pub const fn is_needed(dtype: DType) -> bool {
        matches!(dtype, DType::Float64 | DType::Int64 | DType::Int32)
    }

    /// Adds a value; NaN and infinite values are left out.
    pub fn add(&mut self, value: f64) {
        if !value.is_finite() {
            return;
        }
        let difference = value - *self.first.get_or_insert(value);
        self.count += 1.0;
        self.sum += difference;
        self.squares += difference * difference;
        self.largest = self.largest.max(value.abs());
        self.error = self.error.max((f64::from(value as f32) - value).abs());
    }

    /// The standard deviation of the values; 0 without values.
    pub fn deviation(&self) -> f64 {
        let mean = self.sum / self.count.max(1.0);
        (self.squares / self.count.max(1.0) - mean * mean).max(0.0).sqrt()
    }

    /// Checks the values, which are element `index` of `column`.
    ///
    /// # Errors
    /// As [`check`].
    pub fn check(&self, column: &str, index: usize) -> Result<()> {
        check(column, index, self.largest, self.deviation(), self.error)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn checked(values: impl Iterator<Item = f64>) -> std::result::Result<(), String> {
        let mut spread = Spread::default();
        values.for_each(|value| spread.add(value));
        spread.check("x", 3).map_err(|error| error.to_string())
    }

    #[test]
    fn whole_numbers_are_not_rounded_up_to_24_bits() {
        assert_eq!([DType::Float32, DType::Int64].map(|dtype| rounding(dtype, 1e6)), [0.0; 2]);
        assert!(rounding(DType::Int64, 1e9) > 1.0 && rounding(DType::Float64, 1e6) > 0.01);
    }

    #[test]
    fn values_that_single_precision_does_not_tell_apart_are_refused() {
        let steps = || (0..100).map(f64::from);
        for (name, values) in [
            ("an offset", Box::new(steps().map(|x| x + 1e9)) as Box<dyn Iterator<Item = f64>>),
            ("the clock", Box::new(steps().map(|x| 1.7e9 + 0.05 * x))),
            ("beyond the range", Box::new(steps().map(|x| 1e37 * x))),
        ] {
            let error = checked(values).expect_err(name);
            assert!(error.contains("column 'x', element 3") && error.contains("offset"), "{name}: {error}");
        }
        for (name, values) in [
            ("moderate", Box::new(steps().map(|x| x + 1e4)) as Box<dyn Iterator<Item = f64>>),
            ("small", Box::new(steps().map(|x| 1e-11 * x))),
            ("large", Box::new(steps().map(|x| 1e30 * x))),
            ("noise of a constant", Box::new(steps().map(|x| 1.0 + 1e-12 * x))),
            ("whole numbers", Box::new(steps().map(|x| x + 1e6))),
            ("halves", Box::new(steps().map(|x| 1e5 + 0.5 * x))),
            ("a large constant", Box::new(steps().map(|_| 1e20))),
            ("not finite", Box::new([f64::NAN, f64::INFINITY].into_iter())),
            ("empty", Box::new(std::iter::empty())),
        ] {
            checked(values).expect(name);
        }
    }
}
