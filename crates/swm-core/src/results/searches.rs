//! [`Searches`]: the search traces of a run's plans, aggregated per iteration.

use crate::PlanTrace;
use serde::{Deserialize, Serialize};

/// The search traces of many plans, aggregated per iteration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Searches {
    /// The number of plans.
    pub plans: usize,
    /// The lowest cost of each iteration.
    pub best: Vec<Band>,
    /// The mean cost of the elites of each iteration.
    pub mean: Vec<Band>,
    /// The spread of the sampling distribution after each iteration.
    pub spread: Vec<Band>,
}

/// The 10th percentile, the median and the 90th percentile of many values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Band {
    /// The 10th percentile (nearest rank).
    pub low: f32,
    /// The median.
    pub median: f32,
    /// The 90th percentile (nearest rank).
    pub high: f32,
}

impl Searches {
    /// Aggregates traces, in any order; `None` if there are none. An iteration that only some plans reached aggregates
    /// those plans.
    pub fn of(traces: &[PlanTrace]) -> Option<Self> {
        let bands = |column: fn(&PlanTrace) -> &[f32]| {
            let iterations = traces.iter().map(|trace| column(trace).len()).max().unwrap_or(0);
            let at = |i: usize| traces.iter().filter_map(|trace| column(trace).get(i).copied()).collect();
            (0..iterations).map(|i| Band::of(at(i))).collect::<Vec<Band>>()
        };
        let [best, mean, spread] = [bands(|t| &t.best), bands(|t| &t.mean), bands(|t| &t.spread)];
        (!best.is_empty()).then_some(Self { plans: traces.len(), best, mean, spread })
    }
}

impl Band {
    /// The band of at least one value.
    fn of(mut values: Vec<f32>) -> Self {
        values.sort_by(f32::total_cmp);
        let rank = |tenths: usize| values[(values.len() * tenths).div_ceil(10).saturating_sub(1)];
        let middle = f32::midpoint(values[(values.len() - 1) / 2], values[values.len() / 2]);
        Self { low: rank(1), median: middle, high: rank(9) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trace(best: &[f32]) -> PlanTrace {
        PlanTrace { best: best.to_vec(), mean: vec![1.0], ..PlanTrace::default() }
    }

    #[test]
    fn cost_bands_do_not_depend_on_the_order_of_plans() {
        let mut traces: Vec<PlanTrace> = (0..10u8).map(|i| trace(&[f32::from(i), 0.5])).collect();
        traces.push(trace(&[10.0]));
        let found = Searches::of(&traces).expect("aggregating eleven traces");
        assert_eq!(found.best[0], Band { low: 1.0, median: 5.0, high: 9.0 });
        assert_eq!(found.best[1], Band { low: 0.5, median: 0.5, high: 0.5 }, "ten plans have a second iteration");
        assert_eq!((found.plans, found.mean.len(), found.spread.len()), (11, 1, 0));
        traces.reverse();
        assert_eq!(Searches::of(&traces), Some(found));
        assert_eq!(Searches::of(&[PlanTrace::default()]), None, "an empty trace gives no statistics");
    }
}
