//! [`Pace`]: whether work on several slots is worth handing to other threads. What the work brings does not depend on
//! the answer, only how long it takes does.

use std::time::{Duration, Instant};

/// What handing work to other threads and waiting for them costs, roughly; less work than that is not handed out.
const HANDING_OUT: Duration = Duration::from_micros(20);

/// How long a slot's work takes, by what it took last time.
#[derive(Debug)]
pub(crate) struct Pace(Duration);

impl Default for Pace {
    /// Unknown: the first work is handed out.
    fn default() -> Self {
        Self(Duration::MAX)
    }
}

impl Pace {
    /// Whether so many slots are done sooner by this thread alone.
    pub fn alone(&self, slots: usize) -> bool {
        self.0.saturating_mul(u32::try_from(slots).unwrap_or(u32::MAX)) < HANDING_OUT
    }

    /// Takes note of work on `slots` slots that began then and was shared by `workers` threads.
    pub fn note(&mut self, begun: Instant, workers: usize, slots: usize) {
        let small = |n: usize| u32::try_from(n.max(1)).unwrap_or(u32::MAX);
        self.0 = begun.elapsed().saturating_mul(small(workers.min(slots))) / small(slots);
    }
}
