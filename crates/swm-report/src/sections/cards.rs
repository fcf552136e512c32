//! The cards: the success rate of every learned policy, compared with the random-policy floor.

use super::verdict::against;
use crate::group::{Compared, Condition, Group, Row};
use crate::limits;
use crate::plot::Ink;
use crate::text::{escape, percent, shorten};
use std::fmt::Write as _;
use swm_core::results::Verdict;

/// Writes the cards of a group, up to [`limits::CARDS`].
pub(super) fn write(html: &mut String, group: &Group<'_>, compared: &[Compared<'_, '_>]) {
    let rows = group.conditions.iter().flat_map(|condition| condition.rows.iter().map(move |row| (condition, row)));
    let learned: Vec<_> = rows.filter(|(_, row)| matches!(row.ink, Ink::Policy(_))).collect();
    if learned.is_empty() {
        return;
    }
    html.push_str("<div class=\"cards\">\n");
    for (condition, row) in learned.iter().take(limits::CARDS) {
        card(html, condition, Compared::of(compared, condition), row);
    }
    html.push_str("</div>\n");
    if learned.len() > limits::CARDS {
        let more = learned.len() - limits::CARDS;
        let _ = writeln!(html, "<p class=\"note\">{more} more are in the chart and the table below.</p>");
    }
}

/// Writes the card of one policy under one condition: its success rate, compared with the random-policy floor by a
/// paired test on the same starts, or else by the confidence intervals.
fn card(html: &mut String, condition: &Condition<'_>, compared: Option<&Compared<'_, '_>>, row: &Row<'_>) {
    let p = row.run.success;
    let verdict = match condition.against_floor(compared, row) {
        None => ("unknown", "the random-policy floor was not measured".to_owned()),
        Some((floor, _)) if p.n == 0 || floor.n == 0 => ("unknown", "no counted episodes".to_owned()),
        Some((floor, verdict)) => {
            let class = match verdict {
                Verdict::Higher => "above",
                Verdict::Lower => "below",
                Verdict::NotToldApart | Verdict::TooFew => "within",
            };
            (class, format!("{} {}", against(verdict), percent(floor.rate)))
        }
    };
    let interval = match p.n {
        0 => String::new(),
        _ => format!("95 % confidence interval {} to {}", percent(p.low), percent(p.high)),
    };
    let _ = write!(
        html,
        "<div class=\"card\">\n<p class=\"what\"><span class=\"swatch {}\"></span>{} · {}</p>\n\
         <p class=\"big\">{}</p>\n<p class=\"range\">{}</p>\n<p class=\"verdict {}\">{}</p>\n</div>\n",
        row.ink.class(),
        escape(&shorten(&row.label, limits::TEXT_CHARS)),
        escape(&shorten(condition.name, limits::TEXT_CHARS)),
        if p.n == 0 { "–".to_owned() } else { percent(p.rate) },
        interval,
        verdict.0,
        verdict.1
    );
}
