//! The values of rows: a dot for each column of one unit, on one line for each row.

use super::{AXIS, Drawn, finish, legend};
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, Ink, Layout, SMALL, Surface, TEXT, stroke};
use crate::text::{number, shorten};
use swm_core::Result;
use swm_core::results::StudyTable;

/// The largest number of rows.
const MOST: usize = 120;
/// The height of a row.
const ROW: f64 = 20.0;
/// The height of the name of a row above its dots.
const NAME: f64 = 19.0;
/// The width of the names beside the dots.
const NAMES: f64 = 270.0;

struct Dots<'a> {
    unit: &'a str,
    columns: Vec<Column<'a>>,
    /// The name of each row and its values, in the order of the columns.
    rows: Vec<(String, Vec<Option<f64>>)>,
}

struct Column<'a> {
    name: &'a str,
    ink: Ink,
    published: bool,
}

/// Draws a figure for each unit; nothing for a unit without values.
pub(in crate::study) fn draw(table: &StudyTable) -> Result<Vec<Drawn>> {
    let mut units: Vec<&str> = vec![];
    for column in &table.columns {
        if !units.contains(&column.unit.as_str()) {
            units.push(&column.unit);
        }
    }
    let mut drawn = vec![];
    for unit in units {
        let indices: Vec<usize> = (0..table.columns.len()).filter(|i| table.columns[*i].unit == unit).collect();
        let mut ours = 0;
        let columns = indices.iter().map(|i| {
            let column = &table.columns[*i];
            // The published values of a column have its colour.
            let index = if column.published {
                let stem = column.name.strip_suffix(", published").unwrap_or(&column.name);
                indices.iter().position(|i| table.columns[*i].name == stem).unwrap_or(0)
            } else {
                ours += 1;
                ours - 1
            };
            Column { name: &column.name, ink: Ink::Policy(index), published: column.published }
        });
        let columns: Vec<Column<'_>> = columns.collect();
        let finite = |value: Option<f64>| value.filter(|value| (0.0..1e12).contains(value));
        let rows = table.rows.iter().take(MOST).map(|row| {
            let values = indices.iter().map(|i| finite(row.values.get(*i).copied().flatten())).collect();
            (shorten(&row.name, 120), values)
        });
        let rows: Vec<(String, Vec<Option<f64>>)> = rows.collect();
        if rows.iter().all(|(_, values)| values.iter().all(Option::is_none)) {
            continue;
        }
        let is_published = columns.iter().any(|column| column.published);
        let caption = if is_published { "Filled dots are ours, rings are published values." } else { "" };
        let figure = Dots { unit, columns, rows };
        drawn.extend(finish("dots", format!("Values in {}", crate::text::escape(unit)), caption.to_owned(), &figure)?);
    }
    Ok(drawn)
}

impl Dots<'_> {
    fn row(layout: Layout) -> f64 {
        if layout == Layout::Wide { ROW } else { NAME + ROW }
    }

    fn legend(&self) -> Vec<(Ink, String)> {
        self.columns
            .iter()
            .filter(|column| !column.published)
            .map(|column| (column.ink, column.name.to_owned()))
            .collect()
    }

    fn largest(&self) -> f64 {
        let values = self.rows.iter().flat_map(|(_, values)| values).flatten();
        values.fold(0.0_f64, |largest, value| largest.max(*value)).max(1e-9)
    }
}

