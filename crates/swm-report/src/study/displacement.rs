//! The table of prediction errors for near and for far goals.

use super::table::NONE;
use crate::limits;
use crate::text::{escape, number, shorten};
use std::fmt::Write as _;
use swm_core::results::{ByDisplacement, Discrimination, StudyResults};

/// Writes the table; nothing if no cell has displacements.
pub(super) fn write(html: &mut String, results: &StudyResults) {
    let rows = || results.rows.iter().flat_map(|row| row.by_displacement.iter().map(move |group| (row, group)));
    let count = rows().count();
    if count == 0 {
        return;
    }
    html.push_str(
        "<section>\n<h2>Near and far goals</h2>\n<p class=\"note\">The AUCs of the table above, split by displacement: the \
         distance from the start to its goal, in the environment's unit. The groups of a row have about equally many starts; \
         every interval is a 95 % interval of its own.</p>\n<div class=\"wide stack study\">\n<table>\n<thead>\n<tr>\
         <th scope=\"col\">Starts</th><th scope=\"col\">Condition</th><th scope=\"col\">Policy</th>\
         <th scope=\"col\" class=\"n\">Displacement</th><th scope=\"col\" class=\"n\">Solved, failed</th>\
         <th scope=\"col\" class=\"n\">AUC</th><th scope=\"col\">The error</th>\
         <th scope=\"col\" class=\"n\">AUC, played</th></tr>\n</thead>\n<tbody>\n",
    );
    let shown = |name: &str| escape(&shorten(name, limits::STUDY_NAME_CHARS));
    let none = || NONE.to_owned();
    let area = |found: Discrimination| format!("<b>{:.3}</b> [{:.2}, {:.2}]", found.auc, found.low, found.high);
    for (row, group) in rows().take(limits::PUBLISHED) {
        let ByDisplacement { from, to, solved, failed, recorded, played } = group;
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{}</th><td data-label=\"Condition\">{}</td><td data-label=\"Policy\">{}</td>\
             <td class=\"n\" data-label=\"Displacement\">{} to {}</td>\
             <td class=\"n\" data-label=\"Solved, failed\">{solved}, {failed}</td>\
             <td class=\"n\" data-label=\"AUC\">{}</td><td data-label=\"The error\">{}</td>\
             <td class=\"n\" data-label=\"AUC, played\">{}</td></tr>",
            shown(&row.starts),
            shown(&row.condition),
            shown(&row.policy),
            number(*from),
            number(*to),
            recorded.map_or_else(none, area),
            recorded.map_or_else(none, |found| found.verdict.to_string()),
            played.map_or_else(none, area),
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if count > limits::PUBLISHED {
        let more = count - limits::PUBLISHED;
        let _ = writeln!(html, "<p class=\"note\">{more} more rows are in <code>table.csv</code>.</p>");
    }
    html.push_str("</section>\n");
}
