//! The chart of success rates.

use super::axis::Axis;
use super::rows::{Mark, Row, Rows, Section};
use crate::group::{Group, Row as Run};
use crate::limits;
use crate::plot;
use crate::text::percent;
use swm_core::Result;

/// Draws success rates with their 95 % confidence intervals, one row for each run. The interval of the random-policy
/// floor is a band across its condition. Runs beyond [`limits::CHART_ROWS`] are left out.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(group: &Group<'_>) -> Result<String> {
    let mut left = limits::CHART_ROWS;
    let sections = group.conditions.iter().map(|condition| {
        let rows: Vec<Row> = condition.rows.iter().take(left).map(row).collect();
        left -= rows.len();
        let floor = condition.floor().map(|floor| marks(floor));
        Section { heading: condition.name.to_owned(), rows, floor }
    });
    let rows = Rows {
        sections: sections.filter(|section| !section.rows.is_empty()).collect(),
        axis: Axis::percent(),
        ticks: &|tick| format!("{tick:.0}\u{a0}%"),
        title: "",
        mark: Mark::Dot,
        zero: false,
        room: [210.0, 130.0],
        what: "Success rates with 95 % confidence intervals",
    };
    plot::inline(&rows)
}

/// A success rate between the ends of its interval, in percent.
fn marks(run: &Run<'_>) -> [f64; 3] {
    let p = run.run.success;
    [p.low, p.rate, p.high].map(|share| 100.0 * share)
}

fn row(run: &Run<'_>) -> Row {
    let p = run.run.success;
    let counts = format!("{} ({}/{})", percent(p.rate), p.successes, p.n);
    Row {
        name: run.label.clone(),
        ink: run.ink,
        marks: (p.n > 0).then(|| marks(run)),
        filled: !run.is_floor(),
        value: if p.n > 0 { counts.clone() } else { "no episodes".to_owned() },
        sentence: format!(
            "{}: {counts}, 95 % confidence interval {} to {}",
            run.label,
            percent(p.low),
            percent(p.high)
        ),
    }
}
