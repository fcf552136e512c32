//! Rasterisation of meshes: triangles with perspective-correct depth, eight samples at a time.

use super::{Layers, Region};
use crate::mesh::DetailLevel;
use crate::scene::Geom;
use crate::vector::{V3, dot};
use crate::view::View;
use std::ops::Range;
use swm_simd::{F32x8, Kernel, LANES, Portable, dispatch_avx2, vectorize};

/// Set in ids that are indices of triangles instead of geoms.
pub(crate) const TRIANGLE: u32 = 1 << 31;

/// Relative enlargement of triangles, so that no sample falls between neighbours.
const ENLARGEMENT: f32 = 1e-5;

/// A triangle on the screen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangle {
    /// The detail level of the mesh.
    pub level: u32,
    /// The index of the triangle in the detail level.
    pub face: u32,
    /// The pixel that the following equations are relative to.
    base: [f32; 2],
    /// The coefficients `[of x, of y, constant]` of each barycentric weight divided by `w`.
    shares: [[f32; 3]; 3],
    /// The coefficients `[of x, of y, constant]` of the depth divided by `w`.
    depth: [f32; 3],
}

impl Triangle {
    /// Returns the barycentric weights of the corners and the depth at pixel coordinates.
    #[inline]
    pub fn at(&self, x: f32, y: f32) -> ([f32; 3], f32) {
        let (x, y) = (x - self.base[0], y - self.base[1]);
        let shares = self.shares.map(|[a, b, c]| a * x + b * y + c);
        let sum = shares[0] + shares[1] + shares[2];
        let by = 1.0 / sum;
        let [a, b, c] = self.depth;
        (shares.map(|share| share * by), (a * x + b * y + c) * by)
    }
}

impl Layers {
    pub(super) fn draw_mesh(
        &mut self,
        index: (u32, u32),
        geom: &Geom,
        level: &DetailLevel,
        (view, rows): (&View, Range<usize>),
        floor: Option<&[f32]>,
        both_sides: bool,
    ) {
        let mut vertices = std::mem::take(&mut self.vertices);
        vertices.resize(level.positions.len(), [0.0; 4]);
        // `View::project` of the three local axes, as a matrix from local coordinates to pixels.
        let ([ox, oy, ow], depth) = view.project(geom.position);
        let axes: [V3; 3] = std::array::from_fn(|k| std::array::from_fn(|i| geom.rotation[3 * i + k]));
        let turned = axes.map(|axis| {
            let (x, y, z) = (dot(axis, view.right), dot(axis, view.up), dot(axis, view.forward));
            let w = if view.orthographic { 0.0 } else { z };
            [(x - view.left * w) * view.pixels_per_unit[0], (view.top * w - y) * view.pixels_per_unit[1], w, z]
        });
        to_pixels(&level.positions, &turned, [ox, oy, ow, depth], &mut vertices);
        // Rows run downwards, so front faces, counterclockwise seen from the camera, are clockwise in pixels.
        let front = if view.mirrored { 1.0 } else { -1.0 };
        let front = if both_sides { 0.0 } else { front };
        let rules = DrawRules { front, near: view.near, floor, rows };
        dispatch_avx2(MeshTriangles { layers: self, index, level, vertices: &vertices, rules });
        self.vertices = vertices;
    }

