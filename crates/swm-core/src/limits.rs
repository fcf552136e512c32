//! [`Limit`]: the largest counts that a command accepts, checked before any work starts.
//!
//! The limits are far above useful values; they turn a mistyped or hostile count into an error instead of a machine
//! without memory.

use crate::{Error, Result};

/// The largest value of a count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limit {
    /// The count, for errors, such as `number of environments`.
    pub what: &'static str,
    /// The largest value.
    pub max: usize,
}

impl Limit {
    const fn new(what: &'static str, max: usize) -> Self {
        Self { what, max }
    }

    /// Checks a count.
    ///
    /// # Errors
    /// When it is too large.
    pub fn check(self, given: usize) -> Result<()> {
        if given <= self.max {
            return Ok(());
        }
        Err(Error::config(self.what, format!("{given} is too large"), format!("choose at most {}", self.max)))
    }
}

/// Environments that are stepped together.
pub const ENVS: Limit = Limit::new("number of environments", 16_384);
/// Worker processes of third-party environments.
pub const WORKERS: Limit = Limit::new("number of worker processes", 1024);
/// Worker threads.
pub const THREADS: Limit = Limit::new("number of threads", 1024);
/// Threads of Rayon.
pub const RAYON_THREADS: Limit = Limit::new("number of threads in RAYON_NUM_THREADS", 1024);
/// The height and the width of a frame, in pixels.
pub const IMAGE_SIDE: Limit = Limit::new("side of a frame in pixels", 4096);
/// Episodes of a collected dataset.
pub const EPISODES: Limit = Limit::new("number of episodes", 1_000_000_000);
/// Episodes of an evaluation, whose outcomes are held in memory.
pub const EVALUATED_EPISODES: Limit = Limit::new("number of evaluated episodes", 1_000_000);
/// Steps of an episode, and between a start and its goal.
pub const STEPS: Limit = Limit::new("number of steps", 1_000_000_000);
/// Shards of a dataset.
pub const SHARDS: Limit = Limit::new("number of shards", 1_000_000);
/// Visual wrappers of an environment.
pub const WRAPPERS: Limit = Limit::new("number of wrappers", 64);
/// Model steps of a plan, of its history, and of prediction errors.
pub const MODEL_STEPS: Limit = Limit::new("number of model steps", 10_000);
/// Candidates of a solver.
pub const SAMPLES: Limit = Limit::new("number of samples", 1_000_000);
/// Values of all candidates of one iteration of a solver, and of the plans and the history of all environments: 4 GiB.
pub const CANDIDATE_VALUES: Limit = Limit::new("values of all candidates", 1 << 30);
/// Bytes of the observations and frames of all environments, and of a batch of clips.
pub const BATCH_BYTES: Limit = Limit::new("bytes of a batch", 16 << 30);
/// Bytes of the frames of a dataset that a benchmark collects, which it also holds in memory.
pub const BENCHMARK_BYTES: Limit = Limit::new("bytes of the frames of a benchmark", 64 << 30);
/// Bytes of the frames on a contact sheet.
pub const SHEET_BYTES: Limit = Limit::new("bytes of a contact sheet", 2 << 30);
/// Bytes of the rows of a replay buffer.
pub const REPLAY_BYTES: Limit = Limit::new("bytes of a replay buffer", 1 << 40);

/// The product of sizes; the largest value if it is larger.
pub fn product(sizes: impl IntoIterator<Item = usize>) -> usize {
    sizes.into_iter().fold(1, usize::saturating_mul)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn larger_counts_are_errors() {
        assert!(ENVS.check(ENVS.max).is_ok());
        let error = ENVS.check(1_000_000).expect_err("too many").to_string();
        assert_eq!(error, "number of environments: 1000000 is too large; choose at most 16384");
        assert_eq!((product([2, 3, 4]), product([usize::MAX, 2]), product([usize::MAX, 2, 0])), (24, usize::MAX, 0));
    }
}
