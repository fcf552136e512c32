//! [`Layers`]: what is nearest at every sample of a picture, and how far it is.

use crate::cast::{Posed, Samples};
use crate::mesh::{Level, Mesh};
use crate::scene::{Assets, Geom, Shape};
use crate::vector::{V3, add, dot, length, rotate, scale};
use crate::view::View;
use std::ops::Range;
use swm_simd::vectorize;
use swm_simd::{F32x8, Kernel, LANES, Portable, dispatch_avx2};

/// Nothing is there.
pub(crate) const NOTHING: u32 = u32::MAX >> 1;
/// Set where the number is that of a triangle, not of a geom.
pub(crate) const TRIANGLE: u32 = 1 << 31;

/// Cells of coarser meshes are at most so many pixels large.
const INVISIBLE: f32 = 0.6;

/// And so many texels large in maps of shadows.
const COARSE: f32 = 2.0;

/// By how much triangles are wider than they are, as a part of their size.
const HAIR: f32 = 1e-5;

/// Where the samples of a pixel are.
pub(crate) fn pattern(samples: usize) -> &'static [[f32; 2]] {
    const EIGHTHS: f32 = 0.125;
    const ONE: [[f32; 2]; 1] = [[0.5, 0.5]];
    const TWO: [[f32; 2]; 2] = [[6.0 * EIGHTHS, 6.0 * EIGHTHS], [2.0 * EIGHTHS, 2.0 * EIGHTHS]];
    // The rotated square that graphics cards use; their rows begin below.
    const FOUR: [[f32; 2]; 4] = [
        [3.0 * EIGHTHS, 7.0 * EIGHTHS],
        [7.0 * EIGHTHS, 5.0 * EIGHTHS],
        [1.0 * EIGHTHS, 3.0 * EIGHTHS],
        [5.0 * EIGHTHS, 1.0 * EIGHTHS],
    ];
    match samples {
        0 | 1 => &ONE,
        2 | 3 => &TWO,
        _ => &FOUR,
    }
}

/// The middle of samples, a bit each, which is inside a convex shape even at its rim; that of the pixel where it is covered.
#[allow(clippy::cast_precision_loss)]
fn centre_of(pattern: &[[f32; 2]], covered: usize) -> [f32; 2] {
    let count = covered.count_ones() as usize;
    if count == 0 || count >= pattern.len() {
        return [0.5, 0.5];
    }
    let mut sum = [0.0; 2];
    for (_, offset) in pattern.iter().enumerate().filter(|(sample, _)| covered >> sample & 1 == 1) {
        sum = [sum[0] + offset[0], sum[1] + offset[1]];
    }
    sum.map(|sum| sum / count as f32)
}

/// The nearest thing at every sample of some rows of a picture. Samples of a pixel are neighbours, so that a small triangle meets
/// many at once. What is at a sample does not depend on which rows are drawn together.
#[derive(Default)]
pub(crate) struct Layers {
    pub width: usize,
    /// The rows of the picture.
    pub rows: Range<usize>,
    pub samples: usize,
    /// From a row to the next: the samples of its pixels, and room for [`LANES`] that reach beyond them.
    stride: usize,
    /// Where they are in a pixel.
    pub pattern: &'static [[f32; 2]],
    /// Their least and greatest coordinates.
    reach: [[f32; 2]; 2],
    /// Depths; before anything is drawn, how far one sees.
    pub depths: Vec<f32>,
    /// Places of geoms, or [`TRIANGLE`] and the place of a triangle.
    pub ids: Vec<u32>,
    /// Triangles that were drawn since the start.
    pub triangles: Vec<Triangle>,
    /// Their geoms.
    owners: Vec<u32>,
    /// By sample of a row: where it is, from the left of the picture and the upper edge of the row.
    at: [Vec<f32>; 2],
    /// The same of the first ones.
    lanes: [[f32; LANES]; 2],
    /// By the samples that are covered, a bit each: their middle in the pixel.
    pub centres: [[f32; 2]; 16],
    /// By sample of a row: nothing is too near.
    free: Vec<f32>,
    /// Scratch: how far to the left and right a shape reaches, by row.
    outline: [Vec<f32>; 2],
    /// Scratch: vertices of a mesh in pixels, `w`, and depth.
    vertices: Vec<[f32; 4]>,
}

