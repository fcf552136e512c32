//! Shortest paths of the agent's centre through the maze, by a visibility graph.
//!
//! The centre keeps the agent's radius and a small margin from every wall, so it moves among rectangles with round
//! corners. Each round corner is replaced by a polygon around it; a shortest path is straight between the corners of
//! these polygons, which are the nodes of the graph.

use super::physics::{Layout, SIZE, Wall};
use crate::point_agent::{Position64, distance64};

/// Margin that a path keeps from walls beyond the agent's radius, in maze units. Half of the margin allows for rounding
/// errors.
const SPARE: f64 = 1e-3;
/// Corners of the polygon around a round corner.
const NODES_PER_CORNER: u8 = 3;

/// The nodes at which shortest paths turn, and the straight connections between them.
pub struct VisibilityGraph {
    layout: Layout,
    nodes: Vec<Position64>,
    /// Distances between nodes, `[nodes, nodes]`; infinite if a wall lies between the nodes.
    distances: Vec<f64>,
}

/// The shortest paths from every position to one position.
pub struct ShortestPaths {
    to: Position64,
    /// Path lengths from every node of the graph, `[nodes]`.
    lengths: Vec<f64>,
}

impl VisibilityGraph {
    /// Builds the graph of a layout.
    pub fn new(layout: &Layout) -> Self {
        let mut graph = Self { layout: *layout, nodes: vec![], distances: vec![] };
        let clear = f64::from(layout.radius) + SPARE;
        let step = std::f64::consts::FRAC_PI_2 / f64::from(NODES_PER_CORNER);
        // The polygon's sides touch the circle, so the polygon's corners lie outside the circle.
        let reach = clear / (step / 2.0).cos();
        for wall in layout.walls() {
            for (corner, [sx, sy]) in corners(wall) {
                for k in 0..NODES_PER_CORNER {
                    let (sin, cos) = ((f64::from(k) + 0.5) * step).sin_cos();
                    let node = [corner[0] + sx * reach * cos, corner[1] + sy * reach * sin];
                    if inside(node) && graph.clearance(node) >= clear - SPARE / 4.0 {
                        graph.nodes.push(node);
                    }
                }
            }
        }
        let n = graph.nodes.len();
        graph.distances = vec![f64::INFINITY; n * n];
        for i in 0..n {
            for j in 0..i {
                if let Some(length) = graph.straight(graph.nodes[i], graph.nodes[j]) {
                    graph.distances[i * n + j] = length;
                    graph.distances[j * n + i] = length;
                }
            }
        }
        graph
    }

    /// The layout the graph was built for.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// Returns the distance from a position to the nearest wall.
    fn clearance(&self, at: Position64) -> f64 {
        self.layout.walls().iter().map(|wall| point_to_wall(at, wall)).fold(f64::INFINITY, f64::min)
    }

    /// Returns the length of the straight path, or `None` if the path is blocked: if it comes nearer to a wall than the
    /// agent's radius, and nearer than both ends of the path.
    fn straight(&self, from: Position64, to: Position64) -> Option<f64> {
        let clear = f64::from(self.layout.radius) + SPARE / 2.0;
        let free = self.layout.walls().iter().all(|wall| {
            let ends = point_to_wall(from, wall).min(point_to_wall(to, wall));
            segment_to_wall(from, to, wall, clear) >= clear.min(ends) - 1e-9
        });
        free.then(|| distance64(from, to))
    }

    /// Finds the shortest paths from every position to one position (Dijkstra's algorithm).
    pub fn shortest_paths(&self, to: Position64) -> ShortestPaths {
        let n = self.nodes.len();
        let mut lengths: Vec<f64> =
            self.nodes.iter().map(|&node| self.straight(node, to).unwrap_or(f64::INFINITY)).collect();
        let mut open = vec![true; n];
        while let Some(i) = (0..n).filter(|&i| open[i]).min_by(|&i, &j| lengths[i].total_cmp(&lengths[j])) {
            open[i] = false;
            for j in 0..n {
                lengths[j] = lengths[j].min(lengths[i] + self.distances[i * n + j]);
            }
        }
        ShortestPaths { to, lengths }
    }

