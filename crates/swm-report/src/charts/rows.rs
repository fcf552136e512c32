//! [`Rows`]: points with intervals, one row each, in sections.

use super::axis::Axis;
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, HEADING, Ink, Layout, SMALL, Surface, TEXT, stroke};
use plotters::style::Color as _;

/// A point with an interval.
pub(super) struct Row {
    pub name: String,
    pub ink: Ink,
    /// The ends of the interval and the point between them; `None` for a row with its words only.
    pub marks: Option<[f64; 3]>,
    /// Whether the dot is filled.
    pub filled: bool,
    /// The value in words, beside the point.
    pub value: String,
    /// The value in a sentence.
    pub sentence: String,
}

/// Rows with a common heading.
pub(super) struct Section {
    pub heading: String,
    pub rows: Vec<Row>,
    /// An interval and a point that all rows are compared with.
    pub floor: Option<[f64; 3]>,
}

/// How a point is drawn.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Mark {
    /// A dot on a whisker.
    Dot,
    /// A bar from zero, and a whisker.
    Bar,
}

/// Points with intervals, one row each.
pub(super) struct Rows<'a> {
    pub sections: Vec<Section>,
    pub axis: Axis,
    pub ticks: &'a dyn Fn(&f64) -> String,
    /// What the axis measures; empty if its ticks say so.
    pub title: &'a str,
    pub mark: Mark,
    /// Whether a line marks zero.
    pub zero: bool,
    /// The widths of the names and the values beside the points, in pixels.
    pub room: [f64; 2],
    /// What the chart shows, in words.
    pub what: &'a str,
}

/// The height of a heading.
const HEAD: f64 = 30.0;
/// The height of a row.
const ROW: f64 = 28.0;
/// The height of a line of words above a point.
const LINE: f64 = 18.0;
/// The height of a point below its words.
const POINT: f64 = 22.0;
/// The widest values that stand in the line of their names.
const SHORT: f64 = 140.0;

impl Rows<'_> {
    /// The height of a row, and how far below its top the point is drawn.
    fn row(&self, layout: Layout) -> [f64; 2] {
        let lines = if self.room[1] > SHORT { 2.0 * LINE } else { LINE };
        match layout {
            Layout::Wide => [ROW, ROW / 2.0],
            Layout::Narrow => [lines + POINT, lines + 8.0],
        }
    }

    fn bottom(&self, layout: Layout) -> f64 {
        let rows: usize = self.sections.iter().map(|section| section.rows.len()).sum();
        let headings = self.sections.iter().filter(|section| !section.heading.is_empty()).count();
        8.0 + headings as f64 * HEAD + rows as f64 * self.row(layout)[0]
    }

    /// Draws the words of a row whose top is at `top`.
    fn words<B: Surface>(&self, canvas: &Canvas<B>, row: &Row, [left, right, top]: [f64; 3]) -> Painted<B> {
        let [_, middle] = self.row(canvas.layout);
        if canvas.layout == Layout::Wide {
            let name = canvas.fit(TEXT, &row.name, self.room[0] - 18.0);
            canvas.text([left - 14.0, top + middle], Anchor::End, TEXT, Ink::Text, &name)?;
            let value = canvas.fit(SMALL + 0.5, &row.value, self.room[1] - 14.0);
            return canvas.text([right + 14.0, top + middle], Anchor::Start, SMALL + 0.5, Ink::Text, &value);
        }
        // The words cover the lines of the grid.
        let width = canvas.width();
        canvas.rect([0.0, top + 1.0], [width, middle - 10.0], Ink::Surface.rgb().filled())?;
        let value = canvas.fit(SMALL + 0.5, &row.value, width - 4.0);
        let (room, at, anchor) = if self.room[1] > SHORT {
            (width - 4.0, [0.0, top + 1.5 * LINE], Anchor::Start)
        } else {
            let room = width - canvas.measure(SMALL + 0.5, &value) - 12.0;
            (room, [width - 1.0, top + LINE / 2.0], Anchor::End)
        };
        let name = canvas.fit(TEXT, &row.name, room);
        canvas.text([0.0, top + LINE / 2.0], Anchor::Start, TEXT, Ink::Text, &name)?;
        canvas.text(at, anchor, SMALL + 0.5, Ink::Soft, &value)
    }

    /// Draws the point of a row and its interval, between `left` and `right`.
    fn point<B: Surface>(&self, canvas: &Canvas<B>, row: &Row, [left, right, y]: [f64; 3]) -> Painted<B> {
        let Some(marks) = row.marks else { return Ok(()) };
        let x = |value: f64| left + self.axis.share(value) * (right - left);
        let [low, at, high] = marks.map(x);
        if self.mark == Mark::Bar {
            let zero = x(0.0);
            canvas.rect([zero, y - 7.0], [at - zero, 14.0], row.ink.rgb().mix(0.35).filled())?;
        }
        let line = stroke(row.ink, 2.0);
        canvas.line(&[[low, y], [high, y]], line)?;
        let caps = if self.mark == Mark::Bar { vec![high] } else { vec![low, high] };
        for end in caps {
            canvas.line(&[[end, y - 4.5], [end, y + 4.5]], line)?;
        }
        if self.mark == Mark::Dot { canvas.dot([at, y], 5.0, row.ink, row.filled) } else { Ok(()) }
    }
}

