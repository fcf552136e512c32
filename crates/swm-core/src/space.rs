//! [`Space`]: the set of values of an action, an observation or a factor of variation.
//!
//! A value of any space is a slice of `f64`, which represents integers up to 2^53 exactly. The space gives the shape,
//! element type and bounds of its values. [`Space`] serialises to the JSON that `swm fovs --json` prints.

use crate::batch::DType;
use crate::{Error, Result, Rng};
use rand::Rng as _;
use serde::{Deserialize, Serialize};

/// A set of values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "type")]
pub enum Space {
    /// An array within bounds.
    Box {
        /// The shape; empty for a scalar.
        shape: Vec<usize>,
        /// The type of the elements.
        dtype: DType,
        /// The lower bound of each element, inclusive.
        low: Vec<f64>,
        /// The upper bound of each element, inclusive.
        high: Vec<f64>,
    },
    /// One of `n` consecutive integers.
    Discrete {
        /// The number of integers.
        n: i64,
        /// The first integer.
        start: i64,
    },
    /// Several integers, each with a range.
    MultiDiscrete {
        /// The number of integers in each range.
        nvec: Vec<i64>,
        /// The first integer of each range.
        start: Vec<i64>,
    },
    /// A colour: red, green and blue from 0 to 255.
    #[serde(rename = "RGBBox")]
    Rgb,
}

impl Space {
    /// A box with the same bounds for every element.
    pub fn uniform_box(shape: impl Into<Vec<usize>>, dtype: DType, low: f64, high: f64) -> Self {
        let shape = shape.into();
        let n = shape.iter().product();
        Self::Box { shape, dtype, low: vec![low; n], high: vec![high; n] }
    }

    /// The number of elements of one value.
    pub fn len(&self) -> usize {
        match self {
            Self::Box { low, .. } => low.len(),
            Self::Discrete { .. } => 1,
            Self::MultiDiscrete { nvec, .. } => nvec.len(),
            Self::Rgb => 3,
        }
    }

    /// Whether a value has no elements.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The shape of one value.
    pub fn shape(&self) -> Vec<usize> {
        match self {
            Self::Box { shape, .. } => shape.clone(),
            Self::Discrete { .. } => vec![],
            Self::MultiDiscrete { nvec, .. } => vec![nvec.len()],
            Self::Rgb => vec![3],
        }
    }

    /// The type of the elements.
    pub fn dtype(&self) -> DType {
        match self {
            Self::Box { dtype, .. } => *dtype,
            Self::Discrete { .. } | Self::MultiDiscrete { .. } => DType::Int64,
            Self::Rgb => DType::U8,
        }
    }

    /// The bounds of element `i` of a value, both inclusive.
    pub fn bounds(&self, i: usize) -> (f64, f64) {
        match self {
            Self::Box { low, high, .. } => (low[i], high[i]),
            Self::Discrete { n, start } => (*start as f64, (*start + *n - 1) as f64),
            Self::MultiDiscrete { nvec, start } => (start[i] as f64, (start[i] + nvec[i] - 1) as f64),
            Self::Rgb => (0.0, 255.0),
        }
    }

    /// Draws a value uniformly within finite bounds. An element with one finite bound is exponentially distributed from that bound
    /// on, and one without normally, both with scale 1, as in Gymnasium.
    pub fn sample(&self, rng: &mut Rng) -> Vec<f64> {
        (0..self.len())
            .map(|i| {
                let (low, high) = self.bounds(i);
                if !matches!(self.dtype(), DType::Float32 | DType::Float64) {
                    return rng.random_range(low as i64..=high as i64) as f64;
                }
                let share = rng.random::<f64>();
                // The logarithm of a number above 0.
                let distance = || -(1.0 - share).ln();
                self.round(match (low.is_finite(), high.is_finite()) {
                    (true, true) => low + (high - low) * share,
                    (true, false) => low + distance(),
                    (false, true) => high - distance(),
                    // Box and Muller, "A note on the generation of random normal deviates", 1958.
                    (false, false) => (2.0 * distance()).sqrt() * (std::f64::consts::TAU * rng.random::<f64>()).cos(),
                })
            })
            .collect()
    }

    /// Rounds to the nearest value that the element type can represent.
    pub fn round(&self, value: f64) -> f64 {
        match self.dtype() {
            DType::Float32 => f64::from(value as f32),
            _ => value,
        }
    }

