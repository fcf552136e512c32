//! The chart of the time to goal.

use super::svg::{HALF, Scale, Svg};
use crate::group::Condition;
use crate::text::shorten;
use swm_core::results::{Counting, EpisodeResult};

/// The fraction of episodes solved within a number of steps, one curve for each run.
pub(crate) fn chart(condition: &Condition<'_>, counting: Counting, longest: usize) -> String {
    let [left, top, bottom] = [46.0, 30.0, 210.0];
    let right = HALF - 12.0;
    let mut svg = Svg::new(HALF, bottom + 42.0);
    let (nice, ticks) = Scale::nice(0.0, longest as f64, left, right, 5);
    // Curves and axis end at the longest episode.
    let x = Scale { high: longest.max(1) as f64, ..nice };
    let ticks: Vec<f64> = ticks.into_iter().filter(|&tick| tick <= x.high).collect();
    let y = Scale { low: 0.0, high: 100.0, from: bottom, to: top };
    svg.text("head", [0.0, 16.0], &shorten(condition.name, 40));
    svg.y_axis(y, &[0.0, 25.0, 50.0, 75.0, 100.0], [left, right], " %");
    svg.x_axis(x, &ticks, [top, bottom], "");
    svg.text("tick middle", [(left + right) / 2.0, bottom + 36.0], "steps");
    // The curve of the random-policy floor is drawn first, so that the other curves cover it.
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
        for (done, &step) in steps.iter().enumerate() {
            points.push([x.at(step as f64), y.at(100.0 * done as f64 / n as f64)]);
            points.push([x.at(step as f64), y.at(100.0 * (done + 1) as f64 / n as f64)]);
        }
        points.push([right, y.at(100.0 * steps.len() as f64 / n as f64)]);
        svg.path(&format!("curve {}", row.class), points);
    }
    svg.finish(&format!("Fraction of episodes solved within a number of steps, {}", condition.name))
}
