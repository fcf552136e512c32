//! [`Elites`]: the cheapest candidates of one environment.
//!
//! Ties between costs are broken by index, so that the choice does not depend on the selection algorithm.

use std::cmp::Ordering;
use swm_core::PlanTrace;

/// The cheapest candidates of one environment, cheapest first.
#[derive(Clone, Copy)]
pub struct Elites<'a> {
    /// The number of values of one candidate.
    len: usize,
    /// All candidates, `[samples, horizon, dim]`.
    actions: &'a [f32],
    /// The costs of all candidates, `[samples]`.
    costs: &'a [f32],
    /// The indices of the elites.
    chosen: &'a [usize],
}

/// The number of plan values that [`Elites::sum`] accumulates at once. With one accumulator, every addition would have
/// to wait for the result of the previous one.
const LANES: usize = 8;

impl<'a> Elites<'a> {
    /// Selects the `k` cheapest candidates. `order` is scratch memory.
    ///
    /// # Shapes
    /// `actions` is `[samples, horizon, dim]`, `costs` is `[samples]`.
    ///
    /// # Panics
    /// When `k` is 0 or exceeds the number of samples: the solver checks its settings first.
    pub fn select(actions: &'a [f32], costs: &'a [f32], k: usize, order: &'a mut Vec<usize>) -> Self {
        Self { len: actions.len() / costs.len(), actions, costs, chosen: smallest(costs, k, order) }
    }

    /// The action sequences, `[horizon, dim]` each.
    pub fn actions(self) -> impl Iterator<Item = &'a [f32]> + Clone {
        self.chosen.iter().map(move |&i| &self.actions[i * self.len..][..self.len])
    }

    /// The number of elites.
    pub fn count(self) -> usize {
        self.chosen.len()
    }

    /// The cost of an elite.
    pub fn cost(self, elite: usize) -> f32 {
        self.costs[self.chosen[elite]]
    }

    /// The cheapest action sequence, `[horizon, dim]`.
    pub fn best(self) -> &'a [f32] {
        &self.actions[self.chosen[0] * self.len..][..self.len]
    }

    /// Moves a diagonal Gaussian to the mean and the unbiased standard deviation of the elites. The old moments keep
    /// the weight `momentum`.
    ///
    /// # Shapes
    /// `mean` and `std` are `[horizon, dim]`.
    pub fn refit(self, momentum: f32, mean: &mut [f32], std: &mut [f32]) {
        let n = self.count() as f64;
        let keep = f64::from(momentum);
        let blend = |old: &mut f32, new: f64| *old = (keep * f64::from(*old) + (1.0 - keep) * new) as f32;
        for (block, (mean, std)) in mean.chunks_mut(LANES).zip(std.chunks_mut(LANES)).enumerate() {
            let centre = self.sum(block, |_, _, a| a).map(|sum| sum / n);
            let square = self.sum(block, |_, lane, a| (a - centre[lane]).powi(2));
            mean.iter_mut().zip(centre).for_each(|(mean, centre)| blend(mean, centre));
            std.iter_mut().zip(square).for_each(|(std, square)| blend(std, (square / (n - 1.0)).sqrt()));
        }
    }

    /// Writes the weighted mean of the elites.
    ///
    /// # Shapes
    /// `weights` is `[elites]` and adds up to 1; `mean` is `[horizon, dim]`.
    pub fn weighted_mean(self, weights: &[f64], mean: &mut [f32]) {
        for (block, mean) in mean.chunks_mut(LANES).enumerate() {
            let sum = self.sum(block, |elite, _, a| weights[elite] * a);
            mean.iter_mut().zip(sum).for_each(|(mean, sum)| *mean = sum as f32);
        }
    }

    /// Sums `term(elite, lane, action)` over the elites, for every value of one block of a plan. The order is always
    /// from the cheapest elite to the most expensive, so that the rounding does not depend on the selection algorithm.
    fn sum(self, block: usize, term: impl Fn(usize, usize, f64) -> f64) -> [f64; LANES] {
        let mut sums = [0.0; LANES];
        for (elite, actions) in self.actions().enumerate() {
            for (lane, (sum, &action)) in sums.iter_mut().zip(&actions[block * LANES..]).enumerate() {
                *sum += term(elite, lane, f64::from(action));
            }
        }
        sums
    }

    /// Appends an iteration to the trace; `spread` is the spread of the distribution after the iteration.
    pub fn record(self, trace: &mut PlanTrace, spread: f32) {
        let sum: f64 = (0..self.count()).map(|elite| f64::from(self.cost(elite))).sum();
        trace.best.push(self.cost(0));
        trace.mean.push((sum / self.count() as f64) as f32);
        trace.spread.push(spread);
    }
}

/// Returns the indices of the `k` smallest costs, cheapest first; equal costs are ordered by index. `order` is scratch
/// memory.
///
/// # Panics
/// When `k` is 0 or exceeds the number of costs.
pub fn smallest<'a>(costs: &[f32], k: usize, order: &'a mut Vec<usize>) -> &'a [usize] {
    assert!((1..=costs.len()).contains(&k), "the {k} smallest of {}", costs.len());
    order.clear();
    order.extend(0..costs.len());
    if k < order.len() {
        order.select_nth_unstable_by(k - 1, |&a, &b| compare(costs, a, b));
    }
    order[..k].sort_unstable_by(|&a, &b| compare(costs, a, b));
    &order[..k]
}

fn compare(costs: &[f32], a: usize, b: usize) -> Ordering {
    // Adding zero turns -0 into 0, so that the two tie.
    (costs[a] + 0.0).total_cmp(&(costs[b] + 0.0)).then(a.cmp(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smallest_costs_are_selected_with_ties_broken_by_index() {
        let mut order = vec![];
        assert_eq!(smallest(&[2.0, 1.0, 1.0, 0.5, 1.0], 3, &mut order), [3, 1, 2]);
        assert_eq!(smallest(&[0.0, -0.0, 0.0], 2, &mut order), [0, 1]);
        assert_eq!(smallest(&[7.0; 100], 100, &mut order), (0..100).collect::<Vec<_>>());
        assert_eq!(smallest(&[3.0, -1.0], 1, &mut order), [1]);
    }

    #[test]
    fn refit_uses_unbiased_deviation_and_momentum() {
        let (mut mean, mut std, mut order) = ([7.0], [4.0], vec![]);
        let elites = Elites::select(&[1.0, 100.0, 3.0, 5.0], &[1.0, 9.0, 1.0, 0.0], 3, &mut order);
        elites.refit(0.5, &mut mean, &mut std);
        assert_eq!((mean, std), ([5.0], [3.0]));
        elites.refit(0.0, &mut mean, &mut std);
        assert_eq!((mean, std), ([3.0], [2.0]));
        elites.weighted_mean(&[0.5, 0.25, 0.25], &mut mean);
        assert_eq!(mean, [3.5]);
    }
}
