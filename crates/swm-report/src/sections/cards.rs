//! The cards: the success rate of every learned policy, compared with the random-policy floor.

use crate::group::{Condition, Group, Pair, Row};
use crate::text::{escape, percent};
use std::fmt::Write as _;
use swm_core::results::{Proportion, Verdict};

/// Writes the cards of a group.
pub(super) fn write(html: &mut String, group: &Group<'_>) {
    html.push_str("<div class=\"cards\">\n");
    for condition in &group.conditions {
        let pairs = condition.pairs(group.counting).map_or(vec![], |(_, pairs)| pairs);
        for row in condition.rows.iter().filter(|row| row.class.starts_with('c')) {
            card(html, condition, &pairs, row);
        }
    }
    html.push_str("</div>\n");
}

/// Writes the card of one policy under one condition: its success rate, compared with the random-policy floor by a
/// paired test on the same starts, or else by the confidence intervals.
fn card(html: &mut String, condition: &Condition<'_>, pairs: &[Pair<'_, '_>], row: &Row<'_>) {
    let p = row.run.success;
    let verdict = match floor_and_verdict(condition, pairs, row) {
        None => ("unknown", "the random-policy floor was not measured".to_owned()),
        Some((floor, _)) if p.n == 0 || floor.n == 0 => ("unknown", "no counted episodes".to_owned()),
        Some((floor, verdict)) => {
            let (class, words) = match verdict {
                Verdict::Higher => ("above", "above"),
                Verdict::Lower => ("below", "below"),
                Verdict::NotToldApart => ("within", "not told apart from"),
                Verdict::TooFew => ("within", "too few starts differ to tell it from"),
            };
            (class, format!("{words} the random-policy floor of {}", percent(floor.rate)))
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

/// The success rate of the floor, and the verdict on a run against it: that of a pair on the same starts, or else of the
/// intervals of both rates. `None` without a floor.
fn floor_and_verdict(
    condition: &Condition<'_>,
    pairs: &[Pair<'_, '_>],
    row: &Row<'_>,
) -> Option<(Proportion, Verdict)> {
    let nearest = condition.floor_of(row)?;
    let is = |one: &Row<'_>, other: &Row<'_>| std::ptr::eq(one.run, other.run);
    for floor in [nearest, condition.floor()?] {
        for Pair { a, b, table } in pairs {
            if is(a, row) && is(b, floor) {
                return Some((floor.run.success, table.verdict));
            }
            if is(b, row) && is(a, floor) {
                return Some((floor.run.success, table.verdict.reversed()));
            }
        }
    }
    let (own, floor) = (row.run.success, nearest.run.success);
    let verdict = match (own.low > floor.high, own.high < floor.low) {
        (true, _) => Verdict::Higher,
        (_, true) => Verdict::Lower,
        _ => Verdict::NotToldApart,
    };
    Some((floor, verdict))
}
