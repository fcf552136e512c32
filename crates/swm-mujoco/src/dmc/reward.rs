//! The soft indicator that every reward of the suite is made of (Tassa et al. 2018, "DeepMind Control Suite", section 2).

/// How a reward falls from 1 to its value one margin outside the band.
#[derive(Clone, Copy, Debug)]
enum Falloff {
    /// A bell, 0.1 at the margin.
    Gaussian,
    /// A straight line to this value at the margin; it goes on to 0.
    Linear(f64),
    /// A parabola, 0 at the margin.
    Quadratic,
}

/// 1 where a number lies in a band; outside, less the further it is away.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    low: f64,
    high: f64,
    margin: f64,
    falloff: Falloff,
}

impl Tolerance {
    /// 1 from `low` to `high`, both included, and 0 outside.
    pub const fn within(low: f64, high: f64) -> Self {
        Self { low, high, margin: 0.0, falloff: Falloff::Gaussian }
    }

    /// 1 from `low` on.
    pub const fn at_least(low: f64) -> Self {
        Self::within(low, f64::INFINITY)
    }

    /// 1 up to `high`.
    pub const fn at_most(high: f64) -> Self {
        Self::within(f64::NEG_INFINITY, high)
    }

    /// Falls like a bell, to 0.1 at `margin` outside the band.
    #[must_use]
    pub const fn gaussian(self, margin: f64) -> Self {
        Self { margin, falloff: Falloff::Gaussian, ..self }
    }

    /// Falls straight, to `value` at `margin` outside the band.
    #[must_use]
    pub const fn linear(self, margin: f64, value: f64) -> Self {
        Self { margin, falloff: Falloff::Linear(value), ..self }
    }

    /// Falls like a parabola, to 0 at `margin` outside the band.
    #[must_use]
    pub const fn quadratic(self, margin: f64) -> Self {
        Self { margin, falloff: Falloff::Quadratic, ..self }
    }

    /// The reward of a number.
    pub fn of(self, x: f64) -> f64 {
        if (self.low..=self.high).contains(&x) {
            return 1.0;
        }
        if self.margin == 0.0 {
            return 0.0;
        }
        let away = if x < self.low { self.low - x } else { x - self.high } / self.margin;
        match self.falloff {
            Falloff::Gaussian => {
                let scaled = away * (-2.0 * 0.1f64.ln()).sqrt();
                (-0.5 * scaled * scaled).exp()
            }
            Falloff::Linear(value) => (1.0 - away * (1.0 - value)).max(0.0),
            Falloff::Quadratic => (1.0 - away * away).max(0.0),
        }
    }
}

/// The mean reward of some numbers.
pub fn mean(tolerance: Tolerance, numbers: &[f64]) -> f64 {
    numbers.iter().map(|&x| tolerance.of(x)).sum::<f64>() / numbers.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rewards_fall_from_the_band_as_the_suite_says() {
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
        assert_eq!([-1e-9, 0.0, 1.0].map(|x| step.of(x)), [0.0, 1.0, 1.0], "no margin, no fall");
        assert_eq!(mean(parabola, &[0.0, 0.5, 1.0, 1.0]), 0.4375);
    }
}
