//! A search as the page shows it: costs of iterations, and where candidates lead.

use super::Position;
use super::projection::{self, Pca};
use super::scratch::{Codec, Scratch};
use super::watch::{Candidate, Kept, Searched};
use serde_json::{Value, json};
use std::time::{Duration, Instant};
use swm_core::{Result, Snapshot};

/// The longest time for playing candidates; those that are not reached in it have no paths.
const BUDGET: Duration = Duration::from_millis(1500);
/// The most points of a path.
const MOST_POINTS: usize = 60;
/// Cheapest candidates of the last iteration whose last frame is shown.
const ENDS: usize = 4;
/// The side of these frames in pixels.
const SIDE: usize = 96;

/// A candidate and its states.
struct Played<'a> {
    iteration: usize,
    candidate: &'a Candidate,
    states: Vec<Vec<f64>>,
}

/// Returns a search that was made at `start` as JSON.
///
/// # Errors
/// When the environment fails.
pub fn describe(
    searched: &Searched,
    seconds: f64,
    (scratch, start, codec): (&mut Scratch, &Snapshot, &Codec),
    positions: &[Position],
) -> Result<Value> {
    let begun = Instant::now();
    let (mut played, mut ends) = (vec![], vec![]);
    'iterations: for (order, kept) in by_importance(&searched.kept).into_iter().enumerate() {
        for candidate in &kept.candidates {
            if !played.is_empty() && begun.elapsed() > BUDGET {
                break 'iterations;
            }
            let states = scratch.play(start, codec, &candidate.actions)?;
            let most = if order == 0 { ENDS } else { 1 };
            if candidate.rank.is_some_and(|rank| rank < most) {
                let (rank, cost) = (candidate.rank, candidate.cost);
                ends.push(json!({"iteration": kept.index, "rank": rank, "cost": cost, "jpeg": scratch.end(SIDE)?}));
            }
            played.push(Played { iteration: kept.index, candidate, states });
        }
    }
    let pca = match positions {
        [] => Pca::of(played.iter().flat_map(|played| played.states.iter().map(Vec::as_slice))),
        _ => None,
    };
    let names: Vec<&str> = positions.iter().map(|position| position.name).collect();
    let paths: Vec<Value> = played.iter().map(|played| path(played, positions, pca.as_ref())).collect();
    let costs = searched.costs.iter();
    Ok(json!({
        "seconds": seconds,
        "best": costs.clone().map(|costs| costs.best).collect::<Vec<_>>(),
        "mean": costs.clone().map(|costs| costs.mean).collect::<Vec<_>>(),
        "elites": costs.clone().map(|costs| costs.elites).collect::<Vec<_>>(),
        "spread": costs.map(|costs| costs.spread).collect::<Vec<_>>(),
        "iterations": searched.kept.iter().map(|kept| json!({
            "index": kept.index, "costs": kept.costs, "elites": kept.elites, "samples": kept.samples,
        })).collect::<Vec<_>>(),
        "names": names,
        "explained": pca.map(|pca| pca.explained),
        "paths": paths,
        "ends": ends,
    }))
}

/// The last iteration, the first, then those between in an order that fills gaps.
fn by_importance(kept: &[Kept]) -> Vec<&Kept> {
    let mut order: Vec<usize> = vec![];
    let mut stride = kept.len().next_power_of_two();
    order.extend(kept.len().checked_sub(1));
    while stride > 0 {
        for i in (0..kept.len()).step_by(stride) {
            if !order.contains(&i) {
                order.push(i);
            }
        }
        stride /= 2;
    }
    order.into_iter().map(|i| &kept[i]).collect()
}

fn path(played: &Played<'_>, positions: &[Position], pca: Option<&Pca>) -> Value {
    let states = &played.states;
    let stride = states.len().div_ceil(MOST_POINTS).max(1);
    // Every stride-th state, and the last.
    let shown = states.iter().enumerate().filter(|(i, _)| (states.len() - 1 - i).is_multiple_of(stride));
    let shown: Vec<&Vec<f64>> = shown.map(|(_, state)| state).collect();
    let lines: projection::Paths = match pca {
        Some(pca) => vec![shown.iter().map(|state| pca.point(state)).collect()],
        None => {
            let points: Vec<_> = shown.iter().map(|state| projection::positions(state, positions)).collect();
            (0..positions.len()).map(|which| points.iter().map(|points| points[which]).collect()).collect()
        }
    };
    json!({"iteration": played.iteration, "rank": played.candidate.rank, "cost": played.candidate.cost, "lines": lines})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_and_the_first_iteration_are_played_first() {
        let kept = |index| Kept { index, costs: vec![], elites: 0, samples: 0, candidates: vec![] };
        let all: Vec<Kept> = (0..6).map(kept).collect();
        let order: Vec<usize> = by_importance(&all).iter().map(|kept| kept.index).collect();
        assert_eq!(order, [5, 0, 4, 2, 1, 3]);
        assert!(by_importance(&[]).is_empty());
    }
}
