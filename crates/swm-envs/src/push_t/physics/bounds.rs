//! Axis-aligned boxes.

use super::Vec2;
use bytemuck::{Pod, Zeroable};

/// An axis-aligned box.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Bounds {
    /// The least coordinates.
    pub low: Vec2,
    /// The greatest coordinates.
    pub high: Vec2,
}

impl Bounds {
    /// The box of no point.
    pub const NOTHING: Self =
        Self { low: Vec2::new(f64::INFINITY, f64::INFINITY), high: Vec2::new(f64::NEG_INFINITY, f64::NEG_INFINITY) };

    /// The box that also holds `p`.
    pub fn with(self, p: Vec2) -> Self {
        self.merged(Self { low: p, high: p })
    }

    /// The box with `by` more on every side.
    pub fn grown(self, by: f64) -> Self {
        let by = Vec2::new(by, by);
        Self { low: self.low - by, high: self.high + by }
    }

    /// The box of both.
    pub fn merged(self, other: Self) -> Self {
        Self {
            low: Vec2::new(self.low.x.min(other.low.x), self.low.y.min(other.low.y)),
            high: Vec2::new(self.high.x.max(other.high.x), self.high.y.max(other.high.y)),
        }
    }

    /// Whether the boxes touch.
    pub fn intersects(&self, other: &Self) -> bool {
        self.low.x <= other.high.x
            && other.low.x <= self.high.x
            && self.low.y <= other.high.y
            && other.low.y <= self.high.y
    }

    /// Whether `other` lies inside.
    pub fn contains(&self, other: &Self) -> bool {
        self.low.x <= other.low.x
            && self.high.x >= other.high.x
            && self.low.y <= other.low.y
            && self.high.y >= other.high.y
    }

    /// The middle.
    pub fn centre(&self) -> Vec2 {
        self.low.lerp(self.high, 0.5)
    }

    /// The area.
    pub fn area(&self) -> f64 {
        (self.high.x - self.low.x) * (self.high.y - self.low.y)
    }

    /// How far the middles are apart, in a norm that is cheap.
    pub fn proximity(&self, other: &Self) -> f64 {
        (self.low.x + self.high.x - other.low.x - other.high.x).abs()
            + (self.low.y + self.high.y - other.low.y - other.high.y).abs()
    }
}
