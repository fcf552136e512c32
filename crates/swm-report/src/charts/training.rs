//! The charts of training metrics.

use super::axis::Axis;
use super::curves::{CURVES, Curve, Curves, Stroke, thin};
use crate::plot::{self, Ink};
use crate::text::{number, shorten};
use crate::training_log::{Metrics, Series};
use swm_core::{Error, Result};

/// Draws one metric of several trainings, each a name with its points, as an SVG file: the metric over `over`.
///
/// # Errors
/// When no curve has two finite points, there are more than a panel holds, or drawing fails.
pub fn curves_svg(metric: &str, over: &str, trainings: &[(String, Vec<(f64, f64)>)]) -> Result<String> {
    let finite = |points: &[(f64, f64)]| -> Vec<[f64; 2]> {
        points.iter().filter(|(x, y)| x.is_finite() && y.is_finite()).map(|(x, y)| [*x, *y]).collect()
    };
    if trainings.len() > CURVES {
        let problem = format!("{} curves, and a figure holds {CURVES}", trainings.len());
        return Err(Error::config("plot", problem, "name fewer runs"));
    }
    let curves: Vec<Curve> = trainings
        .iter()
        .enumerate()
        .map(|(index, (name, points))| Curve {
            name: shorten(name, 40),
            ink: Ink::Policy(index),
            stroke: Stroke::Solid,
            points: thin(&finite(points)),
            band: vec![],
        })
        .filter(|curve| curve.points.len() > 1)
        .collect();
    let all = || curves.iter().flat_map(|curve| &curve.points);
    let Some((x, y)) = Axis::of(all().map(|p| p[0])).zip(Axis::of(all().map(|p| p[1]))) else {
        let problem = format!("no run has two values of {metric}");
        return Err(Error::config("plot", problem, "name another metric, or wait for more steps"));
    };
    let y = y.with_room();
    let description = format!("{metric} over {over}");
    let panel = Curves {
        heading: shorten(metric, 60),
        note: String::new(),
        x,
        x_ticks: &|tick| x.tick(*tick),
        x_title: over.to_owned(),
        y,
        y_ticks: &|tick| y.tick(*tick),
        curves,
        description,
    };
    plot::svg(&panel)
}

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
