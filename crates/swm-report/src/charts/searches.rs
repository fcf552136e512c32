//! The charts of searches: costs and spread over iterations.

use super::axis::Axis;
use super::curves::{Curve, Curves, POINTS, Stroke};
use crate::group::Row;
use crate::plot;
use swm_core::Result;
use swm_core::results::{Band, Searches};

/// The charts of a run; none if its searches were not traced or have one iteration.
///
/// # Errors
/// When drawing fails.
pub(crate) fn charts(row: &Row<'_>, condition: &str) -> Result<Vec<String>> {
    let Some(searches) = row.run.searches.as_ref().filter(|searches| searches.best.len() > 1) else {
        return Ok(vec![]);
    };
    let title = format!("{}, {condition}", row.label);
    let costs = [("mean of elites", &searches.mean), ("best", &searches.best)];
    let costs = bands(row, &format!("{title}: cost"), &costs, searches)?;
    let spread = bands(row, &format!("{title}: spread"), &[("", &searches.spread)], searches)?;
    Ok(costs.into_iter().chain(spread).collect())
}

/// Draws medians over iterations as lines, with a band from the tenth to the ninetieth percentile; `None` for values that
/// cannot be drawn.
fn bands(row: &Row<'_>, title: &str, curves: &[(&str, &Vec<Band>)], searches: &Searches) -> Result<Option<String>> {
    let all = || curves.iter().flat_map(|(_, bands)| bands.iter());
    let longest = curves.iter().map(|(_, bands)| bands.len()).max().unwrap_or(0);
    // The axis of positive costs starts at zero, to show the relative decrease of the costs.
    let ends = all().flat_map(|band| [band.low, band.median, band.high]).map(f64::from).chain([0.0]);
    let axes = Axis::of(ends).zip(Axis::of([1.0, longest.max(2) as f64].into_iter()));
    let Some((y, x)) = axes.filter(|_| longest > 1) else { return Ok(None) };
    let curve = |(i, (name, bands)): (usize, &(&str, &Vec<Band>))| {
        // Of very many iterations, only some are drawn.
        let every = bands.len().div_ceil(POINTS).max(1);
        let drawn = || bands.iter().enumerate().step_by(every).map(|(i, band)| ((i + 1) as f64, band));
        Curve {
            name: (*name).to_owned(),
            ink: row.ink,
            stroke: if i + 1 == curves.len() { Stroke::Solid } else { Stroke::Dashed },
            points: drawn().map(|(x, band)| [x, band.median.into()]).collect(),
            band: drawn().map(|(x, band)| [x, band.low.into(), band.high.into()]).collect(),
        }
    };
    let plans = format!("{} plans", searches.plans);
    let panel = Curves {
        heading: title.to_owned(),
        x,
        x_ticks: &|tick| if x.value(*tick).fract() == 0.0 { x.tick(*tick) } else { String::new() },
        x_title: "iteration".to_owned(),
        y,
        y_ticks: &|tick| y.tick(*tick),
        curves: curves.iter().enumerate().map(curve).collect(),
        description: format!("{title}, median and 10th to 90th percentile of {plans}, by iteration"),
        note: plans,
    };
    plot::inline(&panel).map(Some)
}
