//! Where the agent can be: a point among obstacles.
//!
//! With its angle held, an agent touches a convex part of the block exactly when its origin is on the edge of the
//! Minkowski difference of the two. So all questions of what fits where become questions about points and convex
//! polygons, whatever the shapes are.

use crate::push_t::TABLE;
use crate::push_t::physics::Vec2;

/// Pixels from the edge of the table to where agents stay, walls included.
const MARGIN: f64 = 9.0;

/// A convex polygon, its corners in the order from x towards y.
pub struct Convex {
    corners: Vec<Vec2>,
    /// The outward normal of the edge that begins at each corner.
    normals: Vec<Vec2>,
}

impl Convex {
    fn new(corners: Vec<Vec2>) -> Self {
        let next = corners.iter().cycle().skip(1);
        let normals = corners.iter().zip(next).map(|(&a, &b)| (b - a).rperp().normalized()).collect();
        Self { corners, normals }
    }

    /// The places of an agent's origin at which it overlaps a part of the block.
    fn difference(part: &[Vec2], agent: &[Vec2]) -> Self {
        let mirrored: Vec<Vec2> = agent.iter().map(|&corner| -corner).collect();
        let (p, q) = (from_lowest(part), from_lowest(&mirrored));
        // The edges of a sum are the edges of both, sorted by direction.
        let (mut i, mut j) = (0, 0);
        let mut corners = vec![];
        while i < part.len() || j < agent.len() {
            corners.push(p(i) + q(j));
            let turn = (p(i + 1) - p(i)).cross(q(j + 1) - q(j));
            let (first, second) = (i < part.len(), j < agent.len());
            let (take_p, take_q) = (first && (!second || turn >= 0.0), second && (!first || turn <= 0.0));
            (i, j) = (i + usize::from(take_p), j + usize::from(take_q));
        }
        Self::new(corners)
    }

    /// How far a place is outside of the edge it is most outside of; negative inside.
    pub fn clearance(&self, place: Vec2) -> f64 {
        let edges = self.corners.iter().zip(&self.normals);
        edges.map(|(&corner, normal)| normal.dot(place - corner)).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Whether a line passes through the polygon grown by `margin`.
    pub fn blocks(&self, from: Vec2, to: Vec2, margin: f64) -> bool {
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for (&corner, normal) in self.corners.iter().zip(&self.normals) {
            let [a, b] = [from, to].map(|end| normal.dot(end - corner) - margin);
            if a >= 0.0 && b >= 0.0 {
                return false;
            }
            if a >= 0.0 {
                enter = enter.max(a / (a - b));
            } else if b >= 0.0 {
                leave = leave.min(a / (a - b));
            }
        }
        enter < leave
    }

    /// Places beside the corners, `margin` from both edges.
    pub fn around(&self, margin: f64) -> impl Iterator<Item = Vec2> {
        let last = self.normals.iter().cycle().skip(self.normals.len() - 1);
        self.corners
            .iter()
            .zip(&self.normals)
            .zip(last)
            .map(move |((&corner, &after), &before)| corner + (before + after) * (margin / (1.0 + before.dot(after))))
    }
}

/// The corners of a convex polygon in their order, from the one farthest up (then left) and over again.
fn from_lowest(corners: &[Vec2]) -> impl Fn(usize) -> Vec2 {
    let key = |&i: &usize| (corners[i].y, corners[i].x);
    let first = (0..corners.len()).min_by(|a, b| key(a).partial_cmp(&key(b)).unwrap_or(std::cmp::Ordering::Equal));
    move |i| corners[(first.unwrap_or(0) + i) % corners.len()]
}

/// The table with the block on it, for an agent that keeps its angle.
pub struct Room {
    low: Vec2,
    high: Vec2,
    /// Where the agent's origin cannot be because of the block.
    pub obstacles: Vec<Convex>,
}

impl Room {
    /// A room for an agent of these convex parts, its origin at 0, beside a block of these parts.
    pub fn new(agent: &[Vec<Vec2>], block: &[[Vec2; 4]]) -> Self {
        let (mut low, mut high) = (Vec2::ZERO, Vec2::ZERO);
        for corner in agent.iter().flatten() {
            low = Vec2::new(low.x.min(corner.x), low.y.min(corner.y));
            high = Vec2::new(high.x.max(corner.x), high.y.max(corner.y));
        }
        let inset = Vec2::new(MARGIN, MARGIN);
        let obstacles = block.iter().flat_map(|part| agent.iter().map(|agent| Convex::difference(part, agent)));
        Self { low: inset - low, high: Vec2::new(TABLE, TABLE) - inset - high, obstacles: obstacles.collect() }
    }

    /// How far from touching the block an agent at a place is; negative when it overlaps it.
    pub fn clearance(&self, place: Vec2) -> f64 {
        self.obstacles.iter().map(|obstacle| obstacle.clearance(place)).fold(f64::INFINITY, f64::min)
    }

    /// Whether an agent at a place is between the walls.
    pub fn holds(&self, place: Vec2) -> bool {
        (self.low.x..=self.high.x).contains(&place.x) && (self.low.y..=self.high.y).contains(&place.y)
    }

    /// Places `gap` from touching the block, about `spacing` apart, with the direction into it.
    pub fn beside(&self, gap: f64, spacing: f64) -> Vec<(Vec2, Vec2)> {
        let mut places = vec![];
        for Convex { corners, normals } in &self.obstacles {
            for (i, &normal) in normals.iter().enumerate() {
                let (a, b) = (corners[i], corners[(i + 1) % corners.len()]);
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let count = ((b - a).length() / spacing).round().max(1.0) as usize;
                for k in 0..count {
                    #[allow(clippy::cast_precision_loss)]
                    let place = a.lerp(b, (k as f64 + 0.5) / count as f64) + normal * gap;
                    if self.holds(place) && self.clearance(place) > 0.9 * gap {
                        places.push((place, -normal));
                    }
                }
            }
        }
        places
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rect(left: f64, top: f64, right: f64, bottom: f64) -> [Vec2; 4] {
        [(left, top), (right, top), (right, bottom), (left, bottom)].map(|(x, y)| Vec2::new(x, y))
    }

    #[test]
    fn an_agent_touches_where_the_difference_ends() {
        // The agent reaches 10 to the left and up, 20 to the right and down.
        let room = Room::new(&[rect(-10.0, -10.0, 20.0, 20.0).to_vec()], &[rect(200.0, 200.0, 300.0, 250.0)]);
        for (x, y, wanted) in [(170.0, 225.0, 10.0), (320.0, 225.0, 10.0), (250.0, 175.0, 5.0), (250.0, 225.0, -35.0)] {
            assert!((room.clearance(Vec2::new(x, y)) - wanted).abs() < 1e-9, "at {x} {y}");
        }
        assert!(room.holds(Vec2::new(MARGIN + 10.0, TABLE - MARGIN - 20.0)));
        assert!(!room.holds(Vec2::new(MARGIN + 9.0, 100.0)));
        for (place, inward) in room.beside(4.0, 20.0) {
            assert!((room.clearance(place) - 4.0).abs() < 1e-9);
            assert!(room.clearance(place + inward * 5.0) < 0.0);
        }
    }
}
