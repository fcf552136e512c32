//! The cards: the success rate of every learned policy, compared with the random-policy floor.

use crate::group::{Condition, Group, Row};
use crate::text::{escape, p_value, percent};
use std::fmt::Write as _;
use swm_core::results::Comparison;

/// Writes the cards of a group.
pub(super) fn write(html: &mut String, group: &Group<'_>) {
    html.push_str("<div class=\"cards\">\n");
    for condition in &group.conditions {
        for row in condition.rows.iter().filter(|row| row.class.starts_with('c')) {
            card(html, group, condition, row);
        }
    }
    html.push_str("</div>\n");
}

/// Writes the card of one policy under one condition: its success rate, compared with the random-policy floor by a
/// paired test on the same starts, or else by the confidence intervals.
fn card(html: &mut String, group: &Group<'_>, condition: &Condition<'_>, row: &Row<'_>) {
    let p = row.run.success;
    let floor = condition.floor_of(row);
    let paired = floor.and_then(|floor| Comparison::of(row.run, floor.run, group.counting)).map(|found| found.table);
    let verdict = match (floor.map(|floor| floor.run.success), paired) {
        (None, _) => ("unknown", "the random-policy floor was not measured".to_owned()),
        (Some(floor), _) if p.n == 0 || floor.n == 0 => ("unknown", "no counted episodes".to_owned()),
        (Some(floor), paired) => {
            let (above, below) = match paired {
                Some(table) => (table.p < 0.05 && table.difference > 0.0, table.p < 0.05 && table.difference < 0.0),
                None => (p.low > floor.high, p.high < floor.low),
            };
            let (class, words) = match (above, below) {
                (true, _) => ("above", "above"),
                (_, true) => ("below", "below"),
                _ => ("within", "not significantly different from"),
            };
            let test = paired.map_or(String::new(), |table| format!(" ({})", p_value(table.p)));
            (class, format!("{words} the random-policy floor of {}{}", percent(floor.rate), escape(&test)))
        }
    };
    let _ = write!(
        html,
        "<div class=\"card\">\n<p class=\"what\"><span class=\"swatch {}\"></span>{} · {}</p>\n\
         <p class=\"big\">{}</p>\n<p class=\"range\">95 % confidence interval {} to {}</p>\n<p class=\"verdict {}\">{}</p>\n</div>\n",
        row.class,
        escape(&row.label),
        escape(condition.name),
        if p.n == 0 { "–".to_owned() } else { percent(p.rate) },
        percent(p.low),
        percent(p.high),
        verdict.0,
        verdict.1
    );
}
