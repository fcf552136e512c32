//! The table of prediction errors: whether they predict success.

use super::table::NONE;
use crate::limits;
use crate::text::{escape, number, shorten};
use std::fmt::Write as _;
use swm_core::results::{Discrimination, ErrorAndSuccess, StudyResults, StudyRow, Summary};

/// Writes the table; nothing if no cell has prediction errors.
pub(super) fn write(html: &mut String, results: &StudyResults) {
    let rows = || results.rows.iter().filter_map(|row| Some((row, row.prediction.as_ref()?)));
    let count = rows().count();
    if count == 0 {
        return;
    }
    html.push_str(
        "<section>\n<h2>Does the prediction error predict success?</h2>\n<p class=\"note\">The model predicts latents along \
         the recorded trajectory from which a start comes, with its recorded actions. The AUC is the probability that a failed \
         trajectory has a larger error than a solved one, with its 95 % interval, for which trajectories of one recorded \
         episode form a cluster. The error “predicts” success where the interval excludes 0.5, and “does not predict” it only \
         where the interval lies inside [0.45, 0.55]. Played: the same along the trajectory that the policy played, with the \
         actions that it chose, over the model steps that all trajectories have. Optimism is the squared distance from the goal's latent that these actions reached, minus the distance that \
         the model predicted for them, in the unit of errors.</p>\n<div class=\"wide stack study\">\n<table>\n<thead>\n<tr><th scope=\"col\">Starts</th>\
         <th scope=\"col\">Condition</th><th scope=\"col\">Policy</th><th scope=\"col\">Counting</th>\
         <th scope=\"col\" class=\"n\">Solved, failed</th><th scope=\"col\" class=\"n\">Median error: solved</th>\
         <th scope=\"col\" class=\"n\">failed</th><th scope=\"col\" class=\"n\">AUC</th>\
         <th scope=\"col\" class=\"n\">Overlap</th><th scope=\"col\">The error</th><th scope=\"col\" class=\"n\">AUC, played</th>\
         <th scope=\"col\" class=\"n\">Optimism</th></tr>\n</thead>\n<tbody>\n",
    );
    for (row, errors) in rows().take(limits::PUBLISHED) {
        write_row(html, row, errors);
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
    if count > limits::PUBLISHED {
        let _ = writeln!(
            html,
            "<p class=\"note\">{} more rows are in <code>table.csv</code>.</p>",
            count - limits::PUBLISHED
        );
    }
    html.push_str("</section>\n");
}

fn write_row(html: &mut String, row: &StudyRow, errors: &ErrorAndSuccess) {
    let shown = |name: &str| escape(&shorten(name, limits::STUDY_NAME_CHARS));
    let median = |errors: &[f64]| Summary::of(errors).map_or(NONE.to_owned(), |found| number(found.median));
    let none = || NONE.to_owned();
    let area = |found: &Discrimination| format!("<b>{:.3}</b> [{:.2}, {:.2}]", found.auc, found.low, found.high);
    let [auc, overlap, verdict] = match errors.discrimination {
        None => [none(), none(), none()],
        Some(found) => {
            let overlap = found.overlap.map_or_else(none, |overlap| format!("{overlap:.2}"));
            [area(&found), overlap, found.verdict.to_string()]
        }
    };
    let played = row.played.as_ref();
    let of_played = played.and_then(|played| played.errors.discrimination.as_ref()).map_or_else(none, area);
    let optimism = played
        .and_then(|played| played.optimism)
        .map_or_else(none, |found| format!("{} [{}, {}]", number(found.mean), number(found.low), number(found.high)));
    let _ = writeln!(
        html,
        "<tr><th scope=\"row\">{}</th><td data-label=\"Condition\">{}</td><td data-label=\"Policy\">{}</td>\
         <td data-label=\"Counting\">{}</td><td class=\"n\" data-label=\"Solved, failed\">{}, {}</td>\
         <td class=\"n\" data-label=\"Median error, solved\">{}</td><td class=\"n\" data-label=\"Median error, failed\">{}</td>\
         <td class=\"n\" data-label=\"AUC\">{auc}</td><td class=\"n\" data-label=\"Overlap\">{overlap}</td>\
         <td data-label=\"The error\">{verdict}</td><td class=\"n\" data-label=\"AUC, played\">{of_played}</td>\
         <td class=\"n\" data-label=\"Optimism\">{optimism}</td></tr>",
        shown(&row.starts),
        shown(&row.condition),
        shown(&row.policy),
        row.counting.name(),
        errors.solved.len(),
        errors.failed.len(),
        median(&errors.solved),
        median(&errors.failed),
    );
}
