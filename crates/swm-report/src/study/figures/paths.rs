//! The paths of rows in a plane: dots for rows whose paths are single points, lines for the others.

use super::{AXIS, Drawn, finish, legend};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, stroke, units};
use crate::text::{number, shorten};
use plotters::element::Circle;
use plotters::series::LineSeries;
use plotters::style::Color as _;
use swm_core::Result;
use swm_core::results::StudyTable;

/// The most rows with paths, and the most paths and points of a row: others are left out.
const ROWS: usize = 8;
const PATHS: usize = 24;
const DOTS: usize = 1200;
const POINTS: usize = 120;
/// The space around the data, as a share of their extent.
const ROOM: f64 = 0.04;

struct Paths {
    rows: Vec<Row>,
    /// The middle of the data, and half of their extent, along each axis.
    middle: [f64; 2],
    extent: [f64; 2],
}

struct Row {
    name: String,
    ink: Ink,
    paths: Vec<Vec<[f64; 2]>>,
}

/// Draws the paths of all rows; nothing for a table without any.
pub(in crate::study) fn draw(table: &StudyTable) -> Result<Vec<Drawn>> {
    let mut lines = 0;
    let rows = table.rows.iter().filter(|row| !row.paths.is_empty()).take(ROWS).map(|row| {
        let are_dots = row.paths.iter().all(|path| path.len() == 1);
        let most = if are_dots { DOTS } else { PATHS };
        let points = |path: &Vec<[f64; 2]>| thinned(path, POINTS).into_iter().copied().collect();
        let paths = thinned(&row.paths, most).into_iter().map(points).collect();
        let ink = if are_dots {
            Ink::Floor
        } else {
            lines += 1;
            Ink::Policy(lines - 1)
        };
        Row { name: shorten(&row.name, 60), ink, paths }
    });
    let rows: Vec<Row> = rows.collect();
    let points = || rows.iter().flat_map(|row| row.paths.iter().flatten());
    let is_drawable = points().flatten().all(|value| value.is_finite() && value.abs() < 1e6);
    let range = |axis: usize| {
        points().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], point| {
            [low.min(point[axis]), high.max(point[axis])]
        })
    };
    let ranges = [range(0), range(1)];
    if !is_drawable || ranges.iter().any(|[low, high]| low > high) {
        return Ok(vec![]);
    }
    let figure = Paths {
        middle: ranges.map(|[low, high]| f64::midpoint(low, high)),
        extent: ranges.map(|[low, high]| ((high - low) * (0.5 + ROOM)).max(1e-3)),
        rows,
    };
    let caption = "Latents along the two principal components of those that the model was trained on; both axes have one scale. \
                   Dots are frames of held-out episodes, lines are episodes of a policy, and rings are their last frames."
        .to_owned();
    finish("paths", "Latents of the policies".to_owned(), caption, &figure)
}

/// At most `most` elements at equal distances, the last one among them.
fn thinned<T>(all: &[T], most: usize) -> Vec<&T> {
    let count = all.len().min(most);
    (0..count).filter_map(|i| all.get((i + 1) * all.len() / count - 1)).collect()
}

impl Paths {
    fn chart(layout: Layout) -> f64 {
        if layout == Layout::Wide { 480.0 } else { 300.0 }
    }

    fn legend(&self) -> Vec<(Ink, String)> {
        self.rows.iter().map(|row| (row.ink, row.name.clone())).collect()
    }
}

impl Figure for Paths {
    fn height(&self, layout: Layout) -> f64 {
        legend::height(self.rows.len(), layout) + Self::chart(layout) + AXIS
    }

