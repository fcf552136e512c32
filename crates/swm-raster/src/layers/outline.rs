//! [`Outline`]: the leftmost and rightmost x of a geom's bounding box in each row.

use crate::scene::Geom;
use crate::vector::{V3, add, rotate};
use crate::view::View;
use std::ops::Range;
use swm_simd::vectorize;

/// Number of edges of a box.
const EDGES: usize = 12;

/// The outline of a geom's bounding box on the screen.
pub(super) struct Outline {
    /// The edges, or `None` if a corner is behind the camera.
    edges: Option<Edges>,
}

/// Edges on the screen, in pixels.
#[derive(Default)]
struct Edges {
    left: [f32; EDGES],
    right: [f32; EDGES],
    top: [f32; EDGES],
    bottom: [f32; EDGES],
    /// The x of one end of each edge.
    x: [f32; EDGES],
    /// The y of the same end.
    y: [f32; EDGES],
    /// The change of x per row along each edge.
    slope: [f32; EDGES],
}

impl Outline {
    /// Projects a bounding box with these half sides.
    pub fn new(geom: &Geom, halves: V3, view: &View) -> Self {
        let mut corners = [[0.0; 2]; 8];
        for (index, corner) in corners.iter_mut().enumerate() {
            let local = std::array::from_fn(|k| if index >> k & 1 == 1 { halves[k] } else { -halves[k] });
            let ([x, y, w], depth) = view.project(add(geom.position, rotate(&geom.rotation, local)));
            if !(depth > view.near && x.is_finite() && y.is_finite()) {
                return Self { edges: None };
            }
            *corner = [x / w, y / w];
        }
        let mut edges = Edges::default();
        let ends = (0..8).flat_map(|a| [a | 1, a | 2, a | 4].map(|b| (a, b))).filter(|(a, b)| a != b);
        for (i, (a, b)) in ends.enumerate() {
            let ([ax, ay], [bx, by]) = (corners[a], corners[b]);
            (edges.left[i], edges.right[i], edges.x[i]) = (ax.min(bx), ax.max(bx), ax);
            (edges.top[i], edges.bottom[i], edges.y[i]) = (ay.min(by), ay.max(by), ay);
            edges.slope[i] = if by == ay { 1e30 } else { (bx - ax) / (by - ay) };
        }
        Self { edges: Some(edges) }
    }

    /// Writes the leftmost and rightmost x of the outline for each row.
    pub fn reach(&self, rows: Range<usize>, lows: &mut Vec<f32>, highs: &mut Vec<f32>) {
        lows.clear();
        highs.clear();
        match &self.edges {
            Some(edges) => {
                lows.resize(rows.len(), f32::INFINITY);
                highs.resize(rows.len(), f32::NEG_INFINITY);
                widen(edges, rows.start, lows, highs);
            }
            None => {
                lows.resize(rows.len(), f32::NEG_INFINITY);
                highs.resize(rows.len(), f32::INFINITY);
            }
        }
    }
}

vectorize! {
    /// Widens the extents of rows, which begin at row `top`, by the edges.
    fn widen(edges: &Edges, top: usize, lows: &mut [f32], highs: &mut [f32]) {
        let n = lows.len();
        let highs = &mut highs[..n];
        for k in 0..EDGES {
            let (x, y, slope) = (edges.x[k], edges.y[k], edges.slope[k]);
            let (left, right, upper, lower) = (edges.left[k], edges.right[k], edges.top[k], edges.bottom[k]);
            let at = |row: f32| {
                let x = x + (row - y) * slope;
                let x = if x > left { x } else { left };
                if x < right { x } else { right }
            };
            for i in 0..n {
                // The x range of the edge within the row.
                let above = top as f32 + i as u32 as i32 as f32;
                let (p, q) = (at(above), at(above + 1.0));
                let (low, high) = if p < q { (p, q) } else { (q, p) };
                let touched = (upper <= above + 1.0) & (lower >= above);
                lows[i] = if touched & (low < lows[i]) { low } else { lows[i] };
                highs[i] = if touched & (high > highs[i]) { high } else { highs[i] };
            }
        }
    }
}
