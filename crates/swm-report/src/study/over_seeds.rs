//! Success over training seeds: each seed, and what they have in common.

use super::table::share;
use crate::limits;
use crate::text::{escape, shorten};
use std::fmt::Write as _;
use swm_core::results::OverSeeds;

/// The largest number of training seeds in a row.
const SEEDS: usize = 20;

/// Writes the table; nothing if the study has no training seeds.
pub(super) fn write(html: &mut String, rows: &[OverSeeds]) {
    if rows.is_empty() {
        return;
    }
    html.push_str(
        "<section>\n<h2>Over training seeds</h2>\n<p class=\"note\">The success rate of each training seed, in percent; their \
         mean; the interval that holds the rate of one further seed with 95 %; and the interquartile mean (IQM) of at least \
         eight rates with its 95 % interval.</p>\n<div class=\"wide stack study\">\n<table>\n<thead>\n<tr><th scope=\"col\">Condition</th><th scope=\"col\">Policy</th>\
         <th scope=\"col\">Counting</th><th scope=\"col\">Seeds</th><th scope=\"col\" class=\"n\">Mean</th>\
         <th scope=\"col\" class=\"n\">New seed</th><th scope=\"col\" class=\"n\">IQM</th></tr>\n</thead>\n<tbody>\n",
    );
    let shown = |name: &str| escape(&shorten(name, limits::STUDY_NAME_CHARS));
    for row in rows.iter().take(limits::FAMILIES) {
        let score = |(seed, score): &(String, f64)| format!("{}: {}", shown(&shorten(seed, 12)), share(*score));
        let scores: Vec<String> = row.scores.iter().take(SEEDS).map(score).collect();
        let more = if row.scores.len() > SEEDS { ", …" } else { "" };
        let [low, high] = row.new_seed.map(share);
        let iqm = row
            .interquartile
            .map_or("–".to_owned(), |iqm| format!("{} [{}, {}]", share(iqm.mean), share(iqm.low), share(iqm.high)));
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{}</th><td data-label=\"Policy\">{}</td><td data-label=\"Counting\">{}</td>\
             <td class=\"seeds\" data-label=\"Seeds\">{}{more}</td><td class=\"n\" data-label=\"Mean\"><b>{}</b></td>\
             <td class=\"n\" data-label=\"New seed\">[{low}, {high}]</td>\
             <td class=\"n\" data-label=\"IQM\">{iqm}</td></tr>",
            shown(row.condition.as_deref().unwrap_or("all shifted conditions")),
            shown(&row.policy),
            row.counting.name(),
            scores.join(", "),
            share(row.mean)
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if rows.len() > limits::FAMILIES {
        let _ = writeln!(html, "<p class=\"note\">{} more rows are left out.</p>", rows.len() - limits::FAMILIES);
    }
    html.push_str("</section>\n");
}
