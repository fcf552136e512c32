//! The shifted conditions, ranked by how much they change the first frame.

use super::table::NONE;
use crate::limits;
use crate::text::{escape, shorten};
use std::fmt::Write as _;
use swm_core::results::StudyResults;

/// The largest number of policies with a column.
const POLICIES: usize = 6;

/// Writes the table; nothing if no condition has an image distance.
pub(super) fn write(html: &mut String, results: &StudyResults) {
    let ranks = results.by_image_distance();
    if ranks.is_empty() {
        return;
    }
    let mut policies: Vec<&str> = vec![];
    for policy in ranks.iter().flat_map(|rank| rank.gaps.keys()) {
        if policies.len() < POLICIES && !policies.contains(policy) {
            policies.push(policy);
        }
    }
    let shown = |name: &str| escape(&shorten(name, limits::STUDY_NAME_CHARS));
    let columns: String =
        policies.iter().map(|policy| format!("<th scope=\"col\" class=\"n\">{}</th>", shown(policy))).collect();
    let _ = write!(
        html,
        "<section>\n<h2>Image distance</h2>\n<p class=\"note\">How much each condition changes what a model sees: the mean \
         absolute difference between the values of the first frames under it and under the first condition, from the same \
         starts, from 0 to 255. Beside it, the gap of each policy in percentage points.</p>\n\
         <div class=\"wide stack study\">\n<table>\n<thead>\n<tr><th scope=\"col\">Condition</th>\
         <th scope=\"col\" class=\"n\">Image distance</th>{columns}</tr>\n</thead>\n<tbody>\n"
    );
    for rank in ranks.iter().take(limits::PUBLISHED) {
        let gap = |policy: &&str| {
            let gap = rank.gaps.get(policy).map_or(NONE.to_owned(), |gap| format!("{:+.0}", 100.0 * gap));
            format!("<td class=\"n\" data-label=\"{}\">{}</td>", shown(policy), gap.replace('-', "−"))
        };
        let gaps: String = policies.iter().map(gap).collect();
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{}</th><td class=\"n\" data-label=\"Image distance\"><b>{:.2}</b></td>{gaps}</tr>",
            shown(rank.condition),
            rank.distance
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if ranks.len() > limits::PUBLISHED {
        let more = ranks.len() - limits::PUBLISHED;
        let _ = writeln!(html, "<p class=\"note\">{more} more conditions are in <code>table.csv</code>.</p>");
    }
    html.push_str("</section>\n");
}
