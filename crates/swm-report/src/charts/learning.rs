//! The learning curves of a table whose columns are returns at shares of the training.

use super::axis::Axis;
use super::curves::{Curve, Curves, Stroke};
use crate::plot::{self, Ink};
use crate::text::{number, shorten};
use std::collections::BTreeMap;
use swm_core::Result;
use swm_core::results::{StudyTable, TableColumn};

/// The most panels.
const PANELS: usize = 24;
/// The most curves of a panel.
const CURVES: usize = 12;

/// The share of the training, in percent, at which a column has returns.
fn share(column: &TableColumn) -> Option<f64> {
    let share = column.name.strip_prefix("after ")?.strip_suffix(" %")?;
    share.parse().ok().filter(|_| column.unit == "return" && !column.published)
}

/// Draws a panel for each task: a curve for each row whose name begins with the task, `TASK, MODEL`, and a dashed line for the
/// random policy. None for a table without such columns.
///
/// # Errors
/// When drawing fails.
pub(crate) fn panels(table: &StudyTable) -> Result<Vec<String>> {
    let shares: Vec<(usize, f64)> =
        table.columns.iter().enumerate().filter_map(|(i, column)| Some((i, share(column)?))).collect();
    if shares.len() < 2 {
        return Ok(vec![]);
    }
    let random = table.columns.iter().position(|column| column.name == "random policy");
    let (mut tasks, mut inks) = (vec![], BTreeMap::new());
    for row in &table.rows {
        let (task, model) = row.name.split_once(", ").unwrap_or((&row.name, ""));
        let next = inks.len();
        let ink = Ink::Policy(*inks.entry(model).or_insert(next));
        let value = |i: usize| row.values.get(i).copied().flatten().filter(|value| value.is_finite());
        let points: Vec<[f64; 2]> = shares.iter().filter_map(|(i, x)| Some([*x, value(*i)?])).collect();
        if points.len() < 2 {
            continue;
        }
        let floor = random.and_then(value);
        let curve = Curve { name: shorten(model, 30), ink, stroke: Stroke::Solid, points, band: vec![] };
        match tasks.iter_mut().find(|(known, ..): &&mut (&str, Option<f64>, Vec<Curve>)| *known == task) {
            Some((_, _, curves)) if curves.len() < CURVES => curves.push(curve),
            Some(_) => {}
            None => tasks.push((task, floor, vec![curve])),
        }
    }
    let mut panels = vec![];
    for (task, floor, mut curves) in tasks.into_iter().take(PANELS) {
        let ends: Vec<String> = curves
            .iter()
            .map(|curve| format!("{} {}", curve.name, number(curve.points[curve.points.len() - 1][1])))
            .collect();
        if let Some(floor) = floor {
            let points = [0.0, 100.0].map(|x| [x, floor]).to_vec();
            curves.push(Curve {
                name: "random".to_owned(),
                ink: Ink::Floor,
                stroke: Stroke::Dashed,
                points,
                band: vec![],
            });
        }
        let all = || curves.iter().flat_map(|curve| &curve.points);
        let Some((x, y)) = Axis::of([0.0, 100.0].into_iter()).zip(Axis::of(all().map(|point| point[1]))) else {
            continue;
        };
        let y = y.with_room();
        let panel = Curves {
            heading: shorten(task, 40),
            note: String::new(),
            x,
            x_ticks: &|tick| format!("{}\u{a0}%", x.tick(*tick)),
            x_title: "share of the training".to_owned(),
            y,
            y_ticks: &|tick| y.tick(*tick),
            description: format!("Returns over training in {task}, ending at: {}", ends.join(", ")),
            curves,
        };
        panels.push(plot::inline(&panel)?);
    }
    Ok(panels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::TableRow;

    #[test]
    fn tasks_have_panels_with_a_curve_for_each_model() {
        let column = |name: &str| TableColumn { name: name.to_owned(), unit: "return".to_owned(), published: false };
        let row = |name: &str, values: [Option<f64>; 3]| TableRow {
            cell: "00".to_owned(),
            name: name.to_owned(),
            values: values.to_vec(),
            machine: String::new(),
            paths: vec![],
        };
        let table = StudyTable {
            columns: ["random policy", "after 50 %", "after 100 %"].map(column).to_vec(),
            rows: vec![
                row("Walker run, sac", [Some(2.0), Some(30.0), Some(410.0)]),
                row("Walker run, tdmpc2", [Some(2.0), Some(300.0), Some(510.0)]),
                row("Hopper hop, sac", [Some(0.0), Some(0.0), Some(0.5)]),
                row("Hopper hop, tdmpc2", [None, None, None]),
            ],
            ..StudyTable::default()
        };
        let panels = panels(&table).expect("panels");
        assert_eq!(panels.len(), 2);
        assert!(panels[0].contains("Walker run") && panels[0].contains("sac 410, tdmpc2 510"), "{}", panels[0]);
        panels.iter().for_each(|panel| plot::check_texts(panel, 4));
        let other = StudyTable { columns: vec![column("speed")], ..table };
        assert!(super::panels(&other).expect("panels").is_empty());
    }
}
