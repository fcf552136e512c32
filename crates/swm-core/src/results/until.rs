//! [`Until`]: the rule that ends an evaluation whose number of episodes its results decide.

use super::{Paired, Proportion, StudyRow, Verdict};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The rule that ends a study or an evaluation whose number of episodes its results decide. Its text is `ci=5` or `decided=10`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub enum Until {
    /// The confidence sequence of a rate is at most this many percentage points wide on each side: half of its width.
    Width(f64),
    /// A gap is told apart from 0, or its interval lies within this many percentage points of 0.
    Decided(f64),
}

impl Until {
    /// The difference in percentage points that `decided` alone stands for.
    const DIFFERENCE: f64 = 10.0;

    /// Whether the row needs no more episodes.
    pub fn is_met(self, row: &StudyRow) -> bool {
        match self {
            Self::Width(_) => self.is_narrow(&row.success),
            Self::Decided(_) => row.gap.as_ref().is_none_or(|gap| self.is_decided(gap)),
        }
    }

    /// Whether the interval of a rate is narrow enough for `ci`.
    pub(super) fn is_narrow(self, rate: &Proportion) -> bool {
        let Self::Width(points) = self else { return true };
        50.0 * (rate.high - rate.low) <= points
    }

    /// Whether a comparison is told apart, or shown to be too small to matter for `decided`.
    pub(super) fn is_decided(self, table: &Paired) -> bool {
        let Self::Decided(points) = self else { return true };
        let told = matches!(table.verdict, Verdict::Lower | Verdict::Higher);
        told || 100.0 * table.low.abs().max(table.high.abs()) < points
    }
}

impl fmt::Display for Until {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Width(points) => write!(f, "ci={points}"),
            Self::Decided(points) => write!(f, "decided={points}"),
        }
    }
}

impl FromStr for Until {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let rule = match text.split_once('=').unwrap_or((text, "")) {
            ("ci", points) => points.parse().ok().map(Self::Width),
            ("decided", "") if text == "decided" => Some(Self::Decided(Self::DIFFERENCE)),
            ("decided", points) => points.parse().ok().map(Self::Decided),
            _ => None,
        };
        let is_valid = |rule: &Self| {
            let (Self::Width(points) | Self::Decided(points)) = rule;
            *points > 0.0 && *points < 50.0
        };
        rule.filter(is_valid).ok_or_else(|| {
            let fix = "write ci=5 (half-widths of intervals in percentage points), decided, or decided=10 (a difference in \
                       percentage points); below 50";
            Error::config("--until", format!("'{text}' is no rule"), fix)
        })
    }
}

impl TryFrom<String> for Until {
    type Error = Error;

    fn try_from(text: String) -> Result<Self> {
        text.parse()
    }
}

impl From<Until> for String {
    fn from(until: Until) -> Self {
        until.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rules_are_read_from_their_texts() {
        for (text, rule, again) in [
            ("ci=5", Until::Width(5.0), "ci=5"),
            ("ci=2.5", Until::Width(2.5), "ci=2.5"),
            ("decided", Until::Decided(10.0), "decided=10"),
            ("decided=20", Until::Decided(20.0), "decided=20"),
        ] {
            assert_eq!(text.parse::<Until>().expect("a rule"), rule);
            assert_eq!(rule.to_string(), again);
            let json = serde_json::to_string(&rule).expect("a document");
            assert_eq!(serde_json::from_str::<Until>(&json).expect("a rule"), rule);
        }
        for text in ["", "ci", "ci=", "ci=0", "ci=-1", "ci=50", "ci=NaN", "decided=", "decided=x", "5", "width=5"] {
            let error = text.parse::<Until>().expect_err(text).to_string();
            assert!(error.contains("ci=5") && error.contains("decided"), "{error}");
        }
    }
}