/// What layers hold.
#[derive(Default)]
pub(crate) struct Record {
    depths: Vec<f32>,
    ids: Vec<u32>,
    triangles: Vec<Triangle>,
    owners: Vec<u32>,
}

/// A triangle on the screen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangle {
    /// Its version of the mesh, and its place there.
    pub level: u32,
    pub face: u32,
    /// Relative to which pixel the following are.
    base: [f32; 2],
    /// `[by x, by y, constant]` of each corner's share, divided by `w`.
    shares: [[f32; 3]; 3],
    /// The same of the depth, divided by `w`.
    depth: [f32; 3],
}

impl Triangle {
    /// The shares of its corners at pixel coordinates, and the depth.
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

/// A part of a picture: from `x0`, `y0` to before `x1`, `y1`.
pub(crate) type Region = [usize; 4];

impl Layers {
    /// Forgets everything, for these rows of a picture so wide.
    pub fn start(&mut self, width: usize, rows: Range<usize>, pattern: &'static [[f32; 2]]) {
        let stride = width * pattern.len() + LANES;
        if (stride, pattern) != (self.stride, self.pattern) {
            self.place_samples(stride, pattern);
        }
        self.depths.resize(rows.len() * stride, 0.0);
        self.ids.resize(rows.len() * stride, NOTHING);
        (self.width, self.rows) = (width, rows);
        self.forget();
    }

    /// Finds where the samples of a row are.
    #[allow(clippy::cast_precision_loss)]
    fn place_samples(&mut self, stride: usize, pattern: &'static [[f32; 2]]) {
        (self.stride, self.samples, self.pattern) = (stride, pattern.len(), pattern);
        let reach = |with: fn(f32, f32) -> f32, from: f32| {
            pattern.iter().fold([from; 2], |a, b| [with(a[0], b[0]), with(a[1], b[1])])
        };
        self.reach = [reach(f32::min, 1.0), reach(f32::max, 0.0)];
        for (axis, at) in self.at.iter_mut().enumerate() {
            let pixel = |i: usize| if axis == 0 { (i / pattern.len()) as f32 } else { 0.0 };
            at.clear();
            at.extend((0..stride).map(|i| pixel(i) + pattern[i % pattern.len()][axis]));
            self.lanes[axis].copy_from_slice(&at[..LANES]);
        }
        self.free.resize(stride, f32::NEG_INFINITY);
        for (covered, centre) in self.centres.iter_mut().enumerate() {
            *centre = centre_of(pattern, covered);
        }
    }

    /// Forgets all triangles.
    pub fn forget(&mut self) {
        self.triangles.clear();
        self.owners.clear();
    }

    /// Copies what is there.
    pub fn record(&self, into: &mut Record) {
        into.depths.clone_from(&self.depths);
        into.ids.clone_from(&self.ids);
        into.triangles.clone_from(&self.triangles);
        into.owners.clone_from(&self.owners);
    }

    /// Puts back what was there, in layers of the same rows and samples.
    pub fn recall(&mut self, from: &Record) {
        self.depths.clone_from(&from.depths);
        self.ids.clone_from(&from.ids);
        self.triangles.clone_from(&from.triangles);
        self.owners.clone_from(&from.owners);
    }

    /// Empties it: one sees so far.
    pub fn clear(&mut self, far: f32) {
        self.depths.fill(far);
        self.ids.fill(NOTHING);
    }

    /// Where the samples of the pixels from `x0` to before `x1` of a row are.
    #[inline]
    pub fn span(&self, y: usize, x0: usize, x1: usize) -> Range<usize> {
        let first = (y - self.rows.start) * self.stride;
        first + x0 * self.samples..first + x1 * self.samples
    }

    /// The part of a region that is in its rows; without pixels where there is none.
    pub fn part(&self, [x0, y0, x1, y1]: Region) -> Region {
        let y0 = y0.clamp(self.rows.start, self.rows.end);
        [x0, y0, x1, y1.clamp(y0, self.rows.end)]
    }

