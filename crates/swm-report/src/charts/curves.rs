//! [`Curves`]: curves in a panel, which stands beside others on wide screens.

use super::axis::Axis;
use crate::plot::{Anchor, Canvas, Drawn as Painted, Figure, HEADING, Ink, Layout, SMALL, Surface, stroke};
use plotters::style::Color as _;
use std::collections::BTreeMap;

/// The width of a panel on wide screens, in pixels.
pub(super) const PANEL: f64 = 440.0;
/// The largest number of points of a curve that are drawn.
pub(super) const POINTS: usize = 300;
/// The largest number of curves of a panel.
pub(super) const CURVES: usize = 24;

/// How a curve is drawn.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Stroke {
    Solid,
    Dashed,
}

/// A curve, with a band around it if it has one.
pub(super) struct Curve {
    /// The name in the legend; empty for none.
    pub name: String,
    pub ink: Ink,
    pub stroke: Stroke,
    pub points: Vec<[f64; 2]>,
    /// The ends of the band at each of its points: `[x, low, high]`.
    pub band: Vec<[f64; 3]>,
}

/// Curves in a panel.
pub(super) struct Curves<'a> {
    pub heading: String,
    /// What stands at the other end of the heading's line.
    pub note: String,
    pub x: Axis,
    pub x_ticks: &'a dyn Fn(&f64) -> String,
    pub x_title: String,
    pub y: Axis,
    pub y_ticks: &'a dyn Fn(&f64) -> String,
    pub curves: Vec<Curve>,
    pub description: String,
}

/// The height of the heading.
const HEAD: f64 = 26.0;
/// The height of a line of the legend.
const ENTRY: f64 = 18.0;
/// The height of the data.
const DATA: f64 = 168.0;
/// The left edge of the data: the room for the ticks.
const LEFT: f64 = 52.0;

impl Curves<'_> {
    /// The names in the legend, each with its first curve.
    fn legend(&self) -> Vec<&Curve> {
        let mut first: BTreeMap<&str, usize> = BTreeMap::new();
        let curves = self
            .curves
            .iter()
            .enumerate()
            .filter(|(i, curve)| !curve.name.is_empty() && *first.entry(&curve.name).or_insert(*i) == *i);
        curves.map(|(_, curve)| curve).collect()
    }

    fn top(&self) -> f64 {
        HEAD + self.legend().len().div_ceil(2) as f64 * ENTRY + 8.0
    }

    /// Draws a curve and its band in an area `[left, top, right, bottom]`.
    fn curve<B: Surface>(&self, canvas: &Canvas<B>, curve: &Curve, area: [f64; 4]) -> Painted<B> {
        let [left, top, right, bottom] = area;
        let pixel =
            |x: f64, y: f64| [left + self.x.share(x) * (right - left), bottom - self.y.share(y) * (bottom - top)];
        if !curve.band.is_empty() {
            let upper = curve.band.iter().map(|[x, _, high]| pixel(*x, *high));
            let lower = curve.band.iter().rev().map(|[x, low, _]| pixel(*x, *low));
            canvas.polygon(&upper.chain(lower).collect::<Vec<_>>(), curve.ink.rgb().mix(0.16).filled())?;
        }
        let points: Vec<[f64; 2]> = curve.points.iter().map(|[x, y]| pixel(*x, *y)).collect();
        draw_line(canvas, &points, curve)
    }
}

fn draw_line<B: Surface>(canvas: &Canvas<B>, points: &[[f64; 2]], curve: &Curve) -> Painted<B> {
    match curve.stroke {
        Stroke::Solid => canvas.line(points, stroke(curve.ink, 2.0)),
        Stroke::Dashed => canvas.dashed(points, curve.ink, 1.75),
    }
}

impl Figure for Curves<'_> {
    fn width(&self, layout: Layout) -> f64 {
        layout.width().min(PANEL)
    }

    fn height(&self, _: Layout) -> f64 {
        self.top() + DATA + 48.0
    }

    fn description(&self) -> String {
        self.description.clone()
    }

    fn draw<B: Surface>(&self, canvas: &Canvas<B>) -> Painted<B> {
        let width = canvas.width();
        let note = canvas.fit(SMALL + 0.5, &self.note, width / 2.0);
        let room = width - canvas.measure(SMALL + 0.5, &note) - 16.0;
        let heading = canvas.fit(HEADING - 1.0, &self.heading, room);
        canvas.text([0.0, 12.0], Anchor::Start, HEADING - 1.0, Ink::Text, &heading)?;
        canvas.text([width - 2.0, 12.0], Anchor::End, SMALL + 0.5, Ink::Soft, &note)?;
        for (i, curve) in self.legend().into_iter().enumerate() {
            let at = [(i % 2) as f64 * width / 2.0, HEAD + ((i / 2) as f64 + 0.5) * ENTRY];
            draw_line(canvas, &[at, [at[0] + 24.0, at[1]]], curve)?;
            let name = canvas.fit(SMALL, &curve.name, width / 2.0 - 38.0);
            canvas.text([at[0] + 30.0, at[1]], Anchor::Start, SMALL, Ink::Text, &name)?;
        }
        let top = self.top();
        let (left, right, bottom) = (LEFT, width - 16.0, top + DATA);
        let area = [left, top, right, bottom];
        canvas.chart(area, (self.x.range(), self.x_ticks), (self.y.range(), Some(self.y_ticks)))?;
        let title = canvas.fit(SMALL, &self.x_title, right - left);
        canvas.text([f64::midpoint(left, right), bottom + 36.0], Anchor::Middle, SMALL, Ink::Soft, &title)?;
        for curve in &self.curves {
            self.curve(canvas, curve, area)?;
        }
        Ok(())
    }
}

/// Reduces points to at most [`POINTS`], each the mean of equally many neighbours.
pub(super) fn thin(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mean = |chunk: &[[f64; 2]]| [0, 1].map(|axis| chunk.iter().map(|p| p[axis] / chunk.len() as f64).sum());
    points.chunks(points.len().div_ceil(POINTS).max(1)).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_reduced_to_means() {
        let points: Vec<[f64; 2]> = (0..600).map(|i| [f64::from(i), f64::from(i * 2)]).collect();
        let thinned = thin(&points);
        assert_eq!((thinned.len(), thinned[0], thinned[299]), (300, [0.5, 1.0], [598.5, 1197.0]));
        assert_eq!(thin(&points[..10]), points[..10]);
    }
}
