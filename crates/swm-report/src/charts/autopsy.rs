//! The charts of an autopsy: what ingredients contribute, and the success of every arm.

use super::axis::Axis;
use super::paired::draw;
use super::rows::{Mark, Row, Rows, Section};
use crate::limits;
use crate::plot::{self, Ink};
use crate::text::{percent, points};
use swm_core::Result;
use swm_core::results::{Arm, Autopsy, Contribution, Estimate, letters};

/// Draws the share of the failures that each ingredient recovers. `None` without ingredients.
///
/// # Errors
/// When drawing fails.
pub(crate) fn contributions(found: &Autopsy) -> Result<Option<String>> {
    let row = |contribution: &Contribution| {
        let Contribution { ingredient, recovered: Estimate { value, low, high }, first, .. } = contribution;
        let name = format!("{} {}", ingredient.letter(), ingredient.summary());
        let value_words = format!("{} [{}, {}]", points(*value), points(*low), points(*high));
        Row {
            sentence: format!(
                "{name}: recovers {value_words} percentage points of the failures, ranks first in {}",
                percent(*first)
            ),
            name,
            ink: Ink::Policy(0),
            marks: Some([*low, *value, *high].map(|share| 100.0 * share)),
            filled: *low > 0.0 || *high < 0.0,
            value: value_words,
        }
    };
    let rows = found.contributions.iter().map(row).collect();
    let sections = vec![Section { heading: String::new(), rows, floor: None }];
    draw(sections, "share of the failures, percentage points", "What each ingredient recovers", [190.0, 150.0])
}

/// Draws the success rate of every arm.
///
/// # Errors
/// When drawing fails.
pub(crate) fn arms(found: &Autopsy) -> Result<String> {
    let row = |arm: &Arm| {
        let Estimate { value, low, high } = arm.success;
        let name = if arm.ingredients.is_empty() { "unchanged".to_owned() } else { letters(&arm.ingredients) };
        let value_words = format!("{} [{:.0}, {:.0}]", percent(value), 100.0 * low, 100.0 * high);
        Row {
            sentence: format!("{name}: {value_words}"),
            name,
            ink: if arm.ingredients.is_empty() { Ink::Floor } else { Ink::Policy(0) },
            marks: Some([low, value, high].map(|share| 100.0 * share)),
            filled: !arm.ingredients.is_empty(),
            value: value_words,
        }
    };
    let rows: Vec<Row> = found.arms.iter().take(limits::CHART_ROWS).map(row).collect();
    let rows = Rows {
        sections: vec![Section { heading: String::new(), rows, floor: None }],
        axis: Axis::percent(),
        ticks: &|tick| format!("{tick:.0}\u{a0}%"),
        title: "",
        mark: Mark::Dot,
        zero: false,
        room: [120.0, 150.0],
        what: "Success rates of the arms with 95 % bootstrap intervals",
    };
    plot::inline(&rows)
}
