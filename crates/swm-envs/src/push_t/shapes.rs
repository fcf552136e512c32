//! The shapes of the agent and the block: a circle, or a union of rectangles.
//!
//! Dimensions, centres of gravity and moments of inertia are those of the reference (`env.py`). As in the reference,
//! the centre of gravity is the unweighted mean of the rectangles' centres, and some shapes count the moment of their
//! first rectangle several times.

use super::physics::{Body, Shape, Vec2};
use std::f64::consts::{PI, TAU};

/// The radius of a circle of scale 1, in pixels.
const CIRCLE_RADIUS: f32 = 0.375;

/// A rectangle `[left, top, right, bottom]`, in body coordinates.
type Rect = [f32; 4];

/// The shape of a body. Lengths are in pixels, coordinates relative to the body's origin.
#[derive(Clone, Debug)]
pub struct BodyShape {
    /// The corners of the rectangles; empty for a circle.
    pub rects: Vec<[Vec2; 4]>,
    /// The radius of a circle.
    pub radius: f64,
    /// The centre of gravity.
    pub cog: Vec2,
    /// The moment of inertia at mass 1, in pixels².
    inertia: f64,
}

impl BodyShape {
    /// Makes the shape of an index (0 circle, 1 L, 2 T, 3 Z, 4 square, 5 I, 6 small T, 7 +) at a scale in pixels.
    ///
    /// Corners are computed in single precision, because scales are sampled in single precision.
    pub fn new(shape: i64, scale: f64) -> Self {
        let s = scale as f32;
        match shape {
            0 => Self { rects: vec![], radius: f64::from(CIRCLE_RADIUS * s), cog: Vec2::ZERO, inertia: f64::INFINITY },
            1 => Self::union(&[[0.0, 0.0, s, s * 2.0], [0.0, -s, s * 2.0, 0.0]], &[0, 1]),
            2 => Self::union(&[[-2.0 * s, 0.0, 2.0 * s, s], [-s / 2.0, s, s / 2.0, 4.0 * s]], &[0, 0]),
            3 => {
                let (half, wide) = (s / 2.0, 3.0 * s / 2.0);
                Self::union(&[[-half, 0.0, wide, s], [-wide, -s, half, 0.0]], &[0, 1])
            }
            4 => Self::union(&[[-s, -s, s, s]], &[0]),
            5 => Self::union(&[[-s / 2.0, -2.0 * s, s / 2.0, 2.0 * s]], &[0]),
            6 => {
                let wide = 3.0 * s / 2.0;
                Self::union(&[[-wide, 0.0, wide, s], [-s / 2.0, s, s / 2.0, 2.0 * s]], &[0, 1])
            }
            _ => {
                let (wide, half) = (3.0 * s / 2.0, s / 2.0);
                Self::union(
                    &[[-wide, -half, wide, half], [-half, half, half, wide], [-half, -wide, half, -half]],
                    &[0; 3],
                )
            }
        }
    }

    /// Makes a union of rectangles; `inertias` are the indices of the rectangles whose moments are
    /// summed.
    fn union(rects: &[Rect], inertias: &[usize]) -> Self {
        let rects: Vec<[Vec2; 4]> = rects
            .iter()
            .map(|rect| {
                let [left, top, right, bottom] = rect.map(f64::from);
                [Vec2::new(left, top), Vec2::new(right, top), Vec2::new(right, bottom), Vec2::new(left, bottom)]
            })
            .collect();
        let sum = rects.iter().map(centroid).reduce(|a, b| a + b).unwrap_or_default();
        let count = rects.len() as f64;
        let cog = Vec2::new(sum.x / count, sum.y / count);
        let inertia = inertias.iter().map(|&i| moment(&rects[i])).sum();
        Self { rects, radius: 0.0, cog, inertia }
    }

    /// Returns the smallest rotation after which a shape looks the same, in radians.
    pub fn symmetry(shape: i64) -> f64 {
        match shape {
            3 | 5 => PI,
            4 | 7 => PI / 2.0,
            _ => TAU,
        }
    }

    /// Returns whether the shape is a circle. Circles have infinite mass, so nothing pushes them.
    pub fn is_circle(&self) -> bool {
        self.rects.is_empty()
    }

    /// Makes a body of this shape at the origin.
    pub fn body(&self) -> Body {
        let mass = if self.is_circle() { f64::INFINITY } else { 1.0 };
        Body::new(mass, self.inertia, self.cog)
    }

    /// Makes the collision shapes for the body of this index.
    pub fn colliders(&self, body: usize) -> Vec<Shape> {
        if self.is_circle() {
            return vec![Shape::circle(body, self.radius)];
        }
        self.rects.iter().map(|&rect| Shape::quad(body, rect)).collect()
    }
}

fn edges(corners: &[Vec2; 4]) -> impl Iterator<Item = (Vec2, Vec2)> {
    (0..4).map(|i| (corners[i], corners[(i + 1) % 4]))
}

/// Returns the centroid of a polygon.
fn centroid(corners: &[Vec2; 4]) -> Vec2 {
    let (mut area, mut sum) = (0.0, Vec2::ZERO);
    for (a, b) in edges(corners) {
        let cross = a.cross(b);
        area += cross;
        sum += (a + b) * cross;
    }
    sum * (1.0 / (3.0 * area))
}

/// Returns the moment of inertia of a polygon of mass 1 about the origin of its coordinates.
fn moment(corners: &[Vec2; 4]) -> f64 {
    let (mut weighted, mut area) = (0.0, 0.0);
    for (a, b) in edges(corners) {
        let cross = b.cross(a);
        weighted += cross * (a.dot(a) + a.dot(b) + b.dot(b));
        area += cross;
    }
    weighted / (6.0 * area)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_t_has_the_inertia_and_centre_of_mass_of_the_reference() {
        let long_t = BodyShape::new(2, 30.0);
        assert_eq!(long_t.cog, Vec2::new(0.0, 45.0));
        // Two moments of a 120 x 30 bar about the middle of its long side.
        assert!((long_t.inertia - 2.0 * (120.0f64.powi(2) + 4.0 * 30.0f64.powi(2)) / 12.0).abs() < 1e-9);
    }

    #[test]
    fn every_shape_but_the_circle_is_dynamic() {
        for shape in 0..8 {
            let body_shape = BodyShape::new(shape, 40.0);
            assert_eq!(body_shape.body().is_dynamic(), shape != 0, "shape {shape}");
            assert!(!body_shape.colliders(0).is_empty());
        }
    }
}
