//! SVG primitives and scales, which all charts use.

use crate::text::{escape, number};
use std::fmt::Write as _;

/// The width of charts that fill the page, in pixels.
pub(crate) const WIDE: f64 = 920.0;
/// The width of charts that are arranged in pairs, in pixels.
pub(crate) const HALF: f64 = 440.0;
/// The left edge of the plot area in charts with labelled rows, in pixels.
pub(crate) const LABELS: f64 = 200.0;
/// The number of characters that fit into a row label.
pub(crate) const NAME: usize = 23;
/// The height of a labelled row, in pixels.
pub(crate) const ROW: f64 = 30.0;

/// A linear scale that maps the values `low..=high` to the pixels `from..=to`.
#[derive(Clone, Copy)]
pub(crate) struct Scale {
    pub low: f64,
    pub high: f64,
    pub from: f64,
    pub to: f64,
}

impl Scale {
    /// A scale over `low..=high`, widened to round numbers, with its ticks.
    pub(crate) fn nice(low: f64, high: f64, from: f64, to: f64, ticks: usize) -> (Self, Vec<f64>) {
        let span = if high > low { high - low } else { high.abs().max(1.0) };
        let rough = span / ticks.max(1) as f64;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough * 0.999).unwrap_or(rough);
        let (first, last) = ((low / step).floor(), ((low + span) / step - 1e-9).ceil());
        let ticks = (first as i64..=last as i64).map(|i| i as f64 * step).collect();
        (Self { low: first * step, high: last * step, from, to }, ticks)
    }

    /// Returns the pixel of a value.
    pub(crate) fn at(self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }
}

/// A builder of an SVG image.
pub(crate) struct Svg {
    body: String,
    width: f64,
    height: f64,
}

impl Svg {
    pub(crate) fn new(width: f64, height: f64) -> Self {
        Self { body: String::new(), width, height }
    }

    /// Adds a line of a CSS class between two points.
    pub(crate) fn line(&mut self, class: &str, [x1, y1]: [f64; 2], [x2, y2]: [f64; 2]) {
        let _ = writeln!(self.body, r#"<line class="{class}" x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}"/>"#);
    }

    /// Adds a rectangle with a top left corner, a size and a tooltip.
    pub(crate) fn rect(&mut self, class: &str, [x, y]: [f64; 2], [width, height]: [f64; 2], tip: &str) {
        let _ = writeln!(
            self.body,
            r#"<rect class="{class}" x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}"{}"#,
            closing("rect", tip)
        );
    }

    /// Adds a filled circle with a tooltip.
    pub(crate) fn dot(&mut self, class: &str, [x, y]: [f64; 2], radius: f64, tip: &str) {
        let _ = writeln!(
            self.body,
            r#"<circle class="{class}" cx="{x:.1}" cy="{y:.1}" r="{radius:.1}"{}"#,
            closing("circle", tip)
        );
    }

    /// Adds a line through points.
    pub(crate) fn path(&mut self, class: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        self.outline("polyline", class, points);
    }

    fn outline(&mut self, element: &str, class: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        let _ = write!(self.body, r#"<{element} class="{class}" points=""#);
        for (i, [x, y]) in points.into_iter().enumerate() {
            let _ = write!(self.body, "{}{x:.1},{y:.1}", if i == 0 { "" } else { " " });
        }
        self.body.push_str("\"/>\n");
    }

    /// Adds a filled polygon.
    pub(crate) fn area(&mut self, class: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        self.outline("polygon", class, points);
    }

    /// Adds a text; `class` defines its anchor and colour.
    pub(crate) fn text(&mut self, class: &str, [x, y]: [f64; 2], words: &str) {
        let _ = writeln!(self.body, r#"<text class="{class}" x="{x:.1}" y="{y:.1}">{}</text>"#, escape(words));
    }

    /// Adds vertical grid lines with tick labels below them.
    pub(crate) fn x_axis(&mut self, scale: Scale, ticks: &[f64], [top, bottom]: [f64; 2], unit: &str) {
        for &tick in ticks {
            let x = scale.at(tick);
            self.line("grid", [x, top], [x, bottom]);
            self.text("tick middle", [x, bottom + 16.0], &format!("{}{unit}", number(tick)));
        }
    }

    /// Adds horizontal grid lines with tick labels to their left.
    pub(crate) fn y_axis(&mut self, scale: Scale, ticks: &[f64], [left, right]: [f64; 2], unit: &str) {
        for &tick in ticks {
            let y = scale.at(tick);
            self.line("grid", [left, y], [right, y]);
            self.text("tick end", [left - 6.0, y + 4.0], &format!("{}{unit}", number(tick)));
        }
    }

    /// Returns the SVG element; `description` is the text for screen readers.
    pub(crate) fn finish(self, description: &str) -> String {
        format!(
            "<svg role=\"img\" aria-label=\"{}\" viewBox=\"0 0 {:.0} {:.0}\" style=\"max-width:{:.0}px\" \
             xmlns=\"http://www.w3.org/2000/svg\">\n{}</svg>\n",
            escape(description),
            self.width,
            self.height,
            self.width,
            self.body
        )
    }
}

/// The end of an element, with a tooltip if `tip` is not empty.
fn closing(element: &str, tip: &str) -> String {
    if tip.is_empty() { "/>".to_owned() } else { format!("><title>{}</title></{element}>", escape(tip)) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_cover_the_data() {
        for (low, high) in [(0.0, 47.0), (0.0, 1.0), (0.0, 0.0), (-3.2, 8.9), (0.0013, 0.0017), (5.0, 5.0), (0.0, 50.0)]
        {
            let (scale, ticks) = Scale::nice(low, high, 0.0, 100.0, 5);
            assert!(scale.low <= low && scale.high >= high && scale.low < scale.high, "{low} {high}");
            assert!((2..=8).contains(&ticks.len()), "{ticks:?}");
            assert_eq!((scale.at(scale.low), scale.at(scale.high)), (0.0, 100.0));
        }
        assert_eq!(Scale::nice(0.0, 50.0, 0.0, 1.0, 5).1, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]);
    }
}
