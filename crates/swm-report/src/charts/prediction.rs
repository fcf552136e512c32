//! The charts of prediction errors, grouped by success.

use super::svg::{HALF, Scale, Svg};
use crate::group::{Condition, Row};
use crate::text::{number, shorten};
use swm_core::results::{Group, Prediction};

/// The charts of all runs of a condition with prediction errors.
pub(crate) fn charts(condition: &Condition<'_>) -> String {
    let evaluated = condition.rows.iter().filter_map(|row| Some((row, row.run.prediction.as_ref()?)));
    evaluated
        .filter(|(_, prediction)| !prediction.groups.is_empty())
        .map(|(row, prediction)| {
            let title = format!("{}, {}", row.label, condition.name);
            steps(row, prediction, &title) + &trajectories(row, prediction, &title)
        })
        .collect()
}

/// The label of a group and its CSS class.
fn label(group: &Group) -> (&'static str, &'static str) {
    match group.success {
        None => ("all", "dashed"),
        Some(true) => ("solved", "good"),
        Some(false) => ("not solved", "bad"),
    }
}

/// The mean error of each model step, one curve for each group.
fn steps(row: &Row<'_>, prediction: &Prediction, title: &str) -> String {
    let [left, top, bottom] = [56.0, 46.0, 200.0];
    let right = HALF - 12.0;
    let mut svg = Svg::new(HALF, bottom + 42.0);
    let horizon = prediction.groups[0].steps.len();
    let highest = prediction.groups.iter().flat_map(|g| &g.steps).map(|step| step.mean).fold(0.0, f64::max);
    let (y, levels) = Scale::nice(0.0, highest, bottom, top, 4);
    let x = Scale { low: 0.0, high: horizon as f64, from: left, to: right };
    let every = horizon.div_ceil(10).max(1);
    let ticks: Vec<f64> = (0..=horizon).step_by(every).map(|step| step as f64).collect();
    svg.text("head", [0.0, 16.0], &shorten(&format!("{title}: error by step"), 58));
    svg.y_axis(y, &levels, [left, right], "");
    svg.x_axis(x, &ticks, [top, bottom], "");
    let unit = format!("model steps of {} environment steps", prediction.frameskip);
    svg.text("tick middle", [(left + right) / 2.0, bottom + 36.0], &unit);
    for (i, group) in prediction.groups.iter().enumerate() {
        let (name, class) = label(group);
        let class = format!("curve {class} {}", row.class);
        let points = group.steps.iter().enumerate().map(|(i, step)| [x.at((i + 1) as f64), y.at(step.mean)]);
        // The error at step 0, before any prediction, is 0.
        svg.path(&class, std::iter::once([x.at(0.0), y.at(0.0)]).chain(points));
        let key = left + 125.0 * i as f64;
        svg.path(&class, [[key, 32.0], [key + 26.0, 32.0]]);
        svg.text("tick", [key + 32.0, 36.0], &format!("{name} ({})", group.trajectory.n));
    }
    svg.finish(&format!("{title}: mean prediction error by model step"))
}

/// The error of every trajectory, one row of strokes for each group.
fn trajectories(row: &Row<'_>, prediction: &Prediction, title: &str) -> String {
    const LINE: f64 = 46.0;
    let [left, top] = [96.0, 30.0];
    let right = HALF - 16.0;
    let bottom = top + LINE * prediction.groups.len() as f64;
    let errors = || prediction.trajectories.iter().map(|trajectory| trajectory.error());
    let (x, ticks) = Scale::nice(0.0, errors().fold(0.0, f64::max), left, right, 5);
    let mut svg = Svg::new(HALF, bottom + 42.0);
    svg.text("head", [0.0, 16.0], &shorten(&format!("{title}: error of each trajectory"), 58));
    svg.x_axis(x, &ticks, [top, bottom], "");
    svg.text(
        "tick middle",
        [(left + right) / 2.0, bottom + 36.0],
        "mean over the steps, in units of the latents' variance",
    );
    for (i, group) in prediction.groups.iter().enumerate() {
        let (name, class) = label(group);
        let y = top + (i as f64 + 0.5) * LINE;
        svg.text("label end", [left - 12.0, y + 4.5], name);
        let members = prediction.trajectories.iter().filter(|t| group.success.is_none() || t.success == group.success);
        for trajectory in members {
            let at = x.at(trajectory.error());
            svg.line(&format!("stroke {class} {}", row.class), [at, y - 11.0], [at, y + 11.0]);
        }
        let at = x.at(group.trajectory.median);
        let tip = format!("median {} of {} trajectories", number(group.trajectory.median), group.trajectory.n);
        svg.dot(&format!("point {class} {}", row.class), [at, y], 5.0, &tip);
    }
    svg.finish(&format!("{title}: prediction error of every trajectory"))
}
