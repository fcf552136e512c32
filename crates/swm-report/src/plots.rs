//! The plots: success with its intervals, success over steps, every episode, latency, and training curves.

use crate::chart::{Scale, Svg};
use crate::group::{Condition, Group};
use crate::read::{Metrics, Series};
use crate::text::{duration, number, outcome, percent, shorten};
use std::fmt::Write as _;
use swm_core::results::{Counting, EpisodeResult};

/// Width of the plots that fill the page.
const WIDE: f64 = 920.0;
/// Width of the plots of which two stand side by side.
const HALF: f64 = 440.0;
/// Where labelled rows begin.
const LABELS: f64 = 200.0;
/// Letters of a name that have room there.
const NAME: usize = 23;
/// Height of a labelled row.
const ROW: f64 = 30.0;

/// Success rates with their 95 % intervals, one row a run; the floor's interval is a band across its condition.
pub(crate) fn success(group: &Group<'_>) -> String {
    const HEAD: f64 = 34.0;
    let rows = group.rows().count();
    #[allow(clippy::cast_precision_loss)]
    let bottom = 8.0 + group.conditions.len() as f64 * HEAD + rows as f64 * ROW;
    let right = WIDE - 130.0;
    let scale = Scale { low: 0.0, high: 100.0, from: LABELS, to: right };
    let mut svg = Svg::new(WIDE, bottom + 26.0);
    svg.x_axis(scale, &[0.0, 20.0, 40.0, 60.0, 80.0, 100.0], [8.0, bottom], " %");
    let mut top = 8.0;
    for condition in &group.conditions {
        svg.text("head", [0.0, top + 24.0], &shorten(condition.name, 60));
        let first = top + HEAD;
        #[allow(clippy::cast_precision_loss)]
        let height = condition.rows.len() as f64 * ROW;
        if let Some(floor) = condition.floor() {
            let p = floor.run.success;
            let (low, high) = (scale.at(p.low * 100.0), scale.at(p.high * 100.0));
            svg.rect("band", [low, first], [high - low, height], "");
            let x = scale.at(p.rate * 100.0);
            svg.line("floor-line", [x, first], [x, first + height]);
        }
        for (i, row) in condition.rows.iter().enumerate() {
            #[allow(clippy::cast_precision_loss)]
            let y = first + (i as f64 + 0.5) * ROW;
            let p = row.run.success;
            let tip = format!(
                "{}: {} ({} of {}), 95 % interval {} to {}",
                row.label,
                percent(p.rate),
                p.successes,
                p.n,
                percent(p.low),
                percent(p.high)
            );
            svg.text("label end", [LABELS - 14.0, y + 4.5], &shorten(&row.label, NAME));
            let (low, high) = (scale.at(p.low * 100.0), scale.at(p.high * 100.0));
            svg.line(&format!("whisker {}", row.class), [low, y], [high, y]);
            for x in [low, high] {
                svg.line(&format!("whisker {}", row.class), [x, y - 5.0], [x, y + 5.0]);
            }
            if p.n > 0 {
                svg.dot(&format!("point {}", row.class), [scale.at(p.rate * 100.0), y], 5.5, &tip);
                svg.text("value", [right + 14.0, y + 4.5], &format!("{} ({}/{})", percent(p.rate), p.successes, p.n));
            } else {
                svg.text("value quiet", [right + 14.0, y + 4.5], "nothing counted");
            }
        }
        top = first + height;
    }
    svg.finish(&format!("Success rates with 95 % intervals: {}", summary(group)))
}

/// All success rates in words, for readers that do not see the plot.
fn summary(group: &Group<'_>) -> String {
    let mut words = String::new();
    for condition in &group.conditions {
        let _ = write!(words, "{}{}: ", if words.is_empty() { "" } else { "; " }, condition.name);
        for (i, row) in condition.rows.iter().enumerate() {
            let comma = if i == 0 { "" } else { ", " };
            let _ = write!(words, "{comma}{} {}", row.label, percent(row.run.success.rate));
        }
    }
    words
}

/// The share of episodes solved within so many steps, a curve a run.
pub(crate) fn progress(condition: &Condition<'_>, counting: Counting, longest: usize) -> String {
    let [left, top, bottom] = [46.0, 30.0, 210.0];
    let right = HALF - 12.0;
    let mut svg = Svg::new(HALF, bottom + 42.0);
    #[allow(clippy::cast_precision_loss)]
    let (nice, ticks) = Scale::nice(0.0, longest as f64, left, right, 5);
    // Curves end where episodes do, so the axis does too.
    #[allow(clippy::cast_precision_loss)]
    let x = Scale { high: longest.max(1) as f64, ..nice };
    let ticks: Vec<f64> = ticks.into_iter().filter(|&tick| tick <= x.high).collect();
    let y = Scale { low: 0.0, high: 100.0, from: bottom, to: top };
    svg.text("head", [0.0, 16.0], &shorten(condition.name, 40));
    svg.y_axis(y, &[0.0, 25.0, 50.0, 75.0, 100.0], [left, right], " %");
    svg.x_axis(x, &ticks, [top, bottom], "");
    svg.text("tick middle", [(left + right) / 2.0, bottom + 36.0], "steps");
    // The floor first, so that everything else lies on top of it.
    let (floors, others): (Vec<_>, Vec<_>) = condition.rows.iter().partition(|row| row.is_floor());
    for row in floors.into_iter().chain(others) {
        let counted = || row.run.episodes.iter().filter(|episode| counting.counts(episode));
        let n = counted().count();
        if n == 0 {
            continue;
        }
        let mut steps: Vec<usize> = counted().filter_map(EpisodeResult::time_to_goal).collect();
        steps.sort_unstable();
        let mut points = vec![[x.at(0.0), y.at(0.0)]];
        #[allow(clippy::cast_precision_loss)]
        for (done, &step) in steps.iter().enumerate() {
            points.push([x.at(step as f64), y.at(100.0 * done as f64 / n as f64)]);
            points.push([x.at(step as f64), y.at(100.0 * (done + 1) as f64 / n as f64)]);
        }
        #[allow(clippy::cast_precision_loss)]
        points.push([right, y.at(100.0 * steps.len() as f64 / n as f64)]);
        svg.path(&format!("curve {}", row.class), points);
    }
    svg.finish(&format!("Share of episodes solved within a number of steps, {}", condition.name))
}

