//! [`Watch`]: reads the iterations of a search, and keeps some candidates of some of them.

use super::messages::Reply;
use crate::session::Out;
use std::ops::ControlFlow;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use swm_core::{Error, Iteration, Result, SearchObserver};
use swm_plan::PlanObserver;

/// Iterations whose candidates are kept; of a longer search every second, fourth, … and the last.
const MOST_KEPT: usize = 16;
/// The cheapest candidates of an iteration that are kept.
const CHEAPEST: usize = 8;
/// Other candidates of an iteration that are kept.
const OTHERS: usize = 8;
/// Values of the kept candidates of an iteration: longer candidates are fewer.
const MOST_VALUES: usize = 1 << 16;
/// Costs of an iteration that are kept, from the lowest to the highest.
const COSTS: usize = 40;
/// The time between two reports of a search.
const REPORT: Duration = Duration::from_millis(100);

/// What an iteration found.
#[derive(Clone, Debug, PartialEq)]
pub struct Costs {
    /// The lowest cost.
    pub best: f32,
    /// The mean cost of all candidates.
    pub mean: f32,
    /// The mean cost of the elites; that of all candidates if the solver has no elites.
    pub elites: f32,
    /// The standard deviation of the elites (of all candidates without elites), averaged over the values of a candidate.
    pub spread: f32,
}

/// A candidate.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The actions in plan values, `[horizon, dim]`.
    pub actions: Vec<f32>,
    /// The cost.
    pub cost: f32,
    /// The place among the cheapest, from 0; `None` for one that is not among them.
    pub rank: Option<usize>,
}

/// Some candidates of an iteration.
#[derive(Clone, Debug, PartialEq)]
pub struct Kept {
    /// The index of the iteration.
    pub index: usize,
    /// Costs from the lowest to the highest, at most [`COSTS`].
    pub costs: Vec<f32>,
    /// The number of elites; 0 if the solver has none.
    pub elites: usize,
    /// The number of candidates.
    pub samples: usize,
    /// The cheapest candidates in order, then others.
    pub candidates: Vec<Candidate>,
}

/// A search.
#[derive(Clone, Debug, Default)]
pub struct Searched {
    /// The costs of every iteration.
    pub costs: Vec<Costs>,
    /// Some candidates of some iterations, in order, the last iteration among them.
    pub kept: Vec<Kept>,
    stride: usize,
    last: Option<Kept>,
    reported: Option<Instant>,
}

/// Reads the searches of the policy of a session. Clones are the same watch.
#[derive(Clone)]
pub struct Watch {
    searched: Arc<Mutex<Searched>>,
    out: Out,
}

impl Watch {
    /// A watch that reports to a page, and ends searches that it has enough of.
    pub fn new(out: Out) -> Self {
        Self { searched: Arc::default(), out }
    }

    fn lock(&self) -> MutexGuard<'_, Searched> {
        self.searched.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the last search; `None` if there was none since the last call.
    pub fn take(&self) -> Option<Searched> {
        let mut searched = std::mem::take(&mut *self.lock());
        let last = searched.last.take();
        let is_kept = |last: &Kept| searched.kept.last().is_some_and(|kept| kept.index == last.index);
        if let Some(last) = last.filter(|last| !is_kept(last)) {
            searched.kept.push(last);
        }
        (!searched.costs.is_empty()).then_some(searched)
    }
}

impl SearchObserver for Watch {
    fn iteration(&self, iteration: &Iteration<'_>) -> Result<ControlFlow<()>> {
        if self.out.gone.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        let mut searched = self.lock();
        searched.add(iteration);
        let due = searched.reported.is_none_or(|reported| reported.elapsed() >= REPORT);
        if let (true, Some(costs)) = (due, searched.costs.last()) {
            self.out.reply(&Reply::Searching { iteration: iteration.index, best: costs.best });
            searched.reported = Some(Instant::now());
        }
        let enough = self.out.enough.load(Ordering::Relaxed);
        Ok(if enough { ControlFlow::Break(()) } else { ControlFlow::Continue(()) })
    }
}

impl PlanObserver for Watch {
    fn begin(&self, _: &[usize]) -> Result<()> {
        *self.lock() = Searched { stride: 1, reported: Some(Instant::now()), ..Searched::default() };
        Ok(())
    }

    fn end(&self) -> Result<()> {
        Ok(())
    }
}

