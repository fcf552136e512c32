//! Collision shapes: circles, thick segments and convex quadrilaterals, each represented by points with a radius.

use super::body::Body;
use super::bounds::Bounds;
use super::vec2::Vec2;

/// The kinds of shapes. The contact search requires that the first shape of a pair has the lesser kind.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// One point and a radius.
    Circle,
    /// Two points and a radius.
    Segment,
    /// Four points, ordered from x towards y, without a radius.
    Quad,
}

/// A collision shape of a body.
#[derive(Clone, Debug)]
pub struct Shape {
    /// The kind.
    pub kind: Kind,
    /// Index of the shape's body.
    pub body: usize,
    /// The distance by which the shape extends beyond its points, in pixels.
    pub radius: f64,
    /// Corners in body coordinates; the first [`Shape::len`] are valid.
    pub corners: [Vec2; 4],
    /// Outward normal of the edge that ends in the corner of the same index, in body coordinates (for a segment: of its
    /// right side).
    normals: [Vec2; 4],
    /// Corners in table coordinates.
    pub points: [Vec2; 4],
    /// Normals in table coordinates.
    pub table_normals: [Vec2; 4],
    /// Bounding box in table coordinates.
    pub bounds: Bounds,
}

impl Shape {
    fn new(kind: Kind, body: usize, radius: f64, corners: [Vec2; 4], normals: [Vec2; 4]) -> Self {
        Self {
            kind,
            body,
            radius,
            corners,
            normals,
            points: corners,
            table_normals: normals,
            bounds: Bounds::default(),
        }
    }

    /// Makes a circle about the body's origin.
    pub fn circle(body: usize, radius: f64) -> Self {
        Self::new(Kind::Circle, body, radius, [Vec2::ZERO; 4], [Vec2::ZERO; 4])
    }

    /// Makes a segment from `a` to `b` that extends by `radius` on either side.
    pub fn segment(body: usize, a: Vec2, b: Vec2, radius: f64) -> Self {
        let normal = (b - a).normalized().rperp();
        Self::new(Kind::Segment, body, radius, [a, b, b, b], [normal; 4])
    }

    /// Makes a convex quadrilateral; its corners are ordered from x towards y.
    pub fn quad(body: usize, corners: [Vec2; 4]) -> Self {
        let normals = std::array::from_fn(|i| (corners[i] - corners[(i + 3) % 4]).rperp().normalized());
        Self::new(Kind::Quad, body, 0.0, corners, normals)
    }

    /// The number of corners.
    pub fn len(&self) -> usize {
        match self.kind {
            Kind::Circle => 1,
            Kind::Segment => 2,
            Kind::Quad => 4,
        }
    }

    /// Moves the shape to the pose of its body.
    pub fn update(&mut self, body: &Body) {
        let mut bounds = Bounds::EMPTY;
        for i in 0..self.len() {
            let point = body.pose.point(self.corners[i]);
            self.points[i] = point;
            self.table_normals[i] = body.pose.direction(self.normals[i]);
            bounds = bounds.with(point);
        }
        self.bounds = bounds.grown(self.radius);
    }

    /// Returns the index of the corner farthest along `n`.
    pub fn support(&self, n: Vec2) -> usize {
        match self.kind {
            Kind::Circle => 0,
            Kind::Segment => usize::from(self.points[0].dot(n) <= self.points[1].dot(n)),
            Kind::Quad => {
                let mut best = (0, f64::NEG_INFINITY);
                for (i, point) in self.points.iter().enumerate() {
                    let along = point.dot(n);
                    if along > best.1 {
                        best = (i, along);
                    }
                }
                best.0
            }
        }
    }

    /// Returns the corners `(from, to)` of the edge that faces `n`.
    pub fn facing_edge(&self, n: Vec2) -> (usize, usize) {
        match self.kind {
            Kind::Circle => (0, 0),
            Kind::Segment if self.table_normals[0].dot(n) > 0.0 => (0, 1),
            Kind::Segment => (1, 0),
            Kind::Quad => {
                let at = self.support(n);
                let next = (at + 1) % 4;
                if n.dot(self.table_normals[at]) > n.dot(self.table_normals[next]) {
                    ((at + 3) % 4, at)
                } else {
                    (at, next)
                }
            }
        }
    }
}
