//! The charts of searches: costs and spread over iterations.

use super::svg::{HALF, Scale, Svg};
use crate::group::{Condition, Row};
use crate::text::shorten;
use swm_core::results::{Band, Searches};

/// The charts of all traced runs of a condition with more than one iteration.
pub(crate) fn charts(condition: &Condition<'_>) -> String {
    let traced = condition.rows.iter().filter_map(|row| Some((row, row.run.searches.as_ref()?)));
    traced
        .filter(|(_, searches)| searches.best.len() > 1)
        .map(|(row, searches)| {
            let title = format!("{}, {}", row.label, condition.name);
            let costs = [("mean of elites", &searches.mean), ("best", &searches.best)];
            let spread = [("spread", &searches.spread)];
            bands(row, &format!("{title}: cost"), &costs, searches)
                + &if searches.spread.is_empty() {
                    String::new()
                } else {
                    bands(row, &format!("{title}: spread"), &spread, searches)
                }
        })
        .collect()
}

/// Draws medians over iterations as lines, with a band from the tenth to the ninetieth percentile.
fn bands(row: &Row<'_>, title: &str, curves: &[(&str, &Vec<Band>)], searches: &Searches) -> String {
    let [left, top, bottom] = [56.0, 46.0, 200.0];
    let right = HALF - 12.0;
    let all = || curves.iter().flat_map(|(_, bands)| bands.iter());
    let low = all().map(|band| f64::from(band.low)).fold(f64::INFINITY, f64::min);
    let high = all().map(|band| f64::from(band.high)).fold(f64::NEG_INFINITY, f64::max);
    if !(low.is_finite() && high.is_finite()) {
        return String::new();
    }
    let longest = curves.iter().map(|(_, bands)| bands.len()).max().unwrap_or(1);
    // The axis of positive costs starts at zero, to show the relative decrease of the costs.
    let (y, levels) = Scale::nice(low.min(0.0), high, bottom, top, 4);
    let (nice, ticks) = Scale::nice(1.0, longest.max(2) as f64, left, right, 5);
    let x = Scale { low: 1.0, high: longest.max(2) as f64, ..nice };
    let ticks: Vec<f64> =
        ticks.into_iter().filter(|tick| (x.low..=x.high).contains(tick) && tick.fract() == 0.0).collect();
    let mut svg = Svg::new(HALF, bottom + 42.0);
    svg.text("head", [0.0, 16.0], &shorten(title, 58));
    svg.y_axis(y, &levels, [left, right], "");
    svg.x_axis(x, &ticks, [top, bottom], "");
    svg.text("tick middle", [(left + right) / 2.0, bottom + 36.0], "iteration");
    for (i, (name, bands)) in curves.iter().enumerate() {
        let point = |i: usize, value: f32| [x.at((i + 1) as f64), y.at(f64::from(value))];
        let upper = bands.iter().enumerate().map(|(i, band)| point(i, band.high));
        let lower = bands.iter().enumerate().rev().map(|(i, band)| point(i, band.low));
        svg.area(&format!("spread {}", row.class), upper.chain(lower));
        // All curves but the last are dashed.
        let class = if i + 1 == curves.len() { "curve" } else { "curve dashed" };
        svg.path(&format!("{class} {}", row.class), bands.iter().enumerate().map(|(i, band)| point(i, band.median)));
        let key = left + 150.0 * i as f64;
        if curves.len() > 1 {
            svg.path(&format!("{class} {}", row.class), [[key, 32.0], [key + 26.0, 32.0]]);
            svg.text("tick", [key + 32.0, 36.0], name);
        }
    }
    svg.text("tick end", [right, 36.0], &format!("{} plans", searches.plans));
    svg.finish(&format!("{title}, median and 10th to 90th percentile of {} plans, by iteration", searches.plans))
}