    /// Draws a geom over what is there, where it is nearer, and farther than `floor` if there is one. What casts shadows does
    /// so coarsely, and with both sides of meshes that are open. Returns where in the picture it may be seen.
    pub fn draw(
        &mut self,
        number: u32,
        geom: &Geom,
        (assets, view): (&Assets, &View),
        floor: Option<&[f32]>,
        caster: bool,
    ) -> Option<Region> {
        let region = touched(geom, assets, view)?;
        let part = self.part(region);
        if part[1] == part[3] {
            return Some(region);
        }
        match geom.shape {
            Shape::Mesh(mesh) => {
                let mesh = assets.meshes.get(mesh)?;
                let number_of_level = mesh.level_for(cell(mesh, geom, view, caster));
                let level = mesh.level(number_of_level);
                let place = u32::try_from(number_of_level).unwrap_or(0);
                let both_sides = caster && !mesh.is_closed();
                self.mesh((number, place), geom, level, (view, part[1]..part[3]), floor, both_sides);
            }
            shape => {
                let (_, halves) = shape.bounds();
                let outline = Outline::new(geom, halves, view);
                self.shape(number, &Posed::new(geom, view)?, part, &outline, floor);
            }
        }
        Some(region)
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn shape(
        &mut self,
        number: u32,
        pose: &Posed,
        [left, y0, right, y1]: Region,
        outline: &Outline,
        floor: Option<&[f32]>,
    ) {
        let [mut lows, mut highs] = std::mem::take(&mut self.outline);
        outline.reach(y0..y1, &mut lows, &mut highs);
        for (y, (&low, &high)) in (y0..y1).zip(lows.iter().zip(&highs)) {
            // A hair wider than computed.
            let (low, high) = ((low - 0.01).max(left as f32), (high + 0.01).min(right as f32));
            if low >= high {
                continue;
            }
            let (x0, x1) = (low as usize, (high as usize + 1).min(right));
            let (span, columns) = (self.span(y, x0, x1), x0 * self.samples..x1 * self.samples);
            let samples = Samples {
                at: self.at.each_ref().map(|at| &at[columns.clone()]),
                floor: floor.map_or(&self.free[columns], |floor| &floor[span.clone()]),
                depths: &mut self.depths[span.clone()],
                ids: &mut self.ids[span],
            };
            pose.enter(&pose.row(y), number, samples);
        }
        self.outline = [lows, highs];
    }

    #[allow(clippy::cast_possible_truncation)]
    fn mesh(
        &mut self,
        (number, place): (u32, u32),
        geom: &Geom,
        level: &Level,
        (view, rows): (&View, Range<usize>),
        floor: Option<&[f32]>,
        both_sides: bool,
    ) {
        let mut vertices = std::mem::take(&mut self.vertices);
        vertices.resize(level.places.len(), [0.0; 4]);
        // Local coordinates to pixels, as a matrix: what `project` does with the three axes.
        let ([ox, oy, ow], depth) = view.project(geom.position);
        let axes: [V3; 3] = std::array::from_fn(|k| std::array::from_fn(|i| geom.rotation[3 * i + k]));
        let turned = axes.map(|axis| {
            let (x, y, z) = (dot(axis, view.right), dot(axis, view.up), dot(axis, view.forward));
            let w = if view.orthographic { 0.0 } else { z };
            [(x - view.left * w) * view.dense[0], (view.top * w - y) * view.dense[1], w, z]
        });
        to_pixels(&level.places, &turned, [ox, oy, ow, depth], &mut vertices);
        // Rows run downwards, so that what is counterclockwise to the eye is clockwise in pixels.
        let front = if view.mirrored { 1.0 } else { -1.0 };
        let front = if both_sides { 0.0 } else { front };
        let way = Way { front, near: view.near, floor, rows };
        dispatch_avx2(Faces { layers: self, number: (number, place), level, vertices: &vertices, way });
        self.vertices = vertices;
    }

    /// Draws a triangle in front of the camera, if it faces it (`front` times its area is positive, or 0).
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    #[inline(always)]
    fn triangle(&mut self, simd: impl F32x8, number: (u32, u32, u32), [a, b, c]: [[f32; 4]; 3], way: &Way<'_>) {
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if area * way.front < 0.0 || area.abs() <= 1e-12 || !area.is_finite() {
            return;
        }
        // Pixels of which a sample may be inside.
        let [first, last] = self.reach;
        let low = |k: usize| (a[k].min(b[k]).min(c[k]) - last[k] + 1.0) as i32;
        let high = |k: usize| (a[k].max(b[k]).max(c[k]) - first[k] + 1.0) as i32;
        let (x0, y0) = (low(0).max(0), low(1).max(0));
        let x1 = high(0).min(self.width as i32);
        let (first, last) = (y0.max(way.rows.start as i32), high(1).min(way.rows.end as i32));
        if x0 >= x1 || first >= last {
            return;
        }
        // Of the picture, not of the rows: rounding is to be the same wherever rows begin.
        let base = [x0 as f32, y0 as f32];
        let by = 1.0 / area;
        let corner = |p: [f32; 4]| (p[0] - base[0], p[1] - base[1], by / p[2]);
        let (a, b, c, depths) = (corner(a), corner(b), corner(c), [a[3], b[3], c[3]]);
        // A corner's share falls to 0 at the opposite side; divided by w, it is linear on the screen.
        let share = |p: (f32, f32, f32), q: (f32, f32, f32), r: (f32, f32, f32)| {
            [(q.1 - r.1) * p.2, (r.0 - q.0) * p.2, (q.0 * r.1 - q.1 * r.0) * p.2]
        };
        let shares = [share(a, b, c), share(b, c, a), share(c, a, b)];
        let region = [x0 as usize, first as usize, x1 as usize, last as usize];
        self.fill(simd, number, base, shares, depths, region, way);
    }

    /// Draws a triangle of which a part is too near to be seen.
    #[allow(clippy::cast_possible_truncation)]
    #[cold]
    fn crossing(&mut self, number: (u32, u32, u32), corners: [[f32; 4]; 3], way: &Way<'_>) {
        // A share divided by w is linear on the screen: the inverse of the matrix of the corners.
        let [a, b, c] =
            corners.map(|[x, y, w, _]| [f64::from(x) * f64::from(w), f64::from(y) * f64::from(w), f64::from(w)]);
        let wedge = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let (bc, ca, ab) = (wedge(b, c), wedge(c, a), wedge(a, b));
        let determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2];
        if determinant * f64::from(way.front) < 0.0 || determinant == 0.0 || !determinant.is_finite() {
            return;
        }
        let shares = [bc, ca, ab].map(|row| row.map(|x| (x / determinant) as f32));
        let region = [0, way.rows.start, self.width, way.rows.end];
        self.fill(Portable, number, [0.0; 2], shares, corners.map(|corner| corner[3]), region, way);
    }

