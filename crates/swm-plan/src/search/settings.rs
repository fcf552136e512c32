//! [`Settings`]: the checks of configuration values that solvers, objectives and the MPC policy share.

use swm_core::{Error, Result, limits};

/// The largest number of candidates of a solver.
const MAX_SAMPLES: usize = limits::SAMPLES.max;
/// The largest number of iterations of a solver.
const MAX_ITERATIONS: usize = 100_000;

/// Checks the settings of one owner (a solver, a term, the policy). Error messages begin with the owner's name.
#[derive(Clone, Copy)]
pub struct Settings<'a>(pub &'a str);

impl Settings<'_> {
    /// Checks that a count is at least 1.
    ///
    /// # Errors
    /// When the count is 0.
    pub fn at_least_one(self, name: &str, value: usize) -> Result<()> {
        self.check(value > 0, name, value, "choose at least 1")
    }

    /// Checks that a number of candidates is at least 1 and fits into memory.
    ///
    /// # Errors
    /// When it is 0 or above a million.
    pub fn samples(self, samples: usize) -> Result<()> {
        self.check((1..=MAX_SAMPLES).contains(&samples), "samples", samples, &format!("choose 1 to {MAX_SAMPLES}"))
    }

    /// Checks that a number of iterations is at least 1, and that a plan ends.
    ///
    /// # Errors
    /// When it is 0 or above 100,000.
    pub fn iterations(self, name: &str, iterations: usize) -> Result<()> {
        let fix = format!("choose 1 to {MAX_ITERATIONS}");
        self.check((1..=MAX_ITERATIONS).contains(&iterations), name, iterations, &fix)
    }

    /// Checks that the number of elites is at least `least` and at most the number of samples.
    ///
    /// # Errors
    /// When the number of elites is outside this range.
    pub fn elites(self, elites: usize, least: usize, samples: usize) -> Result<()> {
        let fix = match least {
            1 => "choose at least 1 and at most the number of samples",
            _ => "choose at least 2 (a standard deviation needs two) and at most the number of samples",
        };
        self.check((least..=samples).contains(&elites), "elites", format!("{elites} of {samples} samples"), fix)
    }

    /// Checks that a count is at most `most`. `of` names the items whose number is `most`.
    ///
    /// # Errors
    /// When the count is greater.
    pub fn at_most(self, name: &str, value: usize, most: usize, of: &str) -> Result<()> {
        self.check(value <= most, name, value, &format!("choose at most {most}, the number of {of}"))
    }

    /// Checks that a value is finite and above 0.
    ///
    /// # Errors
    /// When the value is outside this range.
    pub fn positive(self, name: &str, value: f32) -> Result<()> {
        self.check(value.is_finite() && value > 0.0, name, value, "choose a finite number above 0")
    }

    /// Checks that a value is finite and not below `least`.
    ///
    /// # Errors
    /// When the value is outside this range.
    pub fn at_least(self, name: &str, value: f32, least: f32) -> Result<()> {
        let fix = format!("choose a finite number of at least {least}");
        self.check(value.is_finite() && value >= least, name, value, &fix)
    }

    /// Checks that a value is finite and not below 0.
    ///
    /// # Errors
    /// When the value is outside this range.
    pub fn not_negative(self, name: &str, value: f32) -> Result<()> {
        self.at_least(name, value, 0.0)
    }

    /// Checks that the weight of an exponential average is at least 0 and below 1.
    ///
    /// # Errors
    /// When the value is outside this range.
    pub fn momentum(self, name: &str, value: f32) -> Result<()> {
        self.check((0.0..1.0).contains(&value), name, value, "choose a number of at least 0 and below 1")
    }

    /// Checks any condition on the setting `name`.
    ///
    /// # Errors
    /// When the condition does not hold; the message names the owner, the setting, the given value and the fix.
    pub fn check(self, holds: bool, name: &str, given: impl ToString, fix: &str) -> Result<()> {
        if holds { Ok(()) } else { Err(Error::config(format!("{} {name}", self.0), given.to_string(), fix)) }
    }
}
