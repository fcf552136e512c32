//! [`Counting`]: the rule that decides which episodes count and which of them succeed.

use super::{EpisodeResult, Proportion};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// The rule that decides which episodes count and which of them succeed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Counting {
    /// An episode that is solved at start is neither played nor counted. An episode succeeds when its observations
    /// satisfy the goal (the column `success`) for `hold` consecutive steps within its budget.
    Strict {
        /// Consecutive steps that must satisfy the goal. With more than 1, the episode continues after the first
        /// success until the goal is held or the budget is spent.
        hold: usize,
    },
    /// The counting of the Python package `stable-worldmodel` 0.1.1, for comparison with its published figures. Every
    /// start is played and counts, solved at start or not, and an episode succeeds when the environment *terminates*
    /// within its budget for any reason. A termination by failure (a pole that falls) counts as a success.
    ///
    /// The episodic protocol of that package plays `envs` environments at a time, resets each environment when its
    /// episode finishes, and counts the first episodes that finish. Long episodes, which mostly fail, therefore count
    /// less often, and the rate depends on `envs`.
    Compat {
        /// Environments played at the same time.
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

    /// The success rate of these episodes. Those that start from one recorded episode form a cluster.
    pub fn rate(self, episodes: &[EpisodeResult]) -> Proportion {
        let mut clusters: BTreeMap<(Option<usize>, usize), [usize; 2]> = BTreeMap::new();
        for (i, episode) in episodes.iter().enumerate().filter(|(_, episode)| self.counts(episode)) {
            let key = episode.start.map_or((None, i), |[recorded, _]| (Some(recorded), 0));
            let [successes, n] = clusters.entry(key).or_default();
            *successes += usize::from(episode.success);
            *n += 1;
        }
        let clusters: Vec<[usize; 2]> = clusters.into_values().collect();
        Proportion::clustered(clusters.into_iter())
    }

    /// The name of the rule: `strict` or `compat`.
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