    /// Draws a triangle by the shares of its corners, divided by `w`, within a region, whose left edge is that of the base.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::too_many_arguments)]
    #[inline(always)]
    fn fill(
        &mut self,
        simd: impl F32x8,
        (geom, level, face): (u32, u32, u32),
        base: [f32; 2],
        shares: [[f32; 3]; 3],
        depths: [f32; 3],
        [x0, y0, x1, y1]: Region,
        way: &Way<'_>,
    ) {
        let [p, q, r] = shares;
        let [u, v, w] = depths;
        let depth = [p[0] * u + q[0] * v + r[0] * w, p[1] * u + q[1] * v + r[1] * w, p[2] * u + q[2] * v + r[2] * w];
        // Neighbours overlap by a hair, so that no sample falls between them.
        let sum = [p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]];
        let mut lines = [p, q, r, depth];
        for line in &mut lines[..3] {
            for (x, sum) in line.iter_mut().zip(sum) {
                *x += HAIR * sum;
            }
        }
        for x in &mut lines[3] {
            *x *= 1.0 + 3.0 * HAIR;
        }
        // Their values at the first samples right of and below the base, and by how much they grow to the right.
        let (across, down) = (simd.load(&self.lanes[0]), simd.load(&self.lanes[1]));
        let (mut corner, mut slopes) = ([simd.splat(0.0); 4], [simd.splat(0.0); 4]);
        for (k, [x, y, constant]) in lines.into_iter().enumerate() {
            slopes[k] = simd.splat(x);
            let lanes = simd.add(simd.mul(slopes[k], across), simd.mul(simd.splat(y), down));
            corner[k] = simd.add(simd.splat(constant), lanes);
        }
        let (none, near, pixels) = (simd.splat(0.0), simd.splat(way.near), simd.splat((LANES / self.samples) as f32));
        let id = TRIANGLE | self.triangles.len() as u32;
        let wide = ((x1 - x0) * self.samples).next_multiple_of(LANES);
        let mut drawn = simd.gt(none, none);
        for y in y0..y1 {
            let begin = self.span(y, x0, x0).start;
            let row = begin..begin + wide;
            let floor = way.floor.map_or(&self.free[..wide], |floor| &floor[row.clone()]).as_chunks().0;
            let depths = self.depths[row.clone()].as_chunks_mut().0;
            let ids = self.ids[row].as_chunks_mut().0;
            let rows = y as f32 - base[1];
            let mut left = corner;
            for (left, line) in left.iter_mut().zip(&lines) {
                *left = simd.add(*left, simd.splat(line[1] * rows));
            }
            let mut column = none;
            for ((depths, ids), floor) in depths.iter_mut().zip(ids).zip(floor) {
                let mut at = left;
                for (at, slope) in at.iter_mut().zip(slopes) {
                    *at = simd.add(*at, simd.mul(slope, column));
                }
                let [p, q, r, depth] = at;
                let inside = simd.ge(simd.min(simd.min(p, q), r), none);
                // Where all are 0, this is no number, and not near.
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

    /// The geom behind a number.
    #[inline]
    pub fn geom(&self, id: u32) -> u32 {
        match id & TRIANGLE {
            0 => id,
            _ => self.owners[(id & !TRIANGLE) as usize],
        }
    }
}

/// Edges of a box.
const EDGES: usize = 12;

/// The outline of a box around a geom: where it is in each row.
struct Outline {
    /// Its edges; `None` where a corner is behind the camera.
    edges: Option<Edges>,
}

/// Edges on the screen.
#[derive(Default)]
struct Edges {
    left: [f32; EDGES],
    right: [f32; EDGES],
    top: [f32; EDGES],
    bottom: [f32; EDGES],
    /// A place on each, and how far to the right it goes in a row.
    x: [f32; EDGES],
    y: [f32; EDGES],
    slope: [f32; EDGES],
}

impl Outline {
    /// Of a box of these halves around a geom.
    fn new(geom: &Geom, halves: V3, view: &View) -> Self {
        let mut corners = [[0.0; 2]; 8];
        for (number, corner) in corners.iter_mut().enumerate() {
            let local = std::array::from_fn(|k| if number >> k & 1 == 1 { halves[k] } else { -halves[k] });
            let ([x, y, w], depth) = view.project(add(geom.position, rotate(&geom.rotation, local)));
            if !(depth > view.near && x.is_finite() && y.is_finite()) {
                return Self { edges: None };
            }
            *corner = [x / w, y / w];
        }
        let mut edges = Edges::default();
        let ends = (0..8).flat_map(|a| [a | 1, a | 2, a | 4].map(|b| (a, b))).filter(|(a, b)| a != b);
        for (i, (a, b)) in ends.enumerate() {
            let ([ax, ay], [bx, by]) = (corners[a], corners[b]);
            (edges.left[i], edges.right[i], edges.x[i]) = (ax.min(bx), ax.max(bx), ax);
            (edges.top[i], edges.bottom[i], edges.y[i]) = (ay.min(by), ay.max(by), ay);
            edges.slope[i] = if by == ay { 1e30 } else { (bx - ax) / (by - ay) };
        }
        Self { edges: Some(edges) }
    }

    /// How far to the left and right it reaches in rows.
    fn reach(&self, rows: Range<usize>, lows: &mut Vec<f32>, highs: &mut Vec<f32>) {
        lows.clear();
        highs.clear();
        match &self.edges {
            Some(edges) => {
                lows.resize(rows.len(), f32::INFINITY);
                highs.resize(rows.len(), f32::NEG_INFINITY);
                widen(edges, rows.start, lows, highs);
            }
            None => {
                lows.resize(rows.len(), f32::NEG_INFINITY);
                highs.resize(rows.len(), f32::INFINITY);
            }
        }
    }
}

/// How large cells of a mesh's version may be so that one does not see them.
pub(crate) fn cell(mesh: &Mesh, geom: &Geom, view: &View, caster: bool) -> f32 {
    let (low, high) = mesh.bounds();
    let reach = 0.5 * length([high[0] - low[0], high[1] - low[1], high[2] - low[2]]);
    let middle = add(geom.position, rotate(&geom.rotation, scale(add(low, high), 0.5)));
    let nearest = view.project(middle).1 - reach;
    (if caster { COARSE } else { INVISIBLE }) / view.pixels_at(nearest)
}

/// The part of a picture a geom can be seen in.
pub(crate) fn touched(geom: &Geom, assets: &Assets, view: &View) -> Option<Region> {
    if !geom.position.iter().chain(&geom.rotation).all(|x| x.is_finite()) {
        return None;
    }
    let (middle, halves) = match geom.shape {
        Shape::Mesh(mesh) => {
            let (low, high) = assets.meshes.get(mesh)?.bounds();
            (scale(add(low, high), 0.5), std::array::from_fn(|k| 0.5 * (high[k] - low[k])))
        }
        shape => shape.bounds(),
    };
    if !halves.iter().all(|half| half.is_finite() && *half >= 0.0) || halves == [0.0; 3] {
        return None;
    }
    let middle = add(geom.position, rotate(&geom.rotation, middle));
    let sides = std::array::from_fn(|k| {
        let mut side = [0.0; 3];
        side[k] = halves[k];
        rotate(&geom.rotation, side)
    });
    view.touched(middle, sides)
}

/// The triangles of a mesh, whose vertices are on the screen, to be drawn.
struct Faces<'a> {
    layers: &'a mut Layers,
    /// The geom, and the version of its mesh.
    number: (u32, u32),
    level: &'a Level,
    vertices: &'a [[f32; 4]],
    way: Way<'a>,
}

/// How triangles are drawn.
struct Way<'a> {
    /// The sign of the areas of those that are; 0 for all.
    front: f32,
    /// What is not farther than this is not seen, nor what is not farther than the floor.
    near: f32,
    floor: Option<&'a [f32]>,
    /// In these rows.
    rows: Range<usize>,
}

impl Kernel for Faces<'_> {
    type Output = ();

