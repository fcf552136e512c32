//! The charts of training metrics.

use super::axis::Axis;
use super::curves::{Curve, Curves, Stroke, thin};
use crate::plot::{self, Ink};
use crate::text::{number, shorten};
use crate::training_log::{Metrics, Series};
use swm_core::Result;

/// Draws the curve of one metric of a training log; `None` for fewer than two points.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(metrics: &Metrics, series: &Series, ink: Ink) -> Result<Option<String>> {
    let finite = series.points.iter().filter(|(x, y)| x.is_finite() && y.is_finite());
    let points: Vec<[f64; 2]> = finite.map(|(x, y)| [*x, *y]).collect();
    let axes = Axis::of(points.iter().map(|p| p[0])).zip(Axis::of(points.iter().map(|p| p[1])));
    let (Some([first, _]), Some([last, end]), Some((x, y))) = (points.first(), points.last(), axes) else {
        return Ok(None);
    };
    if points.len() < 2 || last <= first {
        return Ok(None);
    }
    let y = y.with_room();
    let curve = Curve { name: String::new(), ink, stroke: Stroke::Solid, points: thin(&points), band: vec![] };
    let panel = Curves {
        heading: shorten(&series.name, 60),
        note: number(*end),
        x,
        x_ticks: &|tick| x.tick(*tick),
        x_title: metrics.over.clone(),
        y,
        y_ticks: &|tick| y.tick(*tick),
        curves: vec![curve],
        description: format!("{} over {}, ending at {}", series.name, metrics.over, number(*end)),
    };
    plot::inline(&panel).map(Some)
}
