//! SVG primitives and scales, which all charts use.

use crate::limits;
use crate::text::{escape, number, shorten};
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

/// The largest number of ticks of an axis.
const MAX_TICKS: usize = 100;
/// The longest description of a chart, in characters.
const DESCRIPTION: usize = 10_000;

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
        // Values from files may be of any magnitude; a span beyond these bounds would overflow, or give a step of zero.
        let [low, high] = [low, high].map(|value| if value.is_nan() { 0.0 } else { value.clamp(-1e300, 1e300) });
        let span = if high - low > 1e-290 { high - low } else { high.abs().max(1.0) };
        let rough = span / ticks.max(1) as f64;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].map(|m| m * power).into_iter().find(|s| *s >= rough * 0.999).unwrap_or(rough);
        let (first, last) = ((low / step).floor(), ((low + span) / step - 1e-9).ceil());
        let ticks = (first as i64..=last as i64).take(MAX_TICKS).map(|i| i as f64 * step).collect();
        (Self { low: first * step, high: last * step, from, to }, ticks)
    }

    /// Returns the pixel of a value.
    pub(crate) fn at(self, value: f64) -> f64 {
        self.from + (value - self.low) / (self.high - self.low) * (self.to - self.from)
    }
}

/// A builder of an SVG image. Elements beyond [`limits::CHART_BYTES`] are left out, and the image is cut off there.
pub(crate) struct Svg {
    body: String,
    width: f64,
    height: f64,
    /// The lowest point of the elements, in pixels.
    bottom: f64,
    /// Whether elements were left out.
    cut: bool,
}

impl Svg {
    pub(crate) fn new(width: f64, height: f64) -> Self {
        Self { body: String::new(), width, height, bottom: 0.0, cut: false }
    }

    /// Returns whether the image has room for an element that reaches down to `y`.
    fn has_room(&mut self, y: f64) -> bool {
        self.cut |= self.body.len() > limits::CHART_BYTES;
        if !self.cut {
            self.bottom = self.bottom.max(y);
        }
        !self.cut
    }

    /// Adds a line of a CSS class between two points.
    pub(crate) fn line(&mut self, class: &str, from: [f64; 2], to: [f64; 2]) {
        let ([x1, y1], [x2, y2]) = (from.map(pixel), to.map(pixel));
        if !self.has_room(y1.max(y2)) {
            return;
        }
        let _ = writeln!(self.body, r#"<line class="{class}" x1="{x1:.1}" y1="{y1:.1}" x2="{x2:.1}" y2="{y2:.1}"/>"#);
    }

    /// Adds a rectangle with a top left corner, a size and a tooltip.
    pub(crate) fn rect(&mut self, class: &str, corner: [f64; 2], size: [f64; 2], tip: &str) {
        let ([x, y], [width, height]) = (corner.map(pixel), size.map(|length| pixel(length).max(0.0)));
        if !self.has_room(y + height) {
            return;
        }
        let _ = writeln!(
            self.body,
            r#"<rect class="{class}" x="{x:.1}" y="{y:.1}" width="{width:.1}" height="{height:.1}"{}"#,
            closing("rect", tip)
        );
    }

    /// Adds a filled circle with a tooltip.
    pub(crate) fn dot(&mut self, class: &str, centre: [f64; 2], radius: f64, tip: &str) {
        let [x, y] = centre.map(pixel);
        if !self.has_room(y + radius) {
            return;
        }
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
        if !self.has_room(0.0) {
            return;
        }
        let _ = write!(self.body, r#"<{element} class="{class}" points=""#);
        for (i, point) in points.into_iter().enumerate() {
            let [x, y] = point.map(pixel);
            if !self.has_room(y) {
                break;
            }
            let _ = write!(self.body, "{}{x:.1},{y:.1}", if i == 0 { "" } else { " " });
        }
        self.body.push_str("\"/>\n");
    }

    /// Adds a filled polygon.
    pub(crate) fn area(&mut self, class: &str, points: impl IntoIterator<Item = [f64; 2]>) {
        self.outline("polygon", class, points);
    }

    /// Adds a text; `class` defines its anchor and colour.
    pub(crate) fn text(&mut self, class: &str, start: [f64; 2], words: &str) {
        let [x, y] = start.map(pixel);
        if !self.has_room(y) {
            return;
        }
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
        let height = if self.cut { self.height.min(self.bottom + 20.0) } else { self.height };
        let note =
            if self.cut { "<p class=\"note\">The chart is cut off here, because it is too large.</p>\n" } else { "" };
        format!(
            "<svg role=\"img\" aria-label=\"{}\" viewBox=\"0 0 {:.0} {:.0}\" style=\"max-width:{:.0}px\" \
             xmlns=\"http://www.w3.org/2000/svg\">\n{}</svg>\n{note}",
            escape(&shorten(description, DESCRIPTION)),
            self.width,
            height,
            self.width,
            self.body
        )
    }
}

/// A coordinate in pixels that a browser can draw; values from files may be infinite or far outside the image.
fn pixel(value: f64) -> f64 {
    if value.is_finite() { value.clamp(-1e7, 1e7) } else { 0.0 }
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
        for (low, high) in [(-5e-324, 5e-324), (f64::MIN, f64::MAX), (f64::NAN, f64::INFINITY), (1e16, 1e16 + 2.0)] {
            let (scale, ticks) = Scale::nice(low, high, 0.0, 100.0, 5);
            assert!(scale.at(0.0).is_finite() && ticks.len() <= MAX_TICKS, "{low} {high}: {ticks:?}");
        }
        assert_eq!(Scale::nice(0.0, 50.0, 0.0, 1.0, 5).1, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]);
    }
}