impl Searched {
    /// Adds an iteration, of which it reads the first environment.
    fn add(&mut self, iteration: &Iteration<'_>) {
        let candidates = &iteration.candidates;
        let (samples, len) = (candidates.samples, candidates.horizon * candidates.dim);
        let costs = &iteration.costs[..samples];
        let elites = &iteration.elites[..iteration.elites.len() / candidates.envs.max(1)];
        let mut order: Vec<usize> = (0..samples).collect();
        order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]));
        let chosen = if elites.is_empty() { &order[..] } else { elites };
        let actions = |i: usize| &candidates.actions[i * len..][..len];
        self.costs.push(Costs {
            best: costs[order[0]],
            mean: mean(costs.iter().copied()),
            elites: mean(chosen.iter().map(|&i| costs[i])),
            spread: spread(chosen, len, |i, j| actions(i)[j]),
        });
        // A candidate that is long is kept with fewer beside it.
        let room = (MOST_VALUES / len.max(1)).max(1);
        let cheapest = CHEAPEST.min(room).min(samples);
        let others = OTHERS.min(room - cheapest).min(samples - cheapest);
        let rest = &order[cheapest..];
        let evenly = (0..others).map(|i| (rest[(2 * i + 1) * rest.len() / (2 * others)], None));
        let kept = order[..cheapest].iter().enumerate().map(|(rank, &i)| (i, Some(rank))).chain(evenly);
        let steps = COSTS.min(samples);
        let kept = Kept {
            index: iteration.index,
            costs: (0..steps).map(|i| costs[order[i * (samples - 1) / (steps - 1).max(1)]]).collect(),
            elites: elites.len(),
            samples,
            candidates: kept
                .map(|(i, rank)| Candidate { actions: actions(i).to_vec(), cost: costs[i], rank })
                .collect(),
        };
        if iteration.index.is_multiple_of(self.stride.max(1)) {
            self.kept.push(kept.clone());
        }
        self.last = Some(kept);
        if self.kept.len() > MOST_KEPT {
            self.stride *= 2;
            let stride = self.stride;
            self.kept.retain(|kept| kept.index.is_multiple_of(stride));
        }
    }
}

fn mean(values: impl Iterator<Item = f32> + Clone) -> f32 {
    let count = values.clone().count().max(1) as f64;
    (values.map(f64::from).sum::<f64>() / count) as f32
}

/// The standard deviation over candidates, averaged over their values.
fn spread(chosen: &[usize], len: usize, value: impl Fn(usize, usize) -> f32) -> f32 {
    let deviation = |j: usize| {
        let values = || chosen.iter().map(|&i| f64::from(value(i, j)));
        let mean = values().sum::<f64>() / chosen.len() as f64;
        (values().map(|v| (v - mean).powi(2)).sum::<f64>() / chosen.len() as f64).sqrt()
    };
    ((0..len).map(deviation).sum::<f64>() / len.max(1) as f64) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::Candidates;

    #[test]
    fn iterations_are_summarised_and_long_searches_thinned() {
        let mut searched = Searched { stride: 1, ..Searched::default() };
        let costs: Vec<f32> = (0..30).map(|i| ((i * 7) % 30) as f32).collect();
        let actions: Vec<f32> = (0..60).map(|i| i as f32).collect();
        let candidates = Candidates { actions: &actions, envs: 1, samples: 30, horizon: 1, dim: 2 };
        for index in 0..100 {
            let elites = vec![0, 13];
            searched.add(&Iteration { index, candidates, costs: &costs, elites, gradient: None });
        }
        assert_eq!(searched.costs.len(), 100);
        let Costs { best, mean, elites, spread } = searched.costs[0];
        assert_eq!((best, mean, elites, spread), (0.0, 14.5, 0.5, 13.0));
        assert!(searched.kept.len() <= MOST_KEPT && searched.kept[0].index == 0);
        let first = &searched.kept[0];
        assert_eq!((first.costs.len(), first.costs[0], first.costs[29]), (30, 0.0, 29.0));
        assert_eq!(first.candidates.len(), CHEAPEST + OTHERS);
        assert_eq!((first.candidates[1].cost, first.candidates[1].rank), (1.0, Some(1)));
        assert_eq!(first.candidates[1].actions, [26.0, 27.0]);
        assert_eq!(searched.last.map(|kept| kept.index), Some(99));
    }
}
