//! Finds the contacts of two shapes with the same sequence of operations as Chipmunk (`cpCollision.c`).
//!
//! Shapes overlap when their Minkowski difference, enlarged by their radii, contains the origin. GJK (Gilbert, Johnson
//! and Keerthi 1988) finds the edge of the difference nearest to the origin. When the origin lies inside, EPA (the
//! expanding polytope algorithm) expands a polygon inside the difference until its edge nearest to the origin lies on
//! the surface. The facing edges of the two shapes are clipped against each other, which gives up to two contacts.

use super::contact::Contact;
use super::shape::{Kind, Shape};
use super::vec2::Vec2;

/// The maximal number of iterations of GJK and of EPA.
const MAX_ITERATIONS: usize = 30;

/// The contacts of a pair of shapes, in table coordinates.
pub struct Manifold {
    /// Unit vector from the first shape to the second.
    pub normal: Vec2,
    /// The contacts; the first `count` are valid. Here their `arms` are points in table coordinates, not lever arms.
    pub contacts: [Contact; 2],
    /// The number of contacts.
    pub count: usize,
    /// The corners of the nearest edge of the Minkowski difference, with which the next search starts.
    pub hint: u32,
}

/// Finds the contacts of two shapes with `a.kind <= b.kind`, starting from the hint of the last search (0: none).
pub fn manifold(a: &Shape, b: &Shape, hashes: [u64; 2], hint: u32) -> Manifold {
    let nearest = Pair { a, b }.nearest(hint);
    let mut manifold =
        Manifold { normal: nearest.normal, contacts: [Contact::default(); 2], count: 0, hint: nearest.hint };
    if nearest.distance > a.radius + b.radius {
        return manifold;
    }
    let n = nearest.normal;
    if a.kind == Kind::Circle {
        manifold.add(nearest.on_a + n * a.radius, nearest.on_b + n * -b.radius, 0);
        return manifold;
    }
    // Each end of one edge is projected onto the other edge, along the surface.
    let (edge_a, edge_b) = (Edge::facing(a, n, hashes[0]), Edge::facing(b, -n, hashes[1]));
    let (a_from, a_to) = (edge_a.from.cross(n), edge_a.to.cross(n));
    let (b_from, b_to) = (edge_b.from.cross(n), edge_b.to.cross(n));
    let per_a = 1.0 / (a_to - a_from + f64::MIN_POSITIVE);
    let per_b = 1.0 / (b_to - b_from + f64::MIN_POSITIVE);
    let ends = [
        (b_to - a_from, a_from - b_from, [edge_a.from_hash, edge_b.to_hash]),
        (b_from - a_from, a_to - b_from, [edge_a.to_hash, edge_b.from_hash]),
    ];
    for (along_a, along_b, hashes) in ends {
        let on_a = n * a.radius + edge_a.from.lerp(edge_a.to, clamp01(along_a * per_a));
        let on_b = n * -b.radius + edge_b.from.lerp(edge_b.to, clamp01(along_b * per_b));
        if (on_b - on_a).dot(n) <= 0.0 {
            manifold.add(on_a, on_b, hash_pair(hashes[0], hashes[1]));
        }
    }
    manifold
}

impl Manifold {
    fn add(&mut self, on_a: Vec2, on_b: Vec2, hash: u64) {
        self.contacts[self.count] = Contact { arms: [on_a, on_b], hash, ..Contact::default() };
        self.count += 1;
    }
}

/// Returns a symmetric hash of two hashes, which identifies a contact in the next step.
fn hash_pair(a: u64, b: u64) -> u64 {
    const FACTOR: u64 = 3_344_921_057;
    a.wrapping_mul(FACTOR) ^ b.wrapping_mul(FACTOR)
}

fn clamp01(t: f64) -> f64 {
    t.clamp(0.0, 1.0)
}

/// An edge of a shape, with hashes of its ends.
struct Edge {
    from: Vec2,
    to: Vec2,
    from_hash: u64,
    to_hash: u64,
}

impl Edge {
    fn facing(shape: &Shape, n: Vec2, hash: u64) -> Self {
        let (from, to) = shape.facing_edge(n);
        Self {
            from: shape.points[from],
            to: shape.points[to],
            from_hash: hash_pair(hash, from as u64),
            to_hash: hash_pair(hash, to as u64),
        }
    }
}

/// The closest points of two shapes without their radii.
struct Nearest {
    on_a: Vec2,
    on_b: Vec2,
    normal: Vec2,
    distance: f64,
    hint: u32,
}

/// A corner `ab` of the Minkowski difference `b - a`, with the corners `a` and `b` of the two shapes.
#[derive(Clone, Copy)]
struct Corner {
    a: Vec2,
    b: Vec2,
    ab: Vec2,
    id: u32,
}

/// Returns whether `c` lies left of the line from `a` to `b`, computed from midpoints for precision.
fn is_left(a: Vec2, b: Vec2, c: Vec2) -> bool {
    (b.y - a.y) * (a.x + b.x - 2.0 * c.x) > (b.x - a.x) * (a.y + b.y - 2.0 * c.y)
}

/// Returns the parameter, from -1 at `a` to 1 at `b`, of the point of the segment nearest to the origin.
fn nearest_t(a: Vec2, b: Vec2) -> f64 {
    let delta = b - a;
    let squared = delta.length_squared();
    if squared == 0.0 { 0.0 } else { -(delta.dot(a + b) / squared).clamp(-1.0, 1.0) }
}

