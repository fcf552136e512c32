//! The table of all runs of a group.

use crate::group::{Group, Row};
use crate::text::{duration, escape, number, percent};
use std::fmt::Write as _;

/// Writes the table of a group.
pub(super) fn write(html: &mut String, group: &Group<'_>) {
    html.push_str(
        "<div class=\"wide\" role=\"region\" aria-label=\"All runs\" tabindex=\"0\">\n<table>\n\
         <caption>All runs. Time to goal (in steps) and planning latency: median (95th percentile).</caption>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy</th><th scope=\"col\" class=\"n\">Success rate</th>\
         <th scope=\"col\" class=\"n\">95 % confidence interval</th><th scope=\"col\" class=\"n\">Episodes</th>\
         <th scope=\"col\" class=\"n\">Solved at start</th><th scope=\"col\" class=\"n\">Time to goal</th>\
         <th scope=\"col\" class=\"n\">Planning latency</th><th scope=\"col\" class=\"n\">Wall time</th></tr>\n</thead>\n",
    );
    for condition in &group.conditions {
        html.push_str("<tbody>\n");
        for (i, row) in condition.rows.iter().enumerate() {
            html.push_str("<tr>");
            if i == 0 {
                let (rows, name) = (condition.rows.len(), escape(condition.name));
                let _ = write!(html, "<th scope=\"rowgroup\" rowspan=\"{rows}\">{name}</th>");
            }
            cells(html, row);
            html.push_str("</tr>\n");
        }
        html.push_str("</tbody>\n");
    }
    html.push_str("</table>\n</div>\n");
}

/// Writes the cells of a run that follow the cell of the condition.
fn cells(html: &mut String, row: &Row<'_>) {
    let (run, p) = (row.run, row.run.success);
    const NONE: &str = "<span class=\"quiet\">–</span>";
    // The strict success rate of the same episodes, for compat counting.
    let strict =
        run.strict.map_or(String::new(), |p| format!("<br/><span class=\"quiet\">strict {}</span>", percent(p.rate)));
    let rate = if p.n == 0 { NONE.to_owned() } else { format!("<b>{}</b>{strict}", percent(p.rate)) };
    let steps = run.time_to_goal.map(|s| format!("{} ({})", number(s.median), number(s.p95)));
    let latency = run.timing.plan_seconds.map(|s| format!("{} ({})", duration(s.median), duration(s.p95)));
    let _ = write!(
        html,
        "<th scope=\"row\"><span class=\"swatch {}\"></span>{}</th><td class=\"n\">{rate}</td>\
         <td class=\"n\">{:.1} – {}</td><td class=\"n\">{}</td><td class=\"n\">{}</td><td class=\"n\">{}</td>\
         <td class=\"n\">{}</td><td class=\"n\">{}</td>",
        row.class,
        escape(&row.label),
        p.low * 100.0,
        percent(p.high),
        p.n,
        run.solved_at_start,
        steps.as_deref().unwrap_or(NONE),
        latency.as_deref().unwrap_or(NONE),
        // A wall time of 0 means that the run was not timed.
        if run.timing.wall_seconds > 0.0 { duration(run.timing.wall_seconds) } else { NONE.to_owned() }
    );
}