/// Every episode as a square, in order, so that runs over the same starts can be compared start by start.
pub(crate) fn episodes(group: &Group<'_>) -> String {
    const CELL: f64 = 12.0;
    const A_LINE: usize = 60;
    let lines = |n: usize| n.div_ceil(A_LINE).max(1);
    #[allow(clippy::cast_precision_loss)]
    let height: f64 = group.conditions.iter().map(|_| 34.0).sum::<f64>()
        + group.rows().map(|row| lines(row.run.episodes.len()) as f64 * CELL + 11.0).sum::<f64>();
    let mut svg = Svg::new(WIDE, height + 4.0);
    let mut top = 0.0;
    for condition in &group.conditions {
        svg.text("head", [0.0, top + 20.0], &shorten(condition.name, 60));
        top += 34.0;
        for row in &condition.rows {
            svg.text("label end", [LABELS - 14.0, top + 9.5], &shorten(&row.label, NAME));
            for (i, episode) in row.run.episodes.iter().enumerate() {
                #[allow(clippy::cast_precision_loss)]
                let corner = [LABELS + (i % A_LINE) as f64 * CELL, top + (i / A_LINE) as f64 * CELL];
                let (class, outcome) = outcome(episode);
                let class = format!("cell {class} {}", row.class);
                let tip = format!("episode {i}, seed {}: {outcome}", episode.seed);
                svg.rect(&class, corner, [CELL - 2.0, CELL - 2.0], &tip);
            }
            #[allow(clippy::cast_precision_loss)]
            let used = lines(row.run.episodes.len()) as f64 * CELL;
            top += used + 11.0;
        }
    }
    svg.finish("Every episode as a square: filled where it was solved, empty where it was not")
}

/// Seconds a plan took: a bar to the median, a whisker to the 95th percentile. None where nobody plans.
pub(crate) fn latency(group: &Group<'_>) -> Option<String> {
    let planned: Vec<_> = group
        .conditions
        .iter()
        .flat_map(|c| c.rows.iter().map(move |row| (c.name, row)))
        .filter_map(|(name, row)| row.run.timing.plan_seconds.map(|seconds| (name, row, seconds)))
        .collect();
    let longest = planned.iter().map(|(_, _, s)| s.p95.max(s.median)).fold(0.0, f64::max);
    if planned.is_empty() || !longest.is_finite() {
        return None;
    }
    // In milliseconds, as plans mostly are.
    let right = WIDE - 170.0;
    let (scale, ticks) = Scale::nice(0.0, longest * 1e3, LABELS, right, 5);
    #[allow(clippy::cast_precision_loss)]
    let bottom = 6.0 + planned.len() as f64 * 40.0;
    let mut svg = Svg::new(WIDE, bottom + 26.0);
    svg.x_axis(scale, &ticks, [6.0, bottom], " ms");
    for (i, (condition, row, seconds)) in planned.iter().enumerate() {
        #[allow(clippy::cast_precision_loss)]
        let y = 6.0 + (i as f64 + 0.5) * 40.0;
        let (median, p95) = (scale.at(seconds.median * 1e3), scale.at(seconds.p95 * 1e3));
        svg.text("label end", [LABELS - 14.0, y - 2.0], &shorten(&row.label, NAME));
        svg.text("tick end", [LABELS - 14.0, y + 12.0], &shorten(condition, 30));
        let tip = format!("{} plans, mean {}", seconds.n, duration(seconds.mean));
        svg.rect(&format!("bar {}", row.class), [LABELS, y - 8.0], [median - LABELS, 16.0], &tip);
        svg.line(&format!("whisker {}", row.class), [median, y], [p95, y]);
        svg.line(&format!("whisker {}", row.class), [p95, y - 5.0], [p95, y + 5.0]);
        let words = format!("{} · {}", duration(seconds.median), duration(seconds.p95));
        svg.text("value", [right + 14.0, y + 4.5], &words);
    }
    Some(svg.finish("Planning latency: median and 95th percentile of every policy that plans"))
}

/// One curve of a training log.
pub(crate) fn training(metrics: &Metrics, series: &Series) -> Option<String> {
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

/// At most `most` points, each the mean of as many neighbours.
fn thin(points: &[(f64, f64)], most: usize) -> Vec<(f64, f64)> {
    #[allow(clippy::cast_precision_loss)]
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
    fn long_logs_are_thinned_to_means() {
        let points: Vec<(f64, f64)> = (0..10).map(|i| (f64::from(i), f64::from(i * 2))).collect();
        assert_eq!(thin(&points, 5), [(0.5, 1.0), (2.5, 5.0), (4.5, 9.0), (6.5, 13.0), (8.5, 17.0)]);
        assert_eq!(thin(&points, 300).len(), 10);
    }
}