    fn description(&self) -> String {
        let row = |row: &Row| {
            let ends = row.paths.iter().filter_map(|path| path.last());
            let count = row.paths.len().max(1) as f64;
            let [x, y] = ends.fold([0.0; 2], |sum, end| [sum[0] + end[0] / count, sum[1] + end[1] / count]);
            format!(
                "{}: {} paths that end around {}, {}",
                row.name,
                row.paths.len(),
                number(round(x)),
                number(round(y))
            )
        };
        format!("Latents in a plane. {}", self.rows.iter().map(row).collect::<Vec<_>>().join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let entries = self.legend();
        legend::draw(canvas, &entries)?;
        let top = legend::height(entries.len(), canvas.layout) + 4.0;
        let (left, right, bottom) = (46.0, canvas.width() - 12.0, top + Self::chart(canvas.layout) - 8.0);
        // One scale for both axes.
        let scale = (2.0 * self.extent[0] / (right - left)).max(2.0 * self.extent[1] / (bottom - top));
        let half = [scale * (right - left) / 2.0, scale * (bottom - top) / 2.0];
        let [x, y] = [0, 1].map(|axis| self.middle[axis] - half[axis]..self.middle[axis] + half[axis]);
        let ticks = |value: &f64| number(round(*value));
        let area = [left, top, right, bottom];
        let mut chart = canvas.chart(area, (x, &ticks), (y, Some(&ticks)))?;
        let title = "first principal component (second: vertical)";
        let title = canvas.fit(SMALL, title, right - left);
        canvas.text([f64::midpoint(left, right), bottom + 34.0], Anchor::Middle, SMALL, Ink::Soft, &title)?;
        let point = |point: &[f64; 2]| (point[0], point[1]);
        for row in &self.rows {
            for path in &row.paths {
                if let [only] = &path[..] {
                    chart.draw_series([Circle::new(point(only), units(1.3), row.ink.rgb().filled())])?;
                    continue;
                }
                for part in smooth(path) {
                    chart.draw_series(LineSeries::new(part.iter().map(point), stroke(row.ink, 1.0)))?;
                }
                chart
                    .draw_series(path.last().map(|last| Circle::new(point(last), units(2.6), stroke(row.ink, 1.2))))?;
            }
        }
        Ok(())
    }
}

/// The parts of a path that turn by at most a right angle at their points: joints of sharper turns would be drawn as long spikes.
fn smooth(path: &[[f64; 2]]) -> Vec<&[[f64; 2]]> {
    let (mut parts, mut start) = (vec![], 0);
    for (i, points) in path.windows(3).enumerate() {
        let [before, after] = [0, 1].map(|j| [0, 1].map(|axis| points[j + 1][axis] - points[j][axis]));
        if before[0] * after[0] + before[1] * after[1] < 0.0 {
            parts.push(&path[start..i + 2]);
            start = i + 1;
        }
    }
    parts.push(&path[start..]);
    parts
}

/// A coordinate without the rounding errors of ticks.
fn round(value: f64) -> f64 {
    (value * 1e4).round() / 1e4
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::TableRow;

    #[test]
    fn rows_with_points_are_dots_and_others_lines() {
        let row = |name: &str, paths: Vec<Vec<[f64; 2]>>| TableRow {
            cell: String::new(),
            name: name.to_owned(),
            values: vec![],
            machine: String::new(),
            paths,
        };
        let dots = (0..2000).map(|i| vec![[f64::from(i % 50) / 10.0, f64::from(i / 50) / 10.0]]).collect();
        let line = |end: f64| (0..500).map(|i| [f64::from(i) / 499.0 * end, 1.0]).collect();
        let table = StudyTable {
            rows: vec![
                row("held-out", dots),
                row("expert", vec![line(3.0), line(4.0)]),
                row("actor", vec![line(9.0)]),
                row("none", vec![]),
            ],
            ..StudyTable::default()
        };
        let drawn = draw(&table).expect("a figure");
        let [figure] = &drawn[..] else { panic!("{} figures", drawn.len()) };
        assert!(figure.drawing.svg.contains("expert: 2 paths that end around 3.5, 1"), "{}", figure.drawing.svg);
        assert!(figure.drawing.svg.matches("<polyline").count() >= 3);
        crate::plot::check_texts(&figure.drawing.inline, 6);
        assert!(figure.drawing.inline.len() < 400_000, "{} bytes", figure.drawing.inline.len());
        assert!(draw(&StudyTable::default()).expect("nothing").is_empty());
        let wrong = StudyTable { rows: vec![row("x", vec![vec![[f64::NAN, 0.0]]])], ..StudyTable::default() };
        assert!(draw(&wrong).expect("nothing").is_empty());
    }

    #[test]
    fn paths_are_parted_where_they_turn_back() {
        let path = [[0.0, 0.0], [1.0, 0.0], [2.0, 1.0], [1.0, 1.0], [1.0, 2.0]];
        assert_eq!(smooth(&path), [&path[..3], &path[2..]]);
        assert_eq!(smooth(&path[..2]), [&path[..2]]);
    }

    #[test]
    fn thinned_lists_keep_their_last_element() {
        assert_eq!(thinned(&[1, 2, 3], 5), [&1, &2, &3]);
        assert_eq!(thinned(&(0..100).collect::<Vec<_>>(), 4), [&24, &49, &74, &99]);
        assert!(thinned::<u8>(&[], 4).is_empty());
    }
}
