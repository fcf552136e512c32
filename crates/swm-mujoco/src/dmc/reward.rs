//! [`Tolerance`]: the soft indicator that rewards of the suite consist of (Tassa et al. 2018, section 2;
//! `dm_control/utils/rewards.py`).

/// The shape of a tolerance outside its bounds, where the value falls from 1.
#[derive(Clone, Copy, Debug)]
enum Falloff {
    /// A Gaussian, 0.1 at the margin.
    Gaussian,
    /// A line to this value at the margin, continued down to 0.
    Linear(f64),
    /// A parabola, 0 at the margin.
    Quadratic,
}

/// An indicator that is 1 between two bounds and falls outside them.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    low: f64,
    high: f64,
    margin: f64,
    falloff: Falloff,
}

impl Tolerance {
    /// An indicator that is 1 from `low` to `high` inclusive, 0 outside.
    pub const fn within(low: f64, high: f64) -> Self {
        Self { low, high, margin: 0.0, falloff: Falloff::Gaussian }
    }

    /// An indicator that is 1 from `low` upwards, 0 below.
    pub const fn at_least(low: f64) -> Self {
        Self::within(low, f64::INFINITY)
    }

    /// An indicator that is 1 up to `high`, 0 above.
    pub const fn at_most(high: f64) -> Self {
        Self::within(f64::NEG_INFINITY, high)
    }

    /// Falls as a Gaussian, to 0.1 at `margin` outside the bounds.
    #[must_use]
    pub const fn gaussian(self, margin: f64) -> Self {
        Self { margin, falloff: Falloff::Gaussian, ..self }
    }

    /// Falls linearly, to `value` at `margin` outside the bounds.
    #[must_use]
    pub const fn linear(self, margin: f64, value: f64) -> Self {
        Self { margin, falloff: Falloff::Linear(value), ..self }
    }

    /// Falls as a parabola, to 0 at `margin` outside the bounds.
    #[must_use]
    pub const fn quadratic(self, margin: f64) -> Self {
        Self { margin, falloff: Falloff::Quadratic, ..self }
    }

    /// The value of the indicator, from 0 to 1.
    pub fn of(self, x: f64) -> f64 {
        if (self.low..=self.high).contains(&x) {
            return 1.0;
        }
        if self.margin == 0.0 {
            return 0.0;
        }
        let outside = if x < self.low { self.low - x } else { x - self.high };
        let distance = outside / self.margin;
        match self.falloff {
            Falloff::Gaussian => {
                let scaled = distance * (-2.0 * 0.1f64.ln()).sqrt();
                (-0.5 * scaled * scaled).exp()
            }
            Falloff::Linear(value) => (1.0 - distance * (1.0 - value)).max(0.0),
            Falloff::Quadratic => (1.0 - distance * distance).max(0.0),
        }
    }
}

/// The mean value of a tolerance over several values.
pub fn mean(tolerance: Tolerance, values: &[f64]) -> f64 {
    values.iter().map(|&x| tolerance.of(x)).sum::<f64>() / values.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tolerances_equal_those_of_dm_control() {
        let bell = Tolerance::at_least(1.2).gaussian(0.6);
        assert_eq!([bell.of(1.2), bell.of(9.0)], [1.0, 1.0]);
        assert!((bell.of(0.6) - 0.1).abs() < 1e-15 && (bell.of(0.9) - 0.1f64.powf(0.25)).abs() < 1e-15);
        let line = Tolerance::at_most(-10.0).linear(10.0, 0.0);
        assert_eq!([-11.0, -10.0, -5.0, 0.0, 3.0].map(|x| line.of(x)), [1.0, 1.0, 0.5, 0.0, 0.0]);
        let half = Tolerance::at_least(1.0).linear(0.5, 0.5);
        assert_eq!([1.0, 0.75, 0.5, 0.0, -1.0].map(|x| half.of(x)), [1.0, 0.75, 0.5, 0.0, 0.0]);
        let parabola = Tolerance::within(0.0, 0.0).quadratic(1.0);
        assert_eq!([0.0, 0.5, -0.5, 1.0, -2.0].map(|x| parabola.of(x)), [1.0, 0.75, 0.75, 0.0, 0.0]);
        let step = Tolerance::at_least(0.0).linear(0.0, 0.0);
        assert_eq!(
            [-1e-9, 0.0, 1.0].map(|x| step.of(x)),
            [0.0, 1.0, 1.0],
            "without a margin, values outside the bounds are 0"
        );
        assert_eq!(mean(parabola, &[0.0, 0.5, 1.0, 1.0]), 0.4375);
    }
}
