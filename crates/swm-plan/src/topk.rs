//! The elites of a population: the cheapest candidates, ties broken by index so that the choice does not
//! depend on how the selection works.

use std::cmp::Ordering;

/// Writes the indices of the `k` smallest costs to the front of `order`, cheapest first; equal costs come in
/// the order of their indices. `order` is scratch that keeps its memory between calls.
///
/// # Panics
/// When `k` is 0 or exceeds the number of costs: the solver checks its settings before.
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
    // Adding zero makes -0 and 0 the same bits, so they tie.
    (costs[a] + 0.0).total_cmp(&(costs[b] + 0.0)).then(a.cmp(&b))
}

#[cfg(test)]
mod tests {
    use super::smallest;

    #[test]
    fn ties_break_by_index() {
        let mut order = vec![];
        assert_eq!(smallest(&[2.0, 1.0, 1.0, 0.5, 1.0], 3, &mut order), [3, 1, 2]);
        assert_eq!(smallest(&[0.0, -0.0, 0.0], 2, &mut order), [0, 1]);
        assert_eq!(smallest(&[7.0; 100], 100, &mut order), (0..100).collect::<Vec<_>>());
        assert_eq!(smallest(&[3.0, -1.0], 1, &mut order), [1]);
    }
}