impl Figure for Rows<'_> {
    fn height(&self, layout: Layout) -> f64 {
        self.bottom(layout) + if self.title.is_empty() { 30.0 } else { 48.0 }
    }

    fn description(&self) -> String {
        let sentences = self.sections.iter().map(|section| {
            let rows: Vec<&str> = section.rows.iter().map(|row| row.sentence.as_str()).collect();
            let colon = if section.heading.is_empty() { "" } else { ": " };
            format!("{}{colon}{}", section.heading, rows.join("; "))
        });
        format!("{}. {}", self.what, sentences.collect::<Vec<_>>().join(". "))
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let (layout, width) = (canvas.layout, canvas.width());
        let (left, right) = if layout == Layout::Wide {
            (self.room[0], width - self.room[1])
        } else {
            // Ticks are centred below the ends of the axis.
            (24.0, width - 30.0)
        };
        let (top, bottom) = (8.0, self.bottom(layout));
        canvas.chart([left, top, right, bottom], (self.axis.range(), self.ticks), (bottom..top, None))?;
        if !self.title.is_empty() {
            let title = canvas.fit(SMALL, self.title, width - 8.0);
            let middle = f64::midpoint(left, right).max(canvas.measure(SMALL, &title) / 2.0 + 2.0);
            canvas.text([middle, bottom + 36.0], Anchor::Middle, SMALL, Ink::Soft, &title)?;
        }
        let x = |value: f64| left + self.axis.share(value) * (right - left);
        if self.zero {
            canvas.line(&[[x(0.0), top], [x(0.0), bottom]], stroke(Ink::Soft, 1.25))?;
        }
        let mut y = top;
        for section in &self.sections {
            if !section.heading.is_empty() {
                let heading = canvas.fit(HEADING, &section.heading, width - 4.0);
                let size = [canvas.measure(HEADING, &heading) + 4.0, 20.0];
                canvas.rect([0.0, y + 6.0], size, Ink::Surface.rgb().filled())?;
                canvas.text([0.0, y + 16.0], Anchor::Start, HEADING, Ink::Text, &heading)?;
                y += HEAD;
            }
            let [height, middle] = self.row(layout);
            if let Some(floor) = section.floor {
                let [low, at, high] = floor.map(x);
                let rows = section.rows.len() as f64 * height;
                canvas.rect([low, y], [high - low, rows], Ink::Floor.rgb().mix(0.15).filled())?;
                canvas.dashed(&[[at, y], [at, y + rows]], Ink::Floor, 1.5)?;
            }
            for row in &section.rows {
                self.words(canvas, row, [left, right, y])?;
                self.point(canvas, row, [left, right, y + middle])?;
                canvas.tip([0.0, y], [width, height], &row.sentence);
                y += height;
            }
        }
        Ok(())
    }
}
