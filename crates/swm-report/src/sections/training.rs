//! The section of training metrics.

use super::Room;
use crate::charts;
use crate::limits;
use crate::plot::Ink;
use crate::text::{escape, shorten};
use crate::training_log::{Metrics, Training};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use swm_core::Result;

/// The largest number of metrics that are shown; losses come first.
const CURVES: usize = 8;

/// Metrics of speed, which are not shown.
const TIMES: [&str; 3] = ["seconds", "clips_per_second", "data_wait"];

/// Writes the section; `inks` are the colours of the policies. Nothing without training logs.
///
/// # Errors
/// When drawing fails.
pub(crate) fn write(
    html: &mut String,
    trainings: &[Training],
    inks: &BTreeMap<&str, Ink>,
    room: &mut Room,
) -> Result<()> {
    if trainings.is_empty() {
        return Ok(());
    }
    html.push_str("<section>\n<h2>Training</h2>\n");
    for training in trainings.iter().take(limits::SENTENCES) {
        let ink = inks.get(training.policy.as_str()).copied().unwrap_or(Ink::Policy(0));
        let name = escape(&shorten(&training.policy, limits::TEXT_CHARS));
        let heading = match name.as_str() {
            "" => "Metrics".to_owned(),
            name => format!("<span class=\"swatch {}\"></span>{name}", ink.class()),
        };
        match &training.metrics {
            Err(problem) => {
                let problem = escape(&shorten(problem, limits::TEXT_CHARS));
                let _ = writeln!(html, "<h3>{heading}</h3>\n<p class=\"note\">No training curves: {problem}.</p>");
            }
            Ok(metrics) => curves(html, metrics, (&heading, ink), room)?,
        }
    }
    html.push_str("</section>\n");
    Ok(())
}

/// Writes the figure of one training.
fn curves(html: &mut String, metrics: &Metrics, (heading, ink): (&str, Ink), room: &mut Room) -> Result<()> {
    let mut series: Vec<_> = metrics.series.iter().filter(|series| !TIMES.contains(&series.name.as_str())).collect();
    series.sort_by_key(|series| (!series.name.contains("loss"), series.name.clone()));
    let charts = series.into_iter().map(|series| charts::training::chart(metrics, series, ink).transpose());
    let charts: Vec<String> = charts.flatten().take(CURVES).collect::<Result<_>>()?;
    if charts.is_empty() {
        let none = "The training log contains no metric with at least two points.";
        let _ = writeln!(html, "<h3>{heading}</h3>\n<p class=\"note\">{none}</p>");
        return Ok(());
    }
    let caption = "Long logs are shown as means over neighbouring points; the last value is above its curve.";
    room.panels(html, [heading, caption], charts.into_iter().map(|chart| Ok(vec![chart])))
}
