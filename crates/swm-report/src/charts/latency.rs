//! The chart of planning latency.

use super::svg::{LABELS, NAME, Scale, Svg, WIDE};
use crate::group::Group;
use crate::text::{duration, shorten};

/// Draws the time of a plan as a bar to the median and a whisker to the 95th percentile; `None` if no policy plans.
pub(crate) fn chart(group: &Group<'_>) -> Option<String> {
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
    // The axis is in milliseconds.
    let right = WIDE - 170.0;
    let (scale, ticks) = Scale::nice(0.0, longest * 1e3, LABELS, right, 5);
    let bottom = 6.0 + planned.len() as f64 * 40.0;
    let mut svg = Svg::new(WIDE, bottom + 26.0);
    svg.x_axis(scale, &ticks, [6.0, bottom], " ms");
    for (i, (condition, row, seconds)) in planned.iter().enumerate() {
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