/// Returns the point of the segment at parameter `t`, from -1 at `a` to 1 at `b`.
fn at_t(a: Vec2, b: Vec2, t: f64) -> Vec2 {
    let half = 0.5 * t;
    a * (0.5 - half) + b * (0.5 + half)
}

/// Returns the squared distance of a segment from the origin.
fn distance_squared(a: Vec2, b: Vec2) -> f64 {
    at_t(a, b, nearest_t(a, b)).length_squared()
}

impl Nearest {
    fn between(v0: &Corner, v1: &Corner) -> Self {
        let t = nearest_t(v0.ab, v1.ab);
        let gap = at_t(v0.ab, v1.ab, t);
        let (on_a, on_b) = (at_t(v0.a, v1.a, t), at_t(v0.b, v1.b, t));
        let hint = v0.id << 16 | v1.id;
        let normal = (v1.ab - v0.ab).rperp().normalized();
        let distance = normal.dot(gap);
        if distance <= 0.0 || (-1.0 < t && t < 1.0) {
            return Self { on_a, on_b, normal, distance, hint };
        }
        // The nearest points are corners, so the normal is the direction between them.
        let distance = gap.length();
        Self { on_a, on_b, normal: gap * (1.0 / (distance + f64::MIN_POSITIVE)), distance, hint }
    }
}

/// The two shapes of a search.
struct Pair<'a> {
    a: &'a Shape,
    b: &'a Shape,
}

impl Pair<'_> {
    fn corner(&self, a: usize, b: usize) -> Corner {
        let (point_a, point_b) = (self.a.points[a], self.b.points[b]);
        let id = (a as u32) << 8 | b as u32;
        Corner { a: point_a, b: point_b, ab: point_b - point_a, id }
    }

    /// Returns the corner of the difference farthest along `n`.
    fn support(&self, n: Vec2) -> Corner {
        self.corner(self.a.support(-n), self.b.support(n))
    }

    fn hinted(&self, id: u32) -> Corner {
        let valid = |i: u32, shape: &Shape| if (i as usize) < shape.len() { i as usize } else { 0 };
        self.corner(valid(id >> 8 & 0xff, self.a), valid(id & 0xff, self.b))
    }

    /// Finds the closest points by GJK.
    fn nearest(&self, hint: u32) -> Nearest {
        let (mut v0, mut v1) = if hint == 0 {
            let axis = (self.a.bounds.centre() - self.b.bounds.centre()).perp();
            (self.support(axis), self.support(-axis))
        } else {
            (self.hinted(hint >> 16), self.hinted(hint & 0xffff))
        };
        for _ in 0..MAX_ITERATIONS {
            // Orients the edge so that the search goes towards the origin.
            if is_left(v1.ab, v0.ab, Vec2::ZERO) {
                std::mem::swap(&mut v0, &mut v1);
            }
            let t = nearest_t(v0.ab, v1.ab);
            let n = if -1.0 < t && t < 1.0 { (v1.ab - v0.ab).perp() } else { -at_t(v0.ab, v1.ab, t) };
            let p = self.support(n);
            if is_left(p.ab, v0.ab, Vec2::ZERO) && is_left(v1.ab, p.ab, Vec2::ZERO) {
                return self.penetration([v0, p, v1]);
            }
            if p.ab.dot(n) <= v0.ab.dot(n).max(v1.ab.dot(n)) {
                break;
            }
            if distance_squared(v0.ab, p.ab) < distance_squared(p.ab, v1.ab) {
                v1 = p;
            } else {
                v0 = p;
            }
        }
        Nearest::between(&v0, &v1)
    }

    /// Finds the closest points of overlapping shapes by EPA, from a triangle of the difference that contains the
    /// origin.
    fn penetration(&self, triangle: [Corner; 3]) -> Nearest {
        let mut hull = [triangle[0]; MAX_ITERATIONS + 3];
        hull[..3].copy_from_slice(&triangle);
        let mut count = 3;
        let mut iteration = 1;
        loop {
            let mut nearest = (0, f64::INFINITY);
            let mut from = count - 1;
            for to in 0..count {
                let distance = distance_squared(hull[from].ab, hull[to].ab);
                if distance < nearest.1 {
                    nearest = (from, distance);
                }
                from = to;
            }
            let (v0, v1) = (hull[nearest.0], hull[(nearest.0 + 1) % count]);
            let p = self.support((v1.ab - v0.ab).perp());
            let known = p.id == v0.id || p.id == v1.id;
            if known || !is_left(v0.ab, v1.ab, p.ab) || iteration >= MAX_ITERATIONS {
                return Nearest::between(&v0, &v1);
            }
            // The new hull starts with p; old corners inside it are dropped.
            let old = hull;
            hull[0] = p;
            let mut new_count = 1;
            for i in 0..count {
                let index = (nearest.0 + 1 + i) % count;
                let next = if i + 1 < count { old[(index + 1) % count].ab } else { p.ab };
                if is_left(hull[new_count - 1].ab, next, old[index].ab) {
                    hull[new_count] = old[index];
                    new_count += 1;
                }
            }
            count = new_count;
            iteration += 1;
        }
    }
}
