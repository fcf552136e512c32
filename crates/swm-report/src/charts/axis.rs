//! [`Axis`]: the range of an axis and how its ticks are written, for values of any size.

use crate::text::number;
use std::ops::Range;

/// The range of an axis. Values of files may be of any size, so drawings contain them in units of a power of ten.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Axis {
    low: f64,
    high: f64,
    unit: f64,
}

impl Axis {
    /// An axis over these values; `None` if a value is not finite, or the values are too large or too small to draw.
    pub(super) fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values {
            if !value.is_finite() {
                return None;
            }
            (low, high) = (low.min(value), high.max(value));
        }
        let largest = low.abs().max(high.abs());
        if low > high || largest > 1e100 {
            return None;
        }
        let unit = if largest < 1e-100 { 1.0 } else { 10f64.powf(largest.log10().floor()) };
        Some(Self { low: low / unit, high: high / unit, unit })
    }

    /// An axis from 0 to 100 %.
    pub(super) fn percent() -> Self {
        Self { low: 0.0, high: 100.0, unit: 1.0 }
    }

    /// This axis with some room beyond its ends; values that differ too little for ticks get more.
    pub(super) fn with_room(self) -> Self {
        let room = (0.04 * (self.high - self.low)).max(1e-4);
        Self { low: self.low - room, high: self.high + room, ..self }
    }

    /// The range in units of the drawing.
    pub(super) fn range(self) -> Range<f64> {
        let room = if self.high - self.low < 1e-5 { 0.5 } else { 0.0 };
        self.low - room..self.high + room
    }

    /// The share of the axis below a value, 0 to 1.
    pub(super) fn share(self, value: f64) -> f64 {
        let range = self.range();
        let share = (value / self.unit - range.start) / (range.end - range.start);
        if share.is_finite() { share.clamp(0.0, 1.0) } else { 0.0 }
    }

    /// The value of a tick of the drawing, without the rounding errors of the drawing's arithmetic.
    pub(super) fn value(self, drawn: f64) -> f64 {
        (drawn * 1e6).round() / 1e6 * self.unit
    }

    /// A tick of the drawing, in words.
    pub(super) fn tick(self, drawn: f64) -> String {
        let value = self.value(drawn);
        match value.abs() {
            0.0 => "0".to_owned(),
            size if !(1e-3..1e5).contains(&size) => format!("{value:.1e}").replace(".0e", "e"),
            _ => number(value),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_any_size_have_an_axis_or_none() {
        for values in [vec![], vec![f64::NAN, 1.0], vec![0.0, f64::INFINITY], vec![-1e300, 2.0]] {
            assert_eq!(Axis::of(values.into_iter()), None);
        }
        for values in [[0.0, 1e-7], [5.0, 5.0], [0.0, 0.0], [-3e38, 1.0], [1e15, 1e15 + 2.0], [0.0, 5e-324]] {
            let axis = Axis::of(values.into_iter()).expect("an axis");
            for axis in [axis, axis.with_room()] {
                let range = axis.range();
                assert!(range.end - range.start > 1e-5 && range.end.abs() < 20.0, "{values:?} {range:?}");
                assert!(values.iter().all(|value| (0.0..=1.0).contains(&axis.share(*value))), "{values:?}");
            }
        }
    }

    #[test]
    fn ticks_are_short() {
        let axis = Axis::of([0.0, 3e-7].into_iter()).expect("an axis");
        assert_eq!([axis.tick(0.0), axis.tick(2.0), axis.tick(2.500_000_01)], ["0", "2e-7", "2.5e-7"]);
        let axis = Axis::of([0.0, 250.0].into_iter()).expect("an axis");
        assert_eq!([axis.tick(1.5), axis.tick(0.300_000_000_04)], ["150", "30"]);
    }
}
