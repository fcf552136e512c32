//! Where success breaks along a ray: what the levels show, and every level.

use super::table::{NONE, share};
use crate::limits;
use crate::text::{escape, shorten};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use swm_core::results::{BreakingPoint, Level, Ray, Side, StudyResults};

/// The largest number of policies.
const POLICIES: usize = 40;

/// Writes the section; nothing if the study changes no factor along a ray.
pub(super) fn write(html: &mut String, results: &StudyResults) {
    let points = &results.breaking;
    if points.is_empty() {
        return;
    }
    let distances: BTreeMap<&str, f64> =
        results.by_image_distance().into_iter().map(|rank| (rank.condition, rank.distance)).collect();
    html.push_str("<section>\n<h2>Breaking point</h2>\n");
    for point in points.iter().take(POLICIES) {
        for sentence in point.sentences().iter().take(POLICIES) {
            let _ = writeln!(html, "<p>{}</p>", escape(&shorten(sentence, limits::STUDY_TEXT_CHARS)));
        }
        levels(html, point, &distances);
    }
    let _ = writeln!(
        html,
        "<p class=\"note\">Levels are compared on the same starts, by confidence sequences corrected for the {} levels that \
         could have been evaluated. Rises are tested with the paired test for all 36 pairs of the first grid and the unshifted \
         condition. The image distance is the mean absolute difference between the values of the first frames, from 0 to \
         255.</p>\n</section>",
        Ray::LEVELS
    );
}

fn levels(html: &mut String, point: &BreakingPoint, distances: &BTreeMap<&str, f64>) {
    let below = share(point.ray.below);
    let name = escape(&shorten(&point.policy, limits::STUDY_NAME_CHARS));
    let _ = write!(
        html,
        "<div class=\"wide stack study\">\n<table>\n<thead>\n<tr>\
         <th scope=\"col\">{name}</th><th scope=\"col\" class=\"n\">Success, %</th>\
         <th scope=\"col\" class=\"n\">Image distance</th>\
         <th scope=\"col\">Half of unshifted</th><th scope=\"col\">{below} %</th></tr>\n</thead>\n<tbody>\n"
    );
    for Level { condition, rate, half, bound, .. } in point.levels.iter().take(Ray::LEVELS) {
        let distance = distances.get(condition.as_str()).map_or(NONE.to_owned(), |distance| format!("{distance:.2}"));
        let condition = escape(&shorten(condition, limits::STUDY_NAME_CHARS));
        let _ = writeln!(
            html,
            "<tr><th scope=\"row\">{condition}</th><td class=\"n\" data-label=\"Success, %\"><b>{}</b></td>\
             <td class=\"n\" data-label=\"Image distance\">{distance}</td>\
             <td data-label=\"Half of unshifted\">{}</td><td data-label=\"{below} %\">{}</td></tr>",
            share(*rate),
            word(*half),
            word(*bound)
        );
    }
    html.push_str("</tbody>\n</table>\n</div>\n");
}

fn word(side: Side) -> &'static str {
    match side {
        Side::Above => "above",
        Side::Below => "<b>below</b>",
        Side::Undecided => "<span class=\"quiet\">undecided</span>",
    }
}
