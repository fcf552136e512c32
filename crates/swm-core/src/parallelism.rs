//! [`Parallelism`]: decides whether distributing the work of several slots over threads saves time. The decision
//! affects the duration of the work only, not its result.

use std::time::{Duration, Instant};

/// The approximate cost of distributing work over threads and waiting for these threads. Shorter work runs on one
/// thread.
const OVERHEAD: Duration = Duration::from_micros(20);

/// The duration of one slot's work, measured at the last call of [`Parallelism::record`].
#[derive(Debug)]
pub(crate) struct Parallelism(Duration);

impl Default for Parallelism {
    /// An unknown duration counts as the longest duration, so the first work is distributed over threads.
    fn default() -> Self {
        Self(Duration::MAX)
    }
}

impl Parallelism {
    /// Whether one thread finishes the work of `slots` slots sooner than several threads.
    pub fn is_serial(&self, slots: usize) -> bool {
        self.0.saturating_mul(u32::try_from(slots).unwrap_or(u32::MAX)) < OVERHEAD
    }

    /// Records work on `slots` slots that started at `start` and ran on `workers` threads.
    pub fn record(&mut self, start: Instant, workers: usize, slots: usize) {
        let to_u32 = |n: usize| u32::try_from(n.max(1)).unwrap_or(u32::MAX);
        self.0 = start.elapsed().saturating_mul(to_u32(workers.min(slots))) / to_u32(slots);
    }
}
