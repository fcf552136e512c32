//! [`Split`]: divides the episodes of a dataset into the parts train, validation and test.
//!
//! A keyed hash of an episode's index determines its part, independently of all other episodes. An episode therefore
//! stays in its part while the dataset grows, and training and evaluation with the same split use the same parts.

use crate::dataset::reader::Reader;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use swm_core::{Error, Key, Result};

/// A part of a dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    /// Episodes for training models.
    Train,
    /// Episodes for choosing settings.
    Validation,
    /// Episodes for the final evaluation.
    Test,
}

/// The fractions of the held-out parts, and the seed of the division.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Split {
    /// Fraction of episodes held out for validation.
    pub validation: f64,
    /// Fraction of episodes held out for testing.
    pub test: f64,
    /// Seed of the hash.
    pub seed: u64,
}

impl Default for Split {
    /// Holds out a tenth each for validation and test.
    fn default() -> Self {
        Self { validation: 0.1, test: 0.1, seed: 0 }
    }
}

impl Split {
    /// The part of an episode, given its value in the column `episode_idx`.
    pub fn part(&self, episode: i64) -> Part {
        // 53 bits of the hash give a value in [0, 1).
        let hash = Key::new(self.seed).with("held out").at(episode as u64).seed() >> 11;
        let fraction = hash as f64 / (1u64 << 53) as f64;
        match fraction {
            fraction if fraction < self.test => Part::Test,
            fraction if fraction < self.test + self.validation => Part::Validation,
            _ => Part::Train,
        }
    }

    /// The positions of a part's episodes in [`Reader::episodes`], in order.
    ///
    /// # Errors
    /// If a fraction is out of range, or no episode falls into the part.
    pub fn episodes(&self, reader: &dyn Reader, part: Part) -> Result<Vec<usize>> {
        let fractions = [self.validation, self.test, 1.0 - self.validation - self.test];
        if !fractions.iter().all(|fraction| (0.0..=1.0).contains(fraction)) {
            return Err(Error::OutOfSpace {
                what: "the held-out fractions".to_owned(),
                given: format!("validation {}, test {}", self.validation, self.test),
                expected: "fractions of at least 0 that add up to at most 1".to_owned(),
            });
        }
        let all = reader.episodes();
        let chosen: Vec<usize> = (0..all.len()).filter(|&i| self.part(all[i].index) == part).collect();
        if chosen.is_empty() {
            return Err(Error::config(
                format!("the {part} split"),
                format!("none of the dataset's {} episodes falls into it", all.len()),
                "collect more episodes, hold out a larger fraction, or choose another split seed",
            ));
        }
        Ok(chosen)
    }
}

impl fmt::Display for Part {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Train => "train",
            Self::Validation => "validation",
            Self::Test => "test",
        })
    }
}

impl FromStr for Part {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let parts = [Self::Train, Self::Validation, Self::Test];
        let names = parts.map(|part| part.to_string());
        parts.into_iter().find(|part| part.to_string() == name).ok_or_else(|| {
            Error::unknown("split", name, names.iter().map(String::as_str), "a split is train, validation or test")
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn split_parts_have_the_requested_fractions_and_depend_on_the_seed() {
        let split = Split { validation: 0.2, test: 0.1, seed: 3 };
        let parts: Vec<Part> = (0..10_000).map(|episode| split.part(episode)).collect();
        let count = |expected| parts.iter().filter(|&&part| part == expected).count();
        // The tolerances are three standard deviations of the binomial distribution: 120 of 2000, 90 of 1000.
        assert!(count(Part::Validation).abs_diff(2000) < 120 && count(Part::Test).abs_diff(1000) < 90);
        let other = Split { seed: 4, ..split };
        let changed = (0..10_000).filter(|&episode| other.part(episode) != split.part(episode)).count();
        assert!(changed > 3000, "{changed}");
        // The default split must never change, because published results depend on it.
        let episodes_of =
            |part| (0..40).filter(|&episode| Split::default().part(episode) == part).collect::<Vec<i64>>();
        assert_eq!((episodes_of(Part::Test), episodes_of(Part::Validation)), (vec![14], vec![4, 6, 16, 23, 24, 32]));
    }

    #[test]
    fn validation_fraction_does_not_change_the_test_part() {
        let [few, many] = [0.1, 0.4].map(|validation| Split { validation, ..Split::default() });
        assert!((0..1000).all(|i| (few.part(i) == Part::Test) == (many.part(i) == Part::Test)));
        assert_eq!("validation".parse::<Part>().expect("parsing the part"), Part::Validation);
        assert!("tset".parse::<Part>().expect_err("an unknown part").to_string().contains("did you mean test"));
    }
}
