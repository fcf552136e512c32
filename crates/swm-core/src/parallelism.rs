//! [`Parallelism`]: whether work on several slots is worth distributing over threads. The answer affects the duration of
//! the work only, never its outcome.

use std::time::{Duration, Instant};

/// The approximate cost of distributing work over threads and waiting for them; less work than that stays on one thread.
const OVERHEAD: Duration = Duration::from_micros(20);

/// The duration of one slot's work, as measured last time.
#[derive(Debug)]
pub(crate) struct Parallelism(Duration);

impl Default for Parallelism {
    /// Unknown: the first work is distributed.
    fn default() -> Self {
        Self(Duration::MAX)
    }
}

impl Parallelism {
    /// Whether one thread finishes the work of so many slots sooner than several.
    pub fn is_serial(&self, slots: usize) -> bool {
        self.0.saturating_mul(u32::try_from(slots).unwrap_or(u32::MAX)) < OVERHEAD
    }

    /// Records work on `slots` slots that started at `start` and ran on `workers` threads.
    pub fn record(&mut self, start: Instant, workers: usize, slots: usize) {
        let small = |n: usize| u32::try_from(n.max(1)).unwrap_or(u32::MAX);
        self.0 = start.elapsed().saturating_mul(small(workers.min(slots))) / small(slots);
    }
}
