//! Paired comparisons of policies on the same starts: the charts of the differences and the table of counts.

use super::axis::Axis;
use super::rows::{Mark, Row, Rows, Section};
use crate::group::{Compared, Pair};
use crate::limits;
use crate::plot::{self, Ink};
use crate::text::{points, shorten, whole_points};
use swm_core::Result;
use swm_core::results::{Paired, Verdict};

/// Draws differences of success rates with their confidence intervals, one row for each pair that `shows` accepts. Pairs
/// beyond [`limits::CHART_ROWS`] are left out. `None` without pairs.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(families: &[Compared<'_, '_>], shows: impl Fn(&Pair<'_, '_>) -> bool) -> Result<Option<String>> {
    let mut left = limits::CHART_ROWS;
    let sections = families.iter().map(|compared| {
        let rows: Vec<Row> = compared.pairs.iter().filter(|pair| shows(pair)).take(left).map(row).collect();
        left -= rows.len();
        Section { heading: compared.family.name.clone(), rows, floor: None }
    });
    let sections: Vec<Section> = sections.filter(|section| !section.rows.is_empty()).collect();
    let title = "difference of success rates, percentage points";
    draw(sections, title, "Differences on the same starts", [300.0, 226.0])
}

/// Draws sections of differences; `None` without rows.
///
/// # Errors
/// When drawing fails.
pub(super) fn draw(sections: Vec<Section>, title: &str, what: &str, room: [f64; 2]) -> Result<Option<String>> {
    if sections.is_empty() {
        return Ok(None);
    }
    let ends = || sections.iter().flat_map(|section| &section.rows).flat_map(|row| row.marks).flatten();
    let Some(axis) = Axis::of(ends().chain([0.0, 1.0])) else { return Ok(None) };
    let ticks = |tick: &f64| match axis.value(*tick) {
        0.0 => "0".to_owned(),
        value => whole_points(value / 100.0),
    };
    let rows = Rows { axis: axis.with_room(), ticks: &ticks, title, mark: Mark::Dot, zero: true, room, what, sections };
    plot::inline(&rows).map(Some)
}

/// A row with a difference and its verdict.
pub(super) fn difference(name: String, ink: Ink, table: &Paired) -> Row {
    let Paired { low, difference, high, verdict, .. } = table;
    let [least, most] = [*low, *high].map(points);
    Row {
        ink,
        marks: Some([*low, *difference, *high].map(|share| 100.0 * share)),
        filled: matches!(verdict, Verdict::Lower | Verdict::Higher),
        value: format!("{} [{least}, {most}], {verdict}", points(*difference)),
        sentence: format!(
            "{name}: {} percentage points, 95 % confidence interval {least} to {most}, {}",
            points(*difference),
            if *verdict == Verdict::TooFew {
                "too few starts differ to tell them apart".to_owned()
            } else {
                verdict.to_string()
            }
        ),
        name,
    }
}

fn row(pair: &Pair<'_, '_>) -> Row {
    let Pair { a, b, table, .. } = pair;
    difference(format!("{} \u{2212} {}", shorten(&a.label, 22), shorten(&b.label, 22)), a.ink, table)
}
