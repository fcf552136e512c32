//! [`ConfigurationSpace`]: the positions of the agent at which it overlaps neither the block nor the walls.
//!
//! An agent with a fixed angle touches a convex part of the block exactly when its origin is on the edge of the
//! Minkowski difference of part and agent. So the agent is treated as a point among convex polygons.

use crate::push_t::TABLE;
use crate::push_t::physics::Vec2;

/// Distance that agents keep from the edge of the table, which includes the walls, in pixels.
const MARGIN: f64 = 9.0;

/// A convex obstacle for the agent's origin; its corners are ordered from x towards y.
pub struct Obstacle {
    corners: Vec<Vec2>,
    /// The outward normal of the edge that begins at each corner.
    normals: Vec<Vec2>,
}

impl Obstacle {
    fn new(corners: Vec<Vec2>) -> Self {
        let next = corners.iter().cycle().skip(1);
        let normals = corners.iter().zip(next).map(|(&a, &b)| (b - a).rperp().normalized()).collect();
        Self { corners, normals }
    }

    /// Returns the positions of the agent's origin at which a part of the agent overlaps a part of the block.
    fn minkowski_difference(part: &[Vec2], agent: &[Vec2]) -> Self {
        let mirrored: Vec<Vec2> = agent.iter().map(|&corner| -corner).collect();
        let (p, q) = (from_lowest(part), from_lowest(&mirrored));
        // The edges of a Minkowski sum are the edges of both polygons, sorted by direction.
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

    /// Returns the greatest signed distance of a point from the lines of the edges, in pixels; negative inside.
    pub fn clearance(&self, at: Vec2) -> f64 {
        let edges = self.corners.iter().zip(&self.normals);
        edges.map(|(&corner, normal)| normal.dot(at - corner)).fold(f64::NEG_INFINITY, f64::max)
    }

    /// Returns whether a segment passes through the polygon enlarged by `margin` pixels.
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

    /// Returns a point outside each corner, `margin` pixels from both edges of the corner.
    pub fn around(&self, margin: f64) -> impl Iterator<Item = Vec2> {
        let last = self.normals.iter().cycle().skip(self.normals.len() - 1);
        self.corners
            .iter()
            .zip(&self.normals)
            .zip(last)
            .map(move |((&corner, &after), &before)| corner + (before + after) * (margin / (1.0 + before.dot(after))))
    }
}

/// Returns the corners of a convex polygon by index, cyclically, from the corner of least y (then least x).
fn from_lowest(corners: &[Vec2]) -> impl Fn(usize) -> Vec2 {
    let key = |&i: &usize| (corners[i].y, corners[i].x);
    let first = (0..corners.len()).min_by(|a, b| key(a).partial_cmp(&key(b)).unwrap_or(std::cmp::Ordering::Equal));
    move |i| corners[(first.unwrap_or(0) + i) % corners.len()]
}

/// The free positions of an agent with a fixed angle, on the table with the block.
pub struct ConfigurationSpace {
    low: Vec2,
    high: Vec2,
    /// The obstacles for the agent's origin: one for each pair of a part of the block and a part of the agent.
    pub obstacles: Vec<Obstacle>,
}

impl ConfigurationSpace {
    /// Makes the space of an agent of these convex parts, relative to the agent's origin, and of a block of these
    /// parts, in table coordinates.
    pub fn new(agent: &[Vec<Vec2>], block: &[[Vec2; 4]]) -> Self {
        let (mut low, mut high) = (Vec2::ZERO, Vec2::ZERO);
        for corner in agent.iter().flatten() {
            low = Vec2::new(low.x.min(corner.x), low.y.min(corner.y));
            high = Vec2::new(high.x.max(corner.x), high.y.max(corner.y));
        }
        let inset = Vec2::new(MARGIN, MARGIN);
        let obstacles =
            block.iter().flat_map(|part| agent.iter().map(|agent| Obstacle::minkowski_difference(part, agent)));
        Self { low: inset - low, high: Vec2::new(TABLE, TABLE) - inset - high, obstacles: obstacles.collect() }
    }

    /// Returns the gap between the block and an agent at a point, in pixels; negative if they overlap.
    pub fn clearance(&self, at: Vec2) -> f64 {
        self.obstacles.iter().map(|obstacle| obstacle.clearance(at)).fold(f64::INFINITY, f64::min)
    }

    /// Returns whether an agent at a point is between the walls.
    pub fn contains(&self, at: Vec2) -> bool {
        (self.low.x..=self.high.x).contains(&at.x) && (self.low.y..=self.high.y).contains(&at.y)
    }

    /// Returns positions of the agent with a gap of `gap` pixels to the block and about `spacing` pixels apart, each
    /// with the direction into the block.
    pub fn contact_points(&self, gap: f64, spacing: f64) -> Vec<(Vec2, Vec2)> {
        let mut points = vec![];
        for Obstacle { corners, normals } in &self.obstacles {
            for (i, &normal) in normals.iter().enumerate() {
                let (a, b) = (corners[i], corners[(i + 1) % corners.len()]);
                let count = ((b - a).length() / spacing).round().max(1.0) as usize;
                for k in 0..count {
                    let at = a.lerp(b, (k as f64 + 0.5) / count as f64) + normal * gap;
                    if self.contains(at) && self.clearance(at) > 0.9 * gap {
                        points.push((at, -normal));
                    }
                }
            }
        }
        points
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rect(left: f64, top: f64, right: f64, bottom: f64) -> [Vec2; 4] {
        [(left, top), (right, top), (right, bottom), (left, bottom)].map(|(x, y)| Vec2::new(x, y))
    }

    #[test]
    fn clearance_is_the_distance_to_the_minkowski_difference() {
        // The agent extends 10 pixels to the left and up, 20 to the right and down.
        let space =
            ConfigurationSpace::new(&[rect(-10.0, -10.0, 20.0, 20.0).to_vec()], &[rect(200.0, 200.0, 300.0, 250.0)]);
        for (x, y, expected) in [(170.0, 225.0, 10.0), (320.0, 225.0, 10.0), (250.0, 175.0, 5.0), (250.0, 225.0, -35.0)]
        {
            assert!((space.clearance(Vec2::new(x, y)) - expected).abs() < 1e-9, "at {x} {y}");
        }
        assert!(space.contains(Vec2::new(MARGIN + 10.0, TABLE - MARGIN - 20.0)));
        assert!(!space.contains(Vec2::new(MARGIN + 9.0, 100.0)));
        for (at, inward) in space.contact_points(4.0, 20.0) {
            assert!((space.clearance(at) - 4.0).abs() < 1e-9);
            assert!(space.clearance(at + inward * 5.0) < 0.0);
        }
    }
}