impl Figure for Dots<'_> {
    fn height(&self, layout: Layout) -> f64 {
        legend::height(self.legend().len(), layout) + self.rows.len() as f64 * Self::row(layout) + AXIS + 10.0
    }

    fn description(&self) -> String {
        let rows = self.rows.iter().map(|(name, values)| {
            let values = values.iter().zip(&self.columns);
            let values = values.filter_map(|(value, column)| Some(format!("{} {}", column.name, number((*value)?))));
            format!("{name}: {}", values.collect::<Vec<_>>().join(", "))
        });
        format!("Values in {}. {}", self.unit, rows.collect::<Vec<_>>().join("; "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let (layout, width, entries) = (canvas.layout, canvas.width(), self.legend());
        legend::draw(canvas, &entries)?;
        let top = legend::height(entries.len(), layout) + 4.0;
        let left = if layout == Layout::Wide { NAMES } else { 10.0 };
        let (right, bottom) = (width - 24.0, self.height(layout) - AXIS);
        let largest = 1.05 * self.largest();
        let area = [left, top, right, bottom];
        canvas.chart(area, (0.0..largest, &|value| number(*value)), (bottom..top, None))?;
        let x = |value: f64| left + value / largest * (right - left);
        canvas.text([f64::midpoint(left, right), bottom + 36.0], Anchor::Middle, SMALL, Ink::Soft, self.unit)?;
        for (i, (name, values)) in self.rows.iter().enumerate() {
            let y = top + 3.0 + (i as f64 + 1.0) * Self::row(layout) - ROW / 2.0;
            match layout {
                Layout::Wide => {
                    let name = canvas.fit(TEXT, name, left - 16.0);
                    canvas.text([left - 12.0, y], Anchor::End, TEXT, Ink::Text, &name)?;
                }
                Layout::Narrow => {
                    let name = canvas.fit(TEXT, name, width - 4.0);
                    let at = y - ROW / 2.0 - NAME / 2.0;
                    let size = [canvas.measure(TEXT, &name) + 3.0, NAME - 3.0];
                    canvas.rect(
                        [0.0, at - NAME / 2.0 + 1.5],
                        size,
                        plotters::style::Color::filled(&Ink::Surface.rgb()),
                    )?;
                    canvas.text([0.0, at], Anchor::Start, TEXT, Ink::Text, &name)?;
                }
            }
            let drawn = || values.iter().zip(&self.columns).filter_map(|(value, column)| Some((x((*value)?), column)));
            let (first, last) = drawn().fold((f64::INFINITY, left), |(low, high), (x, _)| (low.min(x), high.max(x)));
            if first < last {
                canvas.line(&[[first, y], [last, y]], stroke(Ink::Grid, 1.5))?;
            }
            // Rings are drawn last and wider, so that a dot of the same value stays visible.
            for (x, column) in drawn().filter(|(_, column)| !column.published) {
                canvas.dot([x, y], 4.0, column.ink, true)?;
            }
            for (x, column) in drawn().filter(|(_, column)| column.published) {
                canvas.ring([x, y], 6.5, column.ink)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use swm_core::results::{TableColumn, TableRow};

    #[test]
    fn units_with_values_have_a_figure() {
        let column = |name: &str, unit: &str| TableColumn {
            name: name.to_owned(),
            unit: unit.to_owned(),
            published: name.ends_with("published"),
        };
        let row = |name: &str, values: [Option<f64>; 4]| TableRow {
            cell: String::new(),
            name: name.to_owned(),
            values: values.to_vec(),
            machine: String::new(),
            paths: vec![],
        };
        let table = StudyTable {
            columns: vec![column("a", "ms"), column("b", "MB"), column("c", "kg"), column("a, published", "ms")],
            rows: vec![
                row("one", [Some(1.0), Some(2.0), None, Some(1.0)]),
                row("a long name of a row that has to be cut off somewhere", [None, Some(f64::NAN), None, Some(3.0)]),
            ],
            ..StudyTable::default()
        };
        let drawn = draw(&table).expect("figures");
        let headings: Vec<&str> = drawn.iter().map(|figure| figure.heading.as_str()).collect();
        assert_eq!(headings, ["Values in ms", "Values in MB"]);
        assert!(drawn[0].caption.contains("rings") && drawn[1].caption.is_empty());
        assert!(drawn[0].drawing.svg.contains("one: a 1, a, published 1"), "{}", drawn[0].drawing.svg);
        for layout in drawn[0].drawing.inline.split("<svg").skip(1) {
            let (size, texts) = crate::plot::text_boxes(&format!("<svg{layout}"));
            for ([left, top, right, bottom], words) in texts {
                assert!(left >= 0.0 && top >= 0.0 && right <= size[0] && bottom <= size[1], "{words} is cut off");
            }
        }
    }
}
