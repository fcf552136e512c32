//! Where two shapes touch.
//!
//! Shapes overlap when their Minkowski difference, grown by their radii, holds the origin. GJK walks towards
//! the edge of the difference nearest to the origin; when the origin lies inside, EPA grows the polygon it
//! has found until that edge is on the surface. The edges of the two shapes that face each other there are
//! clipped against each other, which gives up to two contacts.

use super::shape::{Kind, Shape};
use super::{Contact, Vec2};

/// Walks end after so many steps, found or not.
const MAX_ITERATIONS: usize = 30;

/// Contacts of a pair of shapes, in world coordinates.
pub struct Touch {
    /// From the first shape to the second.
    pub normal: Vec2,
    /// The contacts; `arms` still hold points, not offsets.
    pub contacts: [Contact; 2],
    /// How many there are.
    pub count: usize,
    /// Where to start next time: the corners of the nearest edge of the Minkowski difference.
    pub hint: u32,
}

/// Finds the contacts of two shapes, `a.kind <= b.kind`, starting from the hint of last time (0: none).
pub fn touch(a: &Shape, b: &Shape, hashes: [u64; 2], hint: u32) -> Touch {
    let nearest = Pair { a, b }.nearest(hint);
    let mut touch = Touch { normal: nearest.normal, contacts: [Contact::default(); 2], count: 0, hint: nearest.hint };
    if nearest.distance > a.radius + b.radius {
        return touch;
    }
    let n = nearest.normal;
    if a.kind == Kind::Circle {
        touch.add(nearest.on_a + n * a.radius, nearest.on_b + n * -b.radius, 0);
        return touch;
    }
    // Each end of one edge is set against the other edge, all projected on the direction along the surface.
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
            touch.add(on_a, on_b, hash_pair(hashes[0], hashes[1]));
        }
    }
    touch
}

impl Touch {
    fn add(&mut self, on_a: Vec2, on_b: Vec2, hash: u64) {
        self.contacts[self.count] = Contact { arms: [on_a, on_b], hash, ..Contact::default() };
        self.count += 1;
    }
}

/// A symmetric hash of two, by which a contact is known again in the next step.
fn hash_pair(a: u64, b: u64) -> u64 {
    const FACTOR: u64 = 3_344_921_057;
    a.wrapping_mul(FACTOR) ^ b.wrapping_mul(FACTOR)
}

fn clamp01(t: f64) -> f64 {
    t.clamp(0.0, 1.0)
}

/// An edge of a shape.
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

/// A corner of the Minkowski difference `b - a`.
#[derive(Clone, Copy)]
struct Corner {
    a: Vec2,
    b: Vec2,
    ab: Vec2,
    id: u32,
}

/// Whether `c` lies left of the line from `a` to `b`, told from the two middles for the sake of precision.
fn is_left(a: Vec2, b: Vec2, c: Vec2) -> bool {
    (b.y - a.y) * (a.x + b.x - 2.0 * c.x) > (b.x - a.x) * (a.y + b.y - 2.0 * c.y)
}

/// Where on the segment from `a` (-1) to `b` (1) the point nearest to the origin is.
fn nearest_t(a: Vec2, b: Vec2) -> f64 {
    let delta = b - a;
    let squared = delta.length_squared();
    if squared == 0.0 { 0.0 } else { -(delta.dot(a + b) / squared).clamp(-1.0, 1.0) }
}

/// The point at `t` on the segment from `a` (-1) to `b` (1).
fn at_t(a: Vec2, b: Vec2, t: f64) -> Vec2 {
    let half = 0.5 * t;
    a * (0.5 - half) + b * (0.5 + half)
}

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
        // Two corners: the direction between them is no normal of an edge.
        let distance = gap.length();
        Self { on_a, on_b, normal: gap * (1.0 / (distance + f64::MIN_POSITIVE)), distance, hint }
    }
}

/// Two shapes being compared.
struct Pair<'a> {
    a: &'a Shape,
    b: &'a Shape,
}

impl Pair<'_> {
    fn corner(&self, a: usize, b: usize) -> Corner {
        let (point_a, point_b) = (self.a.points[a], self.b.points[b]);
        #[allow(clippy::cast_possible_truncation)]
        let id = (a as u32) << 8 | b as u32;
        Corner { a: point_a, b: point_b, ab: point_b - point_a, id }
    }

    /// The corner of the difference farthest along `n`.
    fn support(&self, n: Vec2) -> Corner {
        self.corner(self.a.support(-n), self.b.support(n))
    }

    fn hinted(&self, id: u32) -> Corner {
        let valid = |i: u32, shape: &Shape| if (i as usize) < shape.len() { i as usize } else { 0 };
        self.corner(valid(id >> 8 & 0xff, self.a), valid(id & 0xff, self.b))
    }

    /// GJK.
    fn nearest(&self, hint: u32) -> Nearest {
        let (mut v0, mut v1) = if hint == 0 {
            let axis = (self.a.bounds.centre() - self.b.bounds.centre()).perp();
            (self.support(axis), self.support(-axis))
        } else {
            (self.hinted(hint >> 16), self.hinted(hint & 0xffff))
        };
        for _ in 0..MAX_ITERATIONS {
            // The origin belongs on the near side of the edge.
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

    /// EPA, from a triangle of the difference that holds the origin.
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
            // The hull of the old corners and p, which comes first.
            let old = hull;
            hull[0] = p;
            let mut kept = 1;
            for i in 0..count {
                let index = (nearest.0 + 1 + i) % count;
                let next = if i + 1 < count { old[(index + 1) % count].ab } else { p.ab };
                if is_left(hull[kept - 1].ab, next, old[index].ab) {
                    hull[kept] = old[index];
                    kept += 1;
                }
            }
            count = kept;
            iteration += 1;
        }
    }
}
