//! The charts of prediction errors, grouped by success.

use super::axis::Axis;
use super::curves::{Curve, Curves, PANEL, POINTS, Stroke};
use crate::group::Row;
use crate::limits;
use crate::plot::{self, Anchor, Canvas, Drawn as Painted, Figure, HEADING, Ink, Layout, SMALL, Surface, TEXT, stroke};
use crate::text::number;
use plotters::style::Color as _;
use swm_core::Result;
use swm_core::results::{Group, Prediction, Trajectory};

/// The charts of a run; none without prediction errors.
///
/// # Errors
/// When drawing fails.
pub(crate) fn charts(row: &Row<'_>, condition: &str) -> Result<Vec<String>> {
    let Some(prediction) = row.run.prediction.as_ref().filter(|prediction| !prediction.groups.is_empty()) else {
        return Ok(vec![]);
    };
    let title = format!("{}, {condition}", row.label);
    let charts = [steps(row, prediction, &title)?, trajectories(row, prediction, &title)?];
    Ok(charts.into_iter().flatten().collect())
}

/// The name of a group, its colour and how its curve is drawn.
fn look(group: &Group, row: &Row<'_>) -> (&'static str, Ink, Stroke) {
    match group.success {
        None => ("all", row.ink, Stroke::Dashed),
        Some(true) => ("solved", Ink::Good, Stroke::Solid),
        Some(false) => ("not solved", Ink::Bad, Stroke::Solid),
    }
}

/// The mean error of each model step, one curve for each group; `None` for values that cannot be drawn.
fn steps(row: &Row<'_>, prediction: &Prediction, title: &str) -> Result<Option<String>> {
    let horizon = prediction.groups.iter().map(|group| group.steps.len()).max().unwrap_or(0);
    let means = prediction.groups.iter().flat_map(|group| &group.steps).map(|step| step.mean);
    let axes = Axis::of([0.0, horizon as f64].into_iter()).zip(Axis::of(means.chain([0.0])));
    let Some((x, y)) = axes.filter(|_| horizon > 0) else { return Ok(None) };
    let curve = |group: &Group| {
        let (name, ink, stroke) = look(group, row);
        let every = group.steps.len().div_ceil(POINTS).max(1);
        let means = group.steps.iter().enumerate().step_by(every).map(|(i, step)| [(i + 1) as f64, step.mean]);
        // The error at step 0, before any prediction, is 0.
        let points = std::iter::once([0.0, 0.0]).chain(means).collect();
        Curve { name: format!("{name} ({})", group.trajectory.n), ink, stroke, points, band: vec![] }
    };
    let panel = Curves {
        heading: format!("{title}: error by step"),
        note: String::new(),
        x,
        x_ticks: &|tick| if x.value(*tick).fract() == 0.0 { x.tick(*tick) } else { String::new() },
        x_title: format!("model steps of {} environment steps", prediction.frameskip),
        y,
        y_ticks: &|tick| y.tick(*tick),
        curves: prediction.groups.iter().map(curve).collect(),
        description: format!("{title}: mean prediction error by model step"),
    };
    plot::inline(&panel).map(Some)
}

/// The error of every trajectory, one row of strokes for each group; `None` for values that cannot be drawn.
fn trajectories(row: &Row<'_>, prediction: &Prediction, title: &str) -> Result<Option<String>> {
    let errors = prediction.trajectories.iter().map(Trajectory::error);
    let Some(axis) = Axis::of(errors.chain([0.0])) else { return Ok(None) };
    let strips = prediction.groups.iter().map(|group| {
        let (name, ink, _) = look(group, row);
        let is_member = |t: &&Trajectory| group.success.is_none() || t.success == group.success;
        let members = prediction.trajectories.iter().filter(is_member).take(limits::STROKES);
        Strip {
            name,
            ink,
            errors: members.map(Trajectory::error).collect(),
            median: group.trajectory.median,
            tip: format!("median {} of {} trajectories", number(group.trajectory.median), group.trajectory.n),
        }
    });
    let heading = format!("{title}: error of each trajectory");
    let strips = Strips { heading, axis, strips: strips.collect() };
    plot::inline(&strips).map(Some)
}

/// The errors of one group.
struct Strip {
    name: &'static str,
    ink: Ink,
    errors: Vec<f64>,
    median: f64,
    tip: String,
}

/// A row of strokes for each group.
struct Strips {
    heading: String,
    axis: Axis,
    strips: Vec<Strip>,
}

/// The height of a row.
const ROW: f64 = 46.0;
/// The top of the first row.
const TOP: f64 = 28.0;

impl Figure for Strips {
    fn width(&self, layout: Layout) -> f64 {
        layout.width().min(PANEL)
    }

    fn height(&self, _: Layout) -> f64 {
        TOP + ROW * self.strips.len() as f64 + 48.0
    }

    fn description(&self) -> String {
        let medians: Vec<String> = self.strips.iter().map(|strip| format!("{}: {}", strip.name, strip.tip)).collect();
        format!("{}. {}", self.heading, medians.join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let width = canvas.width();
        let heading = canvas.fit(HEADING - 1.0, &self.heading, width - 4.0);
        canvas.text([0.0, 12.0], Anchor::Start, HEADING - 1.0, Ink::Text, &heading)?;
        let (left, right, bottom) = (86.0, width - 20.0, TOP + ROW * self.strips.len() as f64);
        let ticks = |tick: &f64| self.axis.tick(*tick);
        canvas.chart([left, TOP, right, bottom], (self.axis.range(), &ticks), (bottom..TOP, None))?;
        let title = "mean over the steps, in variances of the latents";
        canvas.text([f64::midpoint(left, right), bottom + 36.0], Anchor::Middle, SMALL, Ink::Soft, title)?;
        for (i, strip) in self.strips.iter().enumerate() {
            let y = TOP + (i as f64 + 0.5) * ROW;
            canvas.text([left - 12.0, y], Anchor::End, TEXT, Ink::Text, strip.name)?;
            let x = |error: f64| left + self.axis.share(error) * (right - left);
            for error in &strip.errors {
                let ends = [[x(*error), y - 11.0], [x(*error), y + 11.0]];
                let mut style = stroke(strip.ink, 1.5);
                style.color = style.color.mix(0.4);
                canvas.line(&ends, style)?;
            }
            canvas.dot([x(strip.median), y], 5.0, strip.ink, true)?;
            canvas.tip([left, y - ROW / 2.0], [right - left, ROW], &strip.tip);
        }
        Ok(())
    }
}
