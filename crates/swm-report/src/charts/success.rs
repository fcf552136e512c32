//! The chart of success rates.

use super::svg::{LABELS, NAME, ROW, Scale, Svg, WIDE};
use crate::group::Group;
use crate::text::{percent, shorten};
use std::fmt::Write as _;

/// Success rates with their 95 % confidence intervals, one row for each run. The interval of the random-policy floor is
/// a band across its condition.
pub(crate) fn chart(group: &Group<'_>) -> String {
    const HEAD: f64 = 34.0;
    let rows = group.rows().count();
    let bottom = 8.0 + group.conditions.len() as f64 * HEAD + rows as f64 * ROW;
    let right = WIDE - 130.0;
    let scale = Scale { low: 0.0, high: 100.0, from: LABELS, to: right };
    let mut svg = Svg::new(WIDE, bottom + 26.0);
    svg.x_axis(scale, &[0.0, 20.0, 40.0, 60.0, 80.0, 100.0], [8.0, bottom], " %");
    let mut top = 8.0;
    for condition in &group.conditions {
        svg.text("head", [0.0, top + 24.0], &shorten(condition.name, 60));
        let first = top + HEAD;
        let height = condition.rows.len() as f64 * ROW;
        if let Some(floor) = condition.floor() {
            let p = floor.run.success;
            let (low, high) = (scale.at(p.low * 100.0), scale.at(p.high * 100.0));
            svg.rect("band", [low, first], [high - low, height], "");
            let x = scale.at(p.rate * 100.0);
            svg.line("floor-line", [x, first], [x, first + height]);
        }
        for (i, row) in condition.rows.iter().enumerate() {
            let y = first + (i as f64 + 0.5) * ROW;
            let p = row.run.success;
            let tip = format!(
                "{}: {} ({} of {}), 95 % confidence interval {} to {}",
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
                svg.text("value quiet", [right + 14.0, y + 4.5], "no episodes");
            }
        }
        top = first + height;
    }
    svg.finish(&format!("Success rates with 95 % confidence intervals: {}", summary(group)))
}

/// All success rates as a text, for screen readers.
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
