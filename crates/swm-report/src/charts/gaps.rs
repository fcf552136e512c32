//! The chart of generalisation gaps.

use super::paired::{difference, draw};
use super::rows::{Row, Section};
use crate::gap::Gaps;
use crate::limits;
use swm_core::Result;

/// Draws the gaps of every policy, one row for each shifted condition. Gaps beyond [`limits::CHART_ROWS`] are left out.
/// `None` without gaps.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(policies: &[Gaps<'_, '_>]) -> Result<Option<String>> {
    let mut left = limits::CHART_ROWS;
    let sections = policies.iter().map(|Gaps { reference, gaps, .. }| {
        let row = |gap: &crate::gap::Gap<'_>| difference(gap.condition.to_owned(), reference.ink, &gap.table);
        let rows: Vec<Row> = gaps.iter().take(left).map(row).collect();
        left -= rows.len();
        Section { heading: reference.label.clone(), rows, floor: None }
    });
    let sections: Vec<Section> = sections.filter(|section| !section.rows.is_empty()).collect();
    let title = "success rate minus that in distribution, percentage points";
    draw(sections, title, "Generalisation gaps", [300.0, 226.0])
}
