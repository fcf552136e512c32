//! Losses that are means over clips, computed in parallel.
//!
//! Burn computes on one thread, so shards of a batch run on several threads. The configuration, not the machine, sets
//! the number of shards a batch is cut into. Each shard differentiates its own copy of the model, and the results are
//! added in the order of the shards, so the results do not depend on the number of threads.

use super::step_output::StepOutput;
use rayon::prelude::*;
use std::ops::Range;
use swm_core::Result;

/// Returns the mean of a step over shards of `rows` rows, each weighted by its number of rows. `shard(range)` computes
/// the mean over the rows of `range`.
///
/// # Errors
/// The first error of a shard.
pub fn mean(
    rows: usize,
    shards: usize,
    shard: impl Fn(Range<usize>) -> Result<StepOutput> + Sync,
) -> Result<StepOutput> {
    let size = rows.div_ceil(shards.max(1)).max(1);
    let ranges: Vec<Range<usize>> = (0..rows).step_by(size).map(|start| start..(start + size).min(rows)).collect();
    let outputs: Result<Vec<StepOutput>> = ranges.par_iter().map(|range| shard(range.clone())).collect();
    let mut sum = StepOutput::default();
    for (output, range) in outputs?.into_iter().zip(&ranges) {
        sum.add(output.scaled(range.len() as f64 / rows as f64));
    }
    Ok(sum)
}
