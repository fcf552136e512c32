//! The chart of all episodes.

use crate::group::{Group, Row};
use crate::limits;
use crate::plot::{self, Anchor, Canvas, Drawn as Painted, Figure, HEADING, Ink, Layout, Surface, TEXT};
use crate::text::outcome;
use plotters::style::Color as _;
use std::collections::BTreeMap;
use swm_core::Result;

/// The side of a square with the space beside it, in pixels.
const CELL: f64 = 12.0;
/// The width of the names beside the squares.
const NAMES: f64 = 200.0;
/// The height of a heading.
const HEAD: f64 = 32.0;
/// The height of a name above its squares.
const NAME: f64 = 20.0;
/// The space below the squares of a run.
const SPACE: f64 = 10.0;

/// The ids of the videos of a page, by results file, condition, policy and episode.
pub(crate) type VideoIds<'a> = BTreeMap<(usize, &'a str, &'a str, usize), String>;

/// Draws every episode as a square, in order, so that runs on the same starts can be compared start by start. A square
/// links to the video of its episode. Runs beyond [`limits::SQUARES`] are left out.
///
/// # Errors
/// When drawing fails.
pub(crate) fn chart(group: &Group<'_>, videos: &VideoIds<'_>) -> Result<String> {
    let mut left = limits::SQUARES;
    let mut conditions = vec![];
    for condition in &group.conditions {
        let fits = |row: &&Row<'_>| {
            let n = row.run.episodes.len();
            let fits = n <= left;
            left = if fits { left - n } else { 0 };
            fits
        };
        let rows: Vec<&Row<'_>> = condition.rows.iter().take_while(fits).collect();
        conditions.extend((!rows.is_empty()).then_some((condition.name, rows)));
    }
    plot::inline(&Squares { conditions, videos })
}

struct Squares<'g, 'a> {
    conditions: Vec<(&'a str, Vec<&'g Row<'a>>)>,
    videos: &'g VideoIds<'a>,
}

impl Squares<'_, '_> {
    /// The left edge of the squares and their number in a line.
    fn columns(layout: Layout) -> (f64, usize) {
        let left = if layout == Layout::Wide { NAMES } else { 0.0 };
        (left, ((layout.width() - left) / CELL).floor() as usize)
    }

    /// The height of a run, and of the name above its squares.
    fn row(row: &Row<'_>, layout: Layout) -> [f64; 2] {
        let lines = row.run.episodes.len().div_ceil(Self::columns(layout).1).max(1);
        let name = if layout == Layout::Wide { 0.0 } else { NAME };
        [name + lines as f64 * CELL + SPACE, name]
    }
}

impl Figure for Squares<'_, '_> {
    fn height(&self, layout: Layout) -> f64 {
        let rows = self.conditions.iter().flat_map(|(_, rows)| rows).map(|row| Self::row(row, layout)[0]);
        self.conditions.len() as f64 * HEAD + rows.sum::<f64>() + 4.0
    }

    fn description(&self) -> String {
        "Every episode as a square: filled if solved, empty if not solved".to_owned()
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let (left, columns) = Self::columns(canvas.layout);
        let mut top = 0.0;
        for (name, rows) in &self.conditions {
            let name = canvas.fit(HEADING, name, canvas.width() - 4.0);
            canvas.text([0.0, top + HEAD / 2.0], Anchor::Start, HEADING, Ink::Text, &name)?;
            top += HEAD;
            for row in rows {
                let [height, above] = Self::row(row, canvas.layout);
                if canvas.layout == Layout::Wide {
                    let name = canvas.fit(TEXT, &row.label, left - 18.0);
                    canvas.text([left - 14.0, top + CELL / 2.0 - 1.0], Anchor::End, TEXT, Ink::Text, &name)?;
                } else {
                    let name = canvas.fit(TEXT, &row.label, canvas.width() - 4.0);
                    canvas.text([0.0, top + NAME / 2.0], Anchor::Start, TEXT, Ink::Text, &name)?;
                }
                for i in 0..row.run.episodes.len() {
                    let corner = [left + (i % columns) as f64 * CELL, top + above + (i / columns) as f64 * CELL];
                    self.square(canvas, row, i, corner)?;
                }
                top += height;
            }
        }
        Ok(())
    }
}

impl Squares<'_, '_> {
    /// Draws the square of an episode.
    fn square<B: Surface>(&self, canvas: &Canvas<B>, row: &Row<'_>, i: usize, corner: [f64; 2]) -> Painted<B> {
        let (class, words) = outcome(&row.run.episodes[i]);
        let size = [CELL - 2.0; 2];
        match class {
            "solved" => canvas.rect(corner, size, row.ink.rgb().filled())?,
            "start" => canvas.rect(corner, size, row.ink.rgb().mix(0.2).filled())?,
            _ => canvas.outline(corner, size, row.ink, 1.0)?,
        }
        let words = format!("episode {i}: {words}");
        match self.videos.get(&(row.file, row.run.condition.as_str(), row.run.policy.as_str(), i)) {
            Some(id) => {
                canvas.outline(corner, size, Ink::Text, 2.0)?;
                canvas.link(corner, size, &words, id);
            }
            None => canvas.tip(corner, size, &words),
        }
        Ok(())
    }
}