    /// Returns the next node (or the end) of the shortest path from a position, and the length of the whole path.
    /// Returns `None` if there is no path.
    pub fn next(&self, from: Position64, paths: &ShortestPaths) -> Option<(Position64, f64)> {
        if let Some(length) = self.straight(from, paths.to) {
            return Some((paths.to, length));
        }
        let mut best: Option<(Position64, f64)> = None;
        for (&node, &rest) in self.nodes.iter().zip(&paths.lengths) {
            // The length is compared first, because most nodes then need no test against the walls.
            let length = distance64(from, node) + rest;
            if best.is_none_or(|(_, shortest)| length < shortest) && self.straight(from, node).is_some() {
                best = Some((node, length));
            }
        }
        best.filter(|(_, length)| length.is_finite())
    }

    /// Returns a position near `goal` at which the agent fits or nearly fits, by moving `goal` away from the walls.
    pub fn nearest_free(&self, goal: Position64) -> Position64 {
        let clear = f64::from(self.layout.radius) + SPARE;
        let mut at = goal;
        for _ in 0..16 {
            for wall in self.layout.walls() {
                let nearest = nearest_in_wall(at, wall);
                let distance = distance64(at, nearest);
                if distance > 0.0 && distance < clear {
                    at = [0, 1].map(|i| nearest[i] + (at[i] - nearest[i]) * clear / distance);
                }
            }
            at = at.map(|v| v.clamp(0.0, f64::from(SIZE)));
        }
        at
    }
}

fn inside(at: Position64) -> bool {
    at.iter().all(|v| (0.0..=f64::from(SIZE)).contains(v))
}

/// The corners of a wall, each with the signs of its outward direction.
fn corners(wall: &Wall) -> [(Position64, [f64; 2]); 4] {
    let [[left, low], [right, high]] = [wall.low, wall.high].map(|p| p.map(f64::from));
    [([left, low], [-1.0, -1.0]), ([right, low], [1.0, -1.0]), ([left, high], [-1.0, 1.0]), ([right, high], [1.0, 1.0])]
}

/// Returns the point of a wall nearest to a position.
fn nearest_in_wall(at: Position64, wall: &Wall) -> Position64 {
    [0, 1].map(|i| at[i].clamp(f64::from(wall.low[i]), f64::from(wall.high[i])))
}

fn point_to_wall(at: Position64, wall: &Wall) -> f64 {
    distance64(at, nearest_in_wall(at, wall))
}

/// Returns the distance between a segment and a wall. If the distance exceeds `enough`, the result is a lower bound
/// that exceeds `enough` as well.
fn segment_to_wall(from: Position64, to: Position64, wall: &Wall, enough: f64) -> f64 {
    let (low, high) = (wall.low.map(f64::from), wall.high.map(f64::from));
    let gap = |i: usize| (from[i].min(to[i]) - high[i]).max(low[i] - from[i].max(to[i]));
    let gap = gap(0).max(gap(1));
    if gap > enough {
        return gap;
    }
    // The part of the segment, from 0 to 1, that lies within the wall.
    let (mut first, mut last) = (0.0_f64, 1.0_f64);
    for i in 0..2 {
        let along = to[i] - from[i];
        if along == 0.0 {
            if from[i] < low[i] || from[i] > high[i] {
                last = -1.0;
            }
        } else {
            let (a, b) = ((low[i] - from[i]) / along, (high[i] - from[i]) / along);
            (first, last) = (first.max(a.min(b)), last.min(a.max(b)));
        }
    }
    if first <= last {
        return 0.0;
    }
    let ends = point_to_wall(from, wall).min(point_to_wall(to, wall));
    corners(wall).iter().map(|&(corner, _)| point_to_segment(corner, from, to)).fold(ends, f64::min)
}

fn point_to_segment(at: Position64, from: Position64, to: Position64) -> f64 {
    let along = [to[0] - from[0], to[1] - from[1]];
    let square = along[0] * along[0] + along[1] * along[1];
    let part = (at[0] - from[0]) * along[0] + (at[1] - from[1]) * along[1];
    let part = if square > 0.0 { (part / square).clamp(0.0, 1.0) } else { 0.0 };
    distance64(at, [from[0] + part * along[0], from[1] + part * along[1]])
}