    /// Checks that `value` is in the space.
    ///
    /// # Errors
    /// When `value` has another number of elements, or an element is out of bounds, not finite, or not an integer where
    /// the space holds integers.
    pub fn check(&self, name: &str, value: &[f64]) -> Result<()> {
        let integer = !matches!(self.dtype(), DType::Float32 | DType::Float64);
        let valid = value.len() == self.len()
            && value.iter().enumerate().all(|(i, &v)| {
                let ((low, high), rounded) = (self.bounds(i), self.round(v));
                // A bound as it is written, such as 0.6, may lie beyond the bound in single precision.
                v.is_finite() && rounded >= low && rounded <= high && (!integer || v.fract() == 0.0)
            });
        if valid {
            return Ok(());
        }
        Err(Error::OutOfSpace { what: name.to_owned(), given: format!("{value:?}"), expected: self.describe() })
    }

    /// The space in words, for errors.
    pub fn describe(&self) -> String {
        match self {
            Self::Box { shape, dtype, low, high } => {
                let same = |v: &[f64]| v.windows(2).all(|w| w[0] == w[1]);
                let (low, high) = if !low.is_empty() && same(low) && same(high) {
                    (self.format_values(&low[..1]), self.format_values(&high[..1]))
                } else {
                    (format!("[{}]", self.format_values(low)), format!("[{}]", self.format_values(high)))
                };
                let shape = if shape.is_empty() { "one".to_owned() } else { format!("{shape:?}") };
                format!("{shape} {} in {low} ..= {high}", dtype.name())
            }
            Self::Discrete { n, start } => format!("one integer in {start} ..= {}", start + n - 1),
            Self::MultiDiscrete { nvec, start } => {
                let ranges: Vec<String> =
                    nvec.iter().zip(start).map(|(n, start)| format!("{start} ..= {}", start + n - 1)).collect();
                format!("{} integers in {}", nvec.len(), ranges.join(", "))
            }
            Self::Rgb => "a colour: 3 integers in 0 ..= 255".to_owned(),
        }
    }

    /// Values of this space as text with no more digits than the element type holds.
    pub fn format_values(&self, values: &[f64]) -> String {
        let format = |&value: &f64| match self.dtype() {
            DType::Float32 => (value as f32).to_string(),
            _ => value.to_string(),
        };
        values.iter().map(format).collect::<Vec<_>>().join(", ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Key;

    #[test]
    fn samples_without_bounds_have_the_moments_of_their_distributions() {
        let (infinite, mut rng) = (f64::INFINITY, Key::new(2).rng());
        for (low, high, mean) in [(5.0, infinite, 6.0), (-infinite, -5.0, -6.0), (-infinite, infinite, 0.0)] {
            let space = Space::uniform_box([1], DType::Float64, low, high);
            let values: Vec<f64> = (0..20_000).flat_map(|_| space.sample(&mut rng)).collect();
            let found = values.iter().sum::<f64>() / values.len() as f64;
            let variance = values.iter().map(|value| (value - found).powi(2)).sum::<f64>() / values.len() as f64;
            assert!((found - mean).abs() < 0.04 && (variance - 1.0).abs() < 0.1, "{low}, {high}: {found}, {variance}");
        }
    }

    #[test]
    fn samples_are_inside_the_space_and_other_values_are_errors() {
        let spaces = [
            Space::uniform_box([2], DType::Float32, -1.0, 1.0),
            Space::uniform_box([], DType::Float64, 0.0, 1e-3),
            Space::Discrete { n: 3, start: 1 },
            Space::MultiDiscrete { nvec: vec![224, 21], start: vec![0, 1] },
            Space::Rgb,
            Space::uniform_box([2], DType::Float32, 5.0, f64::INFINITY),
            Space::uniform_box([2], DType::Float32, f64::NEG_INFINITY, -5.0),
            Space::uniform_box([2], DType::Float64, f64::NEG_INFINITY, f64::INFINITY),
        ];
        let mut rng = Key::new(1).rng();
        for space in &spaces {
            for _ in 0..200 {
                let value = space.sample(&mut rng);
                space.check("value", &value).expect("a sample is in its space");
            }
        }
        let error =
            spaces[4].check("agent.color", &[0.0, 256.0, 3.0]).expect_err("a value outside the space").to_string();
        assert_eq!(
            error,
            "agent.color = [0.0, 256.0, 3.0] is outside its space: expected a colour: 3 integers in 0 ..= 255"
        );
        assert!(spaces[2].check("door.number", &[1.5]).is_err());
        let single = Space::uniform_box([1], DType::Float32, f64::from(0.6f32), f64::from(0.7f32));
        assert!([0.6, 0.65, 0.7].iter().all(|&value| single.check("light", &[value]).is_ok()));
        assert!([0.599, 0.701].iter().all(|&value| single.check("light", &[value]).is_err()));
    }
}
