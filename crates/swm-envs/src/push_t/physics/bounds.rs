//! Axis-aligned bounding boxes.

use super::vec2::Vec2;
use bytemuck::{Pod, Zeroable};

/// An axis-aligned bounding box, in pixels of the table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Bounds {
    /// The least coordinates.
    pub low: Vec2,
    /// The greatest coordinates.
    pub high: Vec2,
}

impl Bounds {
    /// The empty box.
    pub const EMPTY: Self =
        Self { low: Vec2::new(f64::INFINITY, f64::INFINITY), high: Vec2::new(f64::NEG_INFINITY, f64::NEG_INFINITY) };

    /// Returns the smallest box that also contains `p`.
    pub fn with(self, p: Vec2) -> Self {
        self.merged(Self { low: p, high: p })
    }

    /// Returns the box enlarged by `by` pixels on every side.
    pub fn grown(self, by: f64) -> Self {
        let by = Vec2::new(by, by);
        Self { low: self.low - by, high: self.high + by }
    }

    /// Returns the smallest box that contains both boxes.
    pub fn merged(self, other: Self) -> Self {
        Self {
            low: Vec2::new(self.low.x.min(other.low.x), self.low.y.min(other.low.y)),
            high: Vec2::new(self.high.x.max(other.high.x), self.high.y.max(other.high.y)),
        }
    }

    /// Returns whether the boxes touch.
    pub fn intersects(&self, other: &Self) -> bool {
        self.low.x <= other.high.x
            && other.low.x <= self.high.x
            && self.low.y <= other.high.y
            && other.low.y <= self.high.y
    }

    /// Returns whether `other` lies inside this box.
    pub fn contains(&self, other: &Self) -> bool {
        self.low.x <= other.low.x
            && self.high.x >= other.high.x
            && self.low.y <= other.low.y
            && self.high.y >= other.high.y
    }

    /// The centre of the box.
    pub fn centre(&self) -> Vec2 {
        self.low.lerp(self.high, 0.5)
    }

    /// The area of the box, in pixels².
    pub fn area(&self) -> f64 {
        (self.high.x - self.low.x) * (self.high.y - self.low.y)
    }

    /// Returns twice the Manhattan distance between the centres of two boxes.
    pub fn proximity(&self, other: &Self) -> f64 {
        (self.low.x + self.high.x - other.low.x - other.high.x).abs()
            + (self.low.y + self.high.y - other.low.y - other.high.y).abs()
    }
}