    /// Draws a triangle in front of the camera if it faces the camera.
    #[inline(always)]
    fn triangle(&mut self, simd: impl F32x8, index: (u32, u32, u32), [a, b, c]: [[f32; 4]; 3], rules: &DrawRules<'_>) {
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if area * rules.front < 0.0 || area.abs() <= 1e-12 || !area.is_finite() {
            return;
        }
        // The range of pixels whose samples may be inside the triangle.
        let [first, last] = self.reach;
        let low = |k: usize| (a[k].min(b[k]).min(c[k]) - last[k] + 1.0) as i32;
        let high = |k: usize| (a[k].max(b[k]).max(c[k]) - first[k] + 1.0) as i32;
        let (x0, y0) = (low(0).max(0), low(1).max(0));
        let x1 = high(0).min(self.width as i32);
        let (first, last) = (y0.max(rules.rows.start as i32), high(1).min(rules.rows.end as i32));
        if x0 >= x1 || first >= last {
            return;
        }
        // The base is relative to the frame, not to the rows, so that rounding does not depend on the first row.
        let base = [x0 as f32, y0 as f32];
        let by = 1.0 / area;
        let corner = |p: [f32; 4]| (p[0] - base[0], p[1] - base[1], by / p[2]);
        let (a, b, c, depths) = (corner(a), corner(b), corner(c), [a[3], b[3], c[3]]);
        // A corner's weight falls to 0 at the opposite side; divided by w, it is linear on the screen.
        let share = |p: (f32, f32, f32), q: (f32, f32, f32), r: (f32, f32, f32)| {
            [(q.1 - r.1) * p.2, (r.0 - q.0) * p.2, (q.0 * r.1 - q.1 * r.0) * p.2]
        };
        let shares = [share(a, b, c), share(b, c, a), share(c, a, b)];
        let region = [x0 as usize, first as usize, x1 as usize, last as usize];
        self.fill(simd, index, base, shares, depths, region, rules);
    }

    /// Draws a triangle that crosses the near plane.
    #[cold]
    fn near_triangle(&mut self, index: (u32, u32, u32), corners: [[f32; 4]; 3], rules: &DrawRules<'_>) {
        // A weight divided by w is linear on the screen. Its coefficients are a row of the inverse matrix of the
        // corners.
        let [a, b, c] =
            corners.map(|[x, y, w, _]| [f64::from(x) * f64::from(w), f64::from(y) * f64::from(w), f64::from(w)]);
        let wedge = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let (bc, ca, ab) = (wedge(b, c), wedge(c, a), wedge(a, b));
        let determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2];
        if determinant * f64::from(rules.front) < 0.0 || determinant == 0.0 || !determinant.is_finite() {
            return;
        }
        let shares = [bc, ca, ab].map(|row| row.map(|x| (x / determinant) as f32));
        let region = [0, rules.rows.start, self.width, rules.rows.end];
        self.fill(Portable, index, [0.0; 2], shares, corners.map(|corner| corner[3]), region, rules);
    }

    /// Draws a triangle, given by the equations of its corners' weights divided by `w`, within a region whose left
    /// edge is the x of `base`.
    #[inline(always)]
    #[allow(clippy::too_many_arguments, reason = "the equations of one triangle")]
    fn fill(
        &mut self,
        simd: impl F32x8,
        (geom, level, face): (u32, u32, u32),
        base: [f32; 2],
        shares: [[f32; 3]; 3],
        depths: [f32; 3],
        [x0, y0, x1, y1]: Region,
        rules: &DrawRules<'_>,
    ) {
        let [p, q, r] = shares;
        let [u, v, w] = depths;
        let depth = [p[0] * u + q[0] * v + r[0] * w, p[1] * u + q[1] * v + r[1] * w, p[2] * u + q[2] * v + r[2] * w];
        // Neighbours overlap slightly, so that no sample falls between them.
        let sum = [p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]];
        let mut lines = [p, q, r, depth];
        for line in &mut lines[..3] {
            for (x, sum) in line.iter_mut().zip(sum) {
                *x += ENLARGEMENT * sum;
            }
        }
        for x in &mut lines[3] {
            *x *= 1.0 + 3.0 * ENLARGEMENT;
        }
        // The values at the first samples right of and below the base, and their change per column.
        let (across, down) = (simd.load(&self.lanes[0]), simd.load(&self.lanes[1]));
        let (mut corner, mut slopes) = ([simd.splat(0.0); 4], [simd.splat(0.0); 4]);
        for (k, [x, y, constant]) in lines.into_iter().enumerate() {
            slopes[k] = simd.splat(x);
            let lanes = simd.add(simd.mul(slopes[k], across), simd.mul(simd.splat(y), down));
            corner[k] = simd.add(simd.splat(constant), lanes);
        }
        let (zero, near, pixels) = (simd.splat(0.0), simd.splat(rules.near), simd.splat((LANES / self.samples) as f32));
        let id = TRIANGLE | self.triangles.len() as u32;
        let wide = ((x1 - x0) * self.samples).next_multiple_of(LANES);
        let mut drawn = simd.gt(zero, zero);
        for y in y0..y1 {
            let begin = self.span(y, x0, x0).start;
            let row = begin..begin + wide;
            let floor = rules.floor.map_or(&self.free[..wide], |floor| &floor[row.clone()]).as_chunks().0;
            let depths = self.depths[row.clone()].as_chunks_mut().0;
            let ids = self.ids[row].as_chunks_mut().0;
            let rows = y as f32 - base[1];
            let mut left = corner;
            for (left, line) in left.iter_mut().zip(&lines) {
                *left = simd.add(*left, simd.splat(line[1] * rows));
            }
            let mut column = zero;
            for ((depths, ids), floor) in depths.iter_mut().zip(ids).zip(floor) {
                let mut at = left;
                for (at, slope) in at.iter_mut().zip(slopes) {
                    *at = simd.add(*at, simd.mul(slope, column));
                }
                let [p, q, r, depth] = at;
                let inside = simd.ge(simd.min(simd.min(p, q), r), zero);
                // If all weights are 0, the result is NaN, and the comparison with `near` is false.
                let far = simd.div(depth, simd.add(simd.add(p, q), r));
                let nearer = simd.and(simd.ge(simd.load(depths), far), simd.gt(far, near));
                let nearer = simd.and(inside, simd.and(nearer, simd.gt(far, simd.load(floor))));
                simd.store_masked(nearer, far, depths);
                simd.store_word_masked(nearer, id, ids);
                drawn = simd.or(drawn, nearer);
                column = simd.add(column, pixels);
            }
        }
        if simd.any(drawn) {
            self.triangles.push(Triangle { level, face, base, shares, depth });
            self.owners.push(geom);
        }
    }
}

