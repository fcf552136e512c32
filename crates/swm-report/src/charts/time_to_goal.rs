//! The chart of the time to goal.

use super::axis::Axis;
use super::curves::{CURVES, Curve, Curves, POINTS, Stroke};
use crate::group::{Condition, Row};
use crate::plot::{self, Ink};
use swm_core::Result;
use swm_core::results::{Counting, EpisodeResult};

/// The fraction of episodes solved within a number of steps, one curve for each run, up to `longest` steps. `None` if no
/// run has an episode that counts.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(condition: &Condition<'_>, counting: Counting, longest: usize) -> Result<Option<String>> {
    // The curve of the random-policy floor is drawn first, so that the other curves cover it.
    let (floors, others): (Vec<_>, Vec<_>) = condition.rows.iter().partition(|row| row.is_floor());
    let curves = floors.into_iter().chain(others).take(CURVES);
    let curves: Vec<Curve> = curves.filter_map(|row| curve(row, counting, longest as f64)).collect();
    let Some(x) = Axis::of([0.0, longest as f64].into_iter()).filter(|_| !curves.is_empty()) else { return Ok(None) };
    let panel = Curves {
        heading: condition.name.to_owned(),
        note: String::new(),
        x,
        x_ticks: &|tick| x.tick(*tick),
        x_title: "steps".to_owned(),
        y: Axis::percent(),
        y_ticks: &|tick| format!("{tick:.0}\u{a0}%"),
        curves,
        description: format!("Fraction of episodes solved within a number of steps, {}", condition.name),
    };
    plot::inline(&panel).map(Some)
}

/// The curve of a run: a step for each solved episode.
fn curve(row: &Row<'_>, counting: Counting, longest: f64) -> Option<Curve> {
    let counted = || row.run.episodes.iter().filter(|episode| counting.counts(episode));
    let n = counted().count();
    let mut steps: Vec<usize> = counted().filter_map(EpisodeResult::time_to_goal).collect();
    steps.sort_unstable();
    let share = |solved: usize| 100.0 * solved as f64 / n as f64;
    // Of very many episodes, only some have a step of their own.
    let every = steps.len().div_ceil(POINTS).max(1);
    let (mut points, mut below) = (vec![[0.0, 0.0]], 0.0);
    for (solved, step) in steps.iter().enumerate().filter(|(i, _)| (i + 1) % every == 0 || i + 1 == steps.len()) {
        points.extend([[*step as f64, below], [*step as f64, share(solved + 1)]]);
        below = share(solved + 1);
    }
    points.push([longest, share(steps.len())]);
    let stroke = if row.is_floor() || row.ink == Ink::Expert { Stroke::Dashed } else { Stroke::Solid };
    (n > 0).then(|| Curve { name: row.label.clone(), ink: row.ink, stroke, points, band: vec![] })
}
