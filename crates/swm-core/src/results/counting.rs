//! [`Counting`]: which episodes count, and what counts as a success.

use super::{EpisodeResult, Proportion};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Which episodes count, and what counts as a success.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Counting {
    /// A start that already satisfies the goal is not played and not counted. An episode succeeds when its
    /// observations satisfy the goal (the column `success`) for `hold` steps in a row, within its budget.
    Strict {
        /// Steps in a row that must satisfy the goal; 1 succeeds at the first. With more, the episode goes on after the
        /// first success until the goal was held or the budget is spent.
        hold: usize,
    },
    /// The counting of the Python package `stable-worldmodel` 0.1.1, to compare with its figures: every start is
    /// played and counts, solved or not, and an episode succeeds when the world *terminates* within its budget, whatever
    /// the reason. Where a world terminates by failing (a pole that falls), that is counted as a success.
    ///
    /// Its episodic protocol counts the first episodes that finish among `envs` that are played side by side and begin
    /// anew as they finish. Long episodes, which mostly fail, are thus counted less often, and the rate depends on
    /// `envs`.
    Compat {
        /// Environments played side by side.
        envs: usize,
    },
}

impl Default for Counting {
    fn default() -> Self {
        Self::Strict { hold: 1 }
    }
}

impl Counting {
    /// Whether an episode counts.
    pub fn counts(self, episode: &EpisodeResult) -> bool {
        match self {
            Self::Strict { .. } => !episode.solved_at_start,
            Self::Compat { .. } => true,
        }
    }

    /// The success rate of these episodes.
    pub fn rate(self, episodes: &[EpisodeResult]) -> Proportion {
        let counted = || episodes.iter().filter(|episode| self.counts(episode));
        Proportion::wilson(counted().filter(|episode| episode.success).count(), counted().count())
    }

    /// Its name: `strict` or `compat`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Strict { .. } => "strict",
            Self::Compat { .. } => "compat",
        }
    }
}

impl fmt::Display for Counting {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Strict { hold: 1 } => write!(f, "strict"),
            Self::Strict { hold } => write!(f, "strict, held for {hold} steps"),
            Self::Compat { envs } => write!(f, "compat with {envs} environments"),
        }
    }
}
