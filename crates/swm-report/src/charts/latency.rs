//! The chart of planning latency.

use super::axis::Axis;
use super::rows::{Mark, Row, Rows, Section};
use crate::group::Group;
use crate::limits;
use crate::plot;
use crate::text::duration;
use swm_core::Result;

/// Draws the time of a plan as a bar to the median and a whisker to the 95th percentile; `None` if no policy plans. Runs
/// beyond [`limits::CHART_ROWS`] are left out.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(group: &Group<'_>) -> Result<Option<String>> {
    let mut left = limits::CHART_ROWS;
    let sections = group.conditions.iter().map(|condition| {
        let planned = condition.rows.iter().filter_map(|row| Some((row, row.run.timing.plan_seconds?)));
        let rows = planned.take(left).map(|(row, seconds)| {
            let [median, p95] = [seconds.median, seconds.p95].map(duration);
            let sentence = format!(
                "{}: median {median}, 95th percentile {p95}, mean {} of {} plans",
                row.label,
                duration(seconds.mean),
                seconds.n
            );
            // The axis is in milliseconds.
            let marks = [seconds.median, seconds.median, seconds.p95].map(|seconds| (1e3 * seconds).max(0.0));
            let value = format!("{median} · {p95}");
            Row { name: row.label.clone(), ink: row.ink, marks: Some(marks), filled: true, value, sentence }
        });
        let rows: Vec<Row> = rows.collect();
        left -= rows.len();
        Section { heading: condition.name.to_owned(), rows, floor: None }
    });
    let sections: Vec<Section> = sections.filter(|section| !section.rows.is_empty()).collect();
    let ends = sections.iter().flat_map(|section| &section.rows).flat_map(|row| row.marks).flatten();
    let Some(axis) = Axis::of(ends.chain([0.0])).filter(|_| !sections.is_empty()) else { return Ok(None) };
    let rows = Rows {
        sections,
        axis,
        ticks: &|tick| format!("{}\u{a0}ms", axis.tick(*tick)),
        title: "",
        mark: Mark::Bar,
        zero: false,
        room: [210.0, 140.0],
        what: "Planning latency: median and 95th percentile of every policy that plans",
    };
    plot::inline(&rows).map(Some)
}
