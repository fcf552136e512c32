//! The charts of training metrics.

use super::svg::{HALF, Scale, Svg};

use crate::text::{number, shorten};
use crate::training_log::{Metrics, Series};

/// Draws the curve of one metric of a training log; `None` for fewer than two points.
pub(crate) fn chart(metrics: &Metrics, series: &Series) -> Option<String> {
    let [left, top, bottom] = [56.0, 30.0, 150.0];
    let right = HALF - 12.0;
    let points: Vec<(f64, f64)> =
        series.points.iter().copied().filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
    let (&(first, _), &(last, end)) = (points.first()?, points.last()?);
    if points.len() < 2 || last <= first {
        return None;
    }
    let range = |f: fn(f64, f64) -> f64, from: f64| points.iter().map(|p| p.1).fold(from, f);
    let (low, high) = (range(f64::min, f64::INFINITY), range(f64::max, f64::NEG_INFINITY));
    let mut svg = Svg::new(HALF, bottom + 42.0);
    let (nice, ticks) = Scale::nice(first, last, left, right, 4);
    let x = Scale { low: first, high: last, ..nice };
    let ticks: Vec<f64> = ticks.into_iter().filter(|tick| (first..=last).contains(tick)).collect();
    let (y, levels) = Scale::nice(low, high, bottom, top, 4);
    svg.text("head", [0.0, 16.0], &shorten(&series.name, 30));
    svg.text("value end", [right, 16.0], &number(end));
    svg.y_axis(y, &levels, [left, right], "");
    svg.x_axis(x, &ticks, [top, bottom], "");
    svg.text("tick middle", [(left + right) / 2.0, bottom + 36.0], &metrics.over);
    let thinned = thin(&points, 300);
    svg.path("curve c0", thinned.into_iter().map(|(a, b)| [x.at(a), y.at(b)]));
    Some(svg.finish(&format!("{} over {}, ending at {}", series.name, metrics.over, number(end))))
}

/// Reduces a curve to at most `most` points, each the mean of equally many neighbours.
fn thin(points: &[(f64, f64)], most: usize) -> Vec<(f64, f64)> {
    points
        .chunks(points.len().div_ceil(most).max(1))
        .map(|chunk| {
            let n = chunk.len() as f64;
            (chunk.iter().map(|p| p.0).sum::<f64>() / n, chunk.iter().map(|p| p.1).sum::<f64>() / n)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_reduced_to_means() {
        let points: Vec<(f64, f64)> = (0..10).map(|i| (f64::from(i), f64::from(i * 2))).collect();
        assert_eq!(thin(&points, 5), [(0.5, 1.0), (2.5, 5.0), (4.5, 9.0), (6.5, 13.0), (8.5, 17.0)]);
        assert_eq!(thin(&points, 300).len(), 10);
    }
}
