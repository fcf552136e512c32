//! Losses that are means over clips, computed in parallel.
//!
//! Burn works on one thread; parallelism is ours. A batch is cut into a number of parts that the configuration says,
//! never the machine, every part differentiates a copy of its own, and results are added in the order of the parts:
//! numbers do not depend on the number of threads.

use super::run::add;
use super::trainable::StepOutput;
use rayon::prelude::*;
use std::ops::Range;
use swm_core::Result;

/// The mean of a step over parts of `rows`, each weighted by its rows: `part(range)` computes the mean over its own.
///
/// # Errors
/// The first error of a part.
#[allow(clippy::cast_precision_loss)]
pub fn mean(
    rows: usize,
    shards: usize,
    part: impl Fn(Range<usize>) -> Result<StepOutput> + Sync,
) -> Result<StepOutput> {
    let size = rows.div_ceil(shards.max(1)).max(1);
    let ranges: Vec<Range<usize>> = (0..rows).step_by(size).map(|start| start..(start + size).min(rows)).collect();
    let parts: Result<Vec<StepOutput>> = ranges.par_iter().map(|range| part(range.clone())).collect();
    let mut sum = StepOutput::default();
    for (mut output, range) in parts?.into_iter().zip(&ranges) {
        let share = range.len() as f64 / rows as f64;
        for tensors in [&mut output.gradients, &mut output.buffers] {
            *tensors = std::mem::take(tensors).into_iter().map(|(name, tensor)| (name, tensor * share)).collect();
        }
        output.metrics.iter_mut().for_each(|(_, value)| *value *= share);
        if sum.metrics.is_empty() {
            sum.metrics = output.metrics;
        } else {
            for (sum, (_, value)) in sum.metrics.iter_mut().zip(output.metrics) {
                sum.1 += value;
            }
        }
        add(&mut sum.gradients, output.gradients);
        add(&mut sum.buffers, output.buffers);
    }
    Ok(sum)
}