    #[allow(clippy::cast_possible_truncation)]
    #[inline(always)]
    fn run<L: swm_simd::Level>(self) {
        let simd = L::f32x8();
        let Self { layers, number, level, vertices, way } = self;
        for (face, &[a, b, c]) in level.faces.iter().enumerate() {
            let corners = [vertices[a as usize], vertices[b as usize], vertices[c as usize]];
            let number = (number.0, number.1, face as u32);
            let [p, q, r] = corners.map(|corner| corner[3] > way.near);
            if p & q & r {
                layers.triangle(simd, number, corners, &way);
            } else if p | q | r {
                layers.crossing(number, corners, &way);
            }
        }
    }
}

vectorize! {
    /// Widens what edges reach in rows, from `top` on.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    fn widen(edges: &Edges, top: usize, lows: &mut [f32], highs: &mut [f32]) {
        let n = lows.len();
        let highs = &mut highs[..n];
        for k in 0..EDGES {
            let (x, y, slope) = (edges.x[k], edges.y[k], edges.slope[k]);
            let (left, right, upper, lower) = (edges.left[k], edges.right[k], edges.top[k], edges.bottom[k]);
            let at = |row: f32| {
                let x = x + (row - y) * slope;
                let x = if x > left { x } else { left };
                if x < right { x } else { right }
            };
            for i in 0..n {
                // The part of the edge within the row.
                let above = top as f32 + i as u32 as i32 as f32;
                let (p, q) = (at(above), at(above + 1.0));
                let (low, high) = if p < q { (p, q) } else { (q, p) };
                let touched = (upper <= above + 1.0) & (lower >= above);
                lows[i] = if touched & (low < lows[i]) { low } else { lows[i] };
                highs[i] = if touched & (high > highs[i]) { high } else { highs[i] };
            }
        }
    }

    /// Vertices in pixels, `w` and depth.
    fn to_pixels(places: &[V3], axes: &[[f32; 4]; 3], origin: [f32; 4], vertices: &mut [[f32; 4]]) {
        for (place, vertex) in places.iter().zip(vertices) {
            let at = |k: usize| origin[k] + axes[0][k] * place[0] + axes[1][k] * place[1] + axes[2][k] * place[2];
            let w = at(2);
            *vertex = [at(0) / w, at(1) / w, w, at(3)];
        }
    }
}
