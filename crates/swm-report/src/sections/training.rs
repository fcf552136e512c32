//! The section of training metrics.

use super::figure;
use crate::charts;
use crate::training_log::Metrics;

/// The largest number of metrics that are shown; losses come first.
const CURVES: usize = 8;

/// Metrics of speed, which are not shown.
const TIMES: [&str; 3] = ["seconds", "clips_per_second", "data_wait"];

/// Writes the section.
pub(crate) fn write(html: &mut String, metrics: &Metrics) {
    let mut series: Vec<_> = metrics.series.iter().filter(|series| !TIMES.contains(&series.name.as_str())).collect();
    series.sort_by_key(|series| (!series.name.contains("loss"), series.name.clone()));
    let curves: Vec<String> =
        series.into_iter().filter_map(|series| charts::training::chart(metrics, series)).take(CURVES).collect();
    html.push_str("<section>\n<h2>Training</h2>\n");
    if curves.is_empty() {
        html.push_str("<p class=\"note\">The training log contains no metric with at least two points.</p>\n");
    } else {
        let caption = "Long logs are shown as means over neighbouring points; the last value is above its curve.";
        figure(html, "Metrics", caption, &format!("<div class=\"pair\">\n{}</div>\n", curves.concat()));
    }
    html.push_str("</section>\n");
}
