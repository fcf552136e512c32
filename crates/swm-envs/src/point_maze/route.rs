//! Ways through the maze: shortest ones for the agent's centre, by a visibility graph.
//!
//! The centre keeps the agent's radius (and a hair) from every wall, so it moves among rectangles with round corners.
//! Each round corner is replaced by the corners of a polygon around it; a shortest way is straight but at those.

use super::physics::{Layout, SIZE, Wall};

/// A place in double precision.
pub type Place = [f64; 2];

/// By how much a way stays clear of walls beyond the agent's radius. Half of it is left to rounding.
const SPARE: f64 = 1e-3;
/// Corners of the polygon around a round corner.
const PER_CORNER: u8 = 3;

/// The places where shortest ways turn, and which of them see each other.
pub struct Map {
    layout: Layout,
    turns: Vec<Place>,
    /// The distance between two turns, row by row; infinite where a wall is between them.
    apart: Vec<f64>,
}

/// Shortest ways to one place.
pub struct Ways {
    to: Place,
    /// From every turn of the map.
    length: Vec<f64>,
}

impl Map {
    /// The map of a world.
    pub fn new(layout: &Layout) -> Self {
        let mut map = Self { layout: *layout, turns: vec![], apart: vec![] };
        let clear = f64::from(layout.radius) + SPARE;
        let step = std::f64::consts::FRAC_PI_2 / f64::from(PER_CORNER);
        // The polygon's sides touch the circle, so its corners lie a little farther out.
        let reach = clear / (step / 2.0).cos();
        for wall in layout.walls() {
            for (corner, [sx, sy]) in corners(wall) {
                for k in 0..PER_CORNER {
                    let (sin, cos) = ((f64::from(k) + 0.5) * step).sin_cos();
                    let turn = [corner[0] + sx * reach * cos, corner[1] + sy * reach * sin];
                    if inside(turn) && map.clearance(turn) >= clear - SPARE / 4.0 {
                        map.turns.push(turn);
                    }
                }
            }
        }
        let n = map.turns.len();
        map.apart = vec![f64::INFINITY; n * n];
        for i in 0..n {
            for j in 0..i {
                if let Some(length) = map.straight(map.turns[i], map.turns[j]) {
                    map.apart[i * n + j] = length;
                    map.apart[j * n + i] = length;
                }
            }
        }
        map
    }

    /// The world it is of.
    pub fn layout(&self) -> &Layout {
        &self.layout
    }

    /// How far a place is from the nearest wall.
    pub fn clearance(&self, place: Place) -> f64 {
        self.layout.walls().iter().map(|wall| point_to_wall(place, wall)).fold(f64::INFINITY, f64::min)
    }

    /// The length of a straight way, if it is free: no nearer to a wall than the agent may be, or than its ends are.
    fn straight(&self, from: Place, to: Place) -> Option<f64> {
        let clear = f64::from(self.layout.radius) + SPARE / 2.0;
        let free = self.layout.walls().iter().all(|wall| {
            let ends = point_to_wall(from, wall).min(point_to_wall(to, wall));
            segment_to_wall(from, to, wall, clear) >= clear.min(ends) - 1e-9
        });
        free.then(|| distance(from, to))
    }

    /// Shortest ways from everywhere to a place (Dijkstra's algorithm).
    pub fn ways(&self, to: Place) -> Ways {
        let n = self.turns.len();
        let mut length: Vec<f64> =
            self.turns.iter().map(|&turn| self.straight(turn, to).unwrap_or(f64::INFINITY)).collect();
        let mut open = vec![true; n];
        while let Some(i) = (0..n).filter(|&i| open[i]).min_by(|&i, &j| length[i].total_cmp(&length[j])) {
            open[i] = false;
            for j in 0..n {
                length[j] = length[j].min(length[i] + self.apart[i * n + j]);
            }
        }
        Ways { to, length }
    }

    /// The next turn on the shortest way, or its end, and the length of all of it; `None` where there is no way.
    pub fn next(&self, from: Place, ways: &Ways) -> Option<(Place, f64)> {
        if let Some(length) = self.straight(from, ways.to) {
            return Some((ways.to, length));
        }
        let mut best: Option<(Place, f64)> = None;
        for (&turn, &rest) in self.turns.iter().zip(&ways.length) {
            // A bound first: most turns need no look at the walls.
            let bound = distance(from, turn) + rest;
            if best.is_none_or(|(_, shortest)| bound < shortest) && self.straight(from, turn).is_some() {
                best = Some((turn, bound));
            }
        }
        best.filter(|(_, length)| length.is_finite())
    }

    /// The nearest place to `goal` where the agent fits, or nearly so: `goal` moved out of the walls' reach.
    pub fn stand(&self, goal: Place) -> Place {
        let clear = f64::from(self.layout.radius) + SPARE;
        let mut place = goal;
        for _ in 0..16 {
            for wall in self.layout.walls() {
                let nearest = nearest_of(place, wall);
                let apart = distance(place, nearest);
                if apart > 0.0 && apart < clear {
                    place = [0, 1].map(|i| nearest[i] + (place[i] - nearest[i]) * clear / apart);
                }
            }
            place = place.map(|v| v.clamp(0.0, f64::from(SIZE)));
        }
        place
    }
}

fn distance(a: Place, b: Place) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

fn inside(place: Place) -> bool {
    place.iter().all(|v| (0.0..=f64::from(SIZE)).contains(v))
}

/// The corners of a wall, and which way each points.
fn corners(wall: &Wall) -> [(Place, [f64; 2]); 4] {
    let [[left, low], [right, high]] = [wall.low, wall.high].map(|p| p.map(f64::from));
    [([left, low], [-1.0, -1.0]), ([right, low], [1.0, -1.0]), ([left, high], [-1.0, 1.0]), ([right, high], [1.0, 1.0])]
}

/// The place of a wall that is nearest to a place.
fn nearest_of(place: Place, wall: &Wall) -> Place {
    [0, 1].map(|i| place[i].clamp(f64::from(wall.low[i]), f64::from(wall.high[i])))
}

fn point_to_wall(place: Place, wall: &Wall) -> f64 {
    distance(place, nearest_of(place, wall))
}

/// The distance between a line and a wall; some number above `enough` where it is above that.
fn segment_to_wall(from: Place, to: Place, wall: &Wall, enough: f64) -> f64 {
    let (low, high) = (wall.low.map(f64::from), wall.high.map(f64::from));
    let beside = |i: usize| (from[i].min(to[i]) - high[i]).max(low[i] - from[i].max(to[i]));
    let beside = beside(0).max(beside(1));
    if beside > enough {
        return beside;
    }
    // The part of the line, from 0 to 1, between the wall's sides.
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

fn point_to_segment(place: Place, from: Place, to: Place) -> f64 {
    let along = [to[0] - from[0], to[1] - from[1]];
    let square = along[0] * along[0] + along[1] * along[1];
    let part = (place[0] - from[0]) * along[0] + (place[1] - from[1]) * along[1];
    let part = if square > 0.0 { (part / square).clamp(0.0, 1.0) } else { 0.0 };
    distance(place, [from[0] + part * along[0], from[1] + part * along[1]])
}
