//! The table of all runs of a group.

use super::Room;
use crate::group::{Group, Row};
use crate::limits;
use crate::text::{duration, escape, number, percent, shorten};
use std::fmt::Write as _;

const NONE: &str = "<span class=\"quiet\">–</span>";

/// Writes the table of a group.
pub(super) fn write(html: &mut String, group: &Group<'_>, room: &mut Room) {
    let any = |of: fn(&Row<'_>) -> bool| group.rows().any(of);
    let columns = Columns {
        solved_at_start: any(|row| row.run.solved_at_start > 0),
        latency: any(|row| row.run.timing.plan_seconds.is_some()),
    };
    let of_latency = if columns.latency { " and planning latency" } else { "" };
    let _ = write!(
        html,
        "<div class=\"wide stack\">\n<table>\n<caption>All runs. Success rates with their 95 % confidence intervals; time to goal \
         (in steps){of_latency}: median (95th percentile).</caption>\n<thead>\n<tr>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy</th><th scope=\"col\" class=\"n\">Success rate</th>\
         <th scope=\"col\" class=\"n\">Episodes</th>{}<th scope=\"col\" class=\"n\">Time to goal</th>{}\
         <th scope=\"col\" class=\"n\">Wall time</th></tr>\n</thead>\n",
        if columns.solved_at_start { "<th scope=\"col\" class=\"n\">Solved at start</th>" } else { "" },
        if columns.latency { "<th scope=\"col\" class=\"n\">Planning latency</th>" } else { "" },
    );
    let mut left_out = 0;
    for condition in &group.conditions {
        let (mut body, mut written) = (String::new(), 0);
        for row in &condition.rows {
            written += usize::from(room.row(&mut body, &format!("<tr>{}</tr>\n", cells(row, columns))));
        }
        left_out += condition.rows.len() - written;
        if written > 0 {
            let name = escape(&shorten(condition.name, limits::TEXT_CHARS));
            let head = format!("<tr><th scope=\"rowgroup\" rowspan=\"{written}\">{name}</th>");
            let _ = write!(html, "<tbody>\n{}</tbody>\n", body.replacen("<tr>", &head, 1));
        }
    }
    html.push_str("</table>\n</div>\n");
    if left_out > 0 {
        let _ = writeln!(html, "<p class=\"note\">{left_out} more runs are in the results files.</p>");
    }
}

/// The columns that only some tables have.
#[derive(Clone, Copy)]
struct Columns {
    solved_at_start: bool,
    latency: bool,
}

/// The cells of a run that follow the cell of the condition.
fn cells(row: &Row<'_>, columns: Columns) -> String {
    let (run, p) = (row.run, row.run.success);
    // The strict success rate of the same episodes, for compat counting.
    let strict = run
        .strict
        .map_or(String::new(), |p| format!("<span class=\"quiet interval\">strict {}</span>", percent(p.rate)));
    let interval = format!("<span class=\"quiet interval\">{:.1} – {}</span>", 100.0 * p.low, percent(p.high));
    let rate = if p.n == 0 { NONE.to_owned() } else { format!("<b>{}</b>{interval}{strict}", percent(p.rate)) };
    let steps = run.time_to_goal.map(|s| format!("{} ({})", number(s.median), number(s.p95)));
    let latency = run.timing.plan_seconds.map(|s| format!("{} ({})", duration(s.median), duration(s.p95)));
    // A wall time of 0 means that the run was not timed.
    let wall = (run.timing.wall_seconds > 0.0).then(|| duration(run.timing.wall_seconds));
    let mut cells = format!(
        "<th scope=\"row\"><span class=\"swatch {}\"></span>{}</th>",
        row.ink.class(),
        escape(&shorten(&row.label, limits::TEXT_CHARS))
    );
    let mut cell = |label: &str, words: &str| {
        let _ = write!(cells, "<td class=\"n\" data-label=\"{label}\">{words}</td>");
    };
    cell("Success rate", &rate);
    cell("Episodes", &p.n.to_string());
    if columns.solved_at_start {
        cell("Solved at start", &run.solved_at_start.to_string());
    }
    cell("Time to goal", steps.as_deref().unwrap_or(NONE));
    if columns.latency {
        cell("Planning latency", latency.as_deref().unwrap_or(NONE));
    }
    cell("Wall time", wall.as_deref().unwrap_or(NONE));
    cells
}