/// The triangles of a mesh with projected vertices, to be drawn.
struct MeshTriangles<'a> {
    layers: &'a mut Layers,
    /// The geom, and the detail level of its mesh.
    index: (u32, u32),
    level: &'a DetailLevel,
    vertices: &'a [[f32; 4]],
    rules: DrawRules<'a>,
}

/// The conditions under which triangles and samples are drawn.
struct DrawRules<'a> {
    /// Sign of the screen area of triangles to draw; 0 for both sides.
    front: f32,
    /// The near plane; samples must be farther.
    near: f32,
    /// A depth for each sample, if given; samples must be farther.
    floor: Option<&'a [f32]>,
    /// The rows to draw.
    rows: Range<usize>,
}

impl Kernel for MeshTriangles<'_> {
    type Output = ();

    #[inline(always)]
    fn run<L: swm_simd::Level>(self) {
        let simd = L::f32x8();
        let Self { layers, index, level, vertices, rules } = self;
        for (face, &[a, b, c]) in level.faces.iter().enumerate() {
            let corners = [vertices[a as usize], vertices[b as usize], vertices[c as usize]];
            let index = (index.0, index.1, face as u32);
            let [p, q, r] = corners.map(|corner| corner[3] > rules.near);
            if p & q & r {
                layers.triangle(simd, index, corners, &rules);
            } else if p | q | r {
                layers.near_triangle(index, corners, &rules);
            }
        }
    }
}

vectorize! {
    /// Projects positions to pixels, `w` and depth.
    fn to_pixels(positions: &[V3], axes: &[[f32; 4]; 3], origin: [f32; 4], vertices: &mut [[f32; 4]]) {
        for (position, vertex) in positions.iter().zip(vertices) {
            let at = |k: usize| origin[k] + axes[0][k] * position[0] + axes[1][k] * position[1] + axes[2][k] * position[2];
            let w = at(2);
            *vertex = [at(0) / w, at(1) / w, w, at(3)];
        }
    }
}
