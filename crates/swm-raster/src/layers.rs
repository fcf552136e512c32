//! [`Layers`]: what is nearest at every sample of a picture, and how far it is.

use crate::cast::Posed;
use crate::mesh::Level;
use crate::scene::{Assets, Geom, Shape};
use crate::simd::vectorised;
use crate::vector::{V3, add, dot, length, rotate, scale};
use crate::view::View;

/// Nothing is there.
pub(crate) const NOTHING: u32 = u32::MAX >> 1;
/// Set where the number is that of a triangle, not of a geom.
pub(crate) const TRIANGLE: u32 = 1 << 31;

/// Cells of coarser meshes are at most so many pixels large.
const INVISIBLE: f32 = 0.6;

/// And so many texels large in maps of shadows.
const COARSE: f32 = 2.0;

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

/// The nearest thing at every sample, samples of a row one after the other.
#[derive(Default)]
pub(crate) struct Layers {
    pub width: usize,
    pub height: usize,
    pub samples: usize,
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
    /// Scratch: depths of a row.
    row: Vec<f32>,
    /// Scratch: vertices of a mesh in pixels, `w`, and depth.
    vertices: Vec<[f32; 4]>,
}

/// A triangle on the screen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Triangle {
    pub geom: u32,
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
    /// Forgets everything, for a picture of this size.
    pub fn start(&mut self, width: usize, height: usize, pattern: &'static [[f32; 2]]) {
        (self.width, self.height, self.samples, self.pattern) = (width, height, pattern.len(), pattern);
        let reach = |with: fn(f32, f32) -> f32, from: f32| {
            pattern.iter().fold([from; 2], |a, b| [with(a[0], b[0]), with(a[1], b[1])])
        };
        self.reach = [reach(f32::min, 1.0), reach(f32::max, 0.0)];
        let size = width * height * self.samples;
        self.depths.resize(size, 0.0);
        self.ids.resize(size, NOTHING);
        self.triangles.clear();
    }

    /// Empties it: one sees so far.
    pub fn clear(&mut self, far: f32) {
        self.depths.fill(far);
        self.ids.fill(NOTHING);
    }

    /// Where a row of samples is.
    #[inline]
    pub fn place(&self, y: usize, sample: usize) -> usize {
        (y * self.samples + sample) * self.width
    }

    /// Draws a geom over what is there, where it is nearer, and farther than `floor` if there is one. What casts shadows does
    /// so coarsely, and with both sides of meshes that are open. Returns where it may be seen.
    pub fn draw(
        &mut self,
        number: u32,
        geom: &Geom,
        (assets, view): (&Assets, &View),
        floor: Option<&[f32]>,
        caster: bool,
    ) -> Option<Region> {
        let region = touched(geom, assets, view)?;
        match geom.shape {
            Shape::Mesh(mesh) => {
                let mesh = assets.meshes.get(mesh)?;
                let (low, high) = mesh.bounds();
                let reach = 0.5 * length([high[0] - low[0], high[1] - low[1], high[2] - low[2]]);
                let middle = add(geom.position, rotate(&geom.rotation, scale(add(low, high), 0.5)));
                let nearest = view.project(middle).1 - reach;
                let number_of_level = mesh.level_for(if caster { COARSE } else { INVISIBLE } / view.pixels_at(nearest));
                let level = mesh.level(number_of_level);
                let place = u32::try_from(number_of_level).unwrap_or(0);
                self.mesh((number, place), geom, level, view, floor, caster && !mesh.is_closed());
            }
            shape => {
                let (_, halves) = shape.bounds();
                let outline = Outline::new(geom, halves, view);
                self.shape(number, &Posed::new(geom, view)?, region, &outline, floor);
            }
        }
        Some(region)
    }

    #[allow(clippy::cast_precision_loss)]
    fn shape(
        &mut self,
        number: u32,
        pose: &Posed,
        [left, y0, right, y1]: Region,
        outline: &Outline,
        floor: Option<&[f32]>,
    ) {
        self.row.resize(self.width, 0.0);
        for y in y0..y1 {
            let (x0, x1) = outline.span(y, left, right);
            if x0 >= x1 {
                continue;
            }
            for (sample, offset) in self.pattern.iter().enumerate() {
                let at = self.place(y, sample);
                let row = pose.row(x0 as f32 + offset[0], y as f32 + offset[1]);
                let found = &mut self.row[x0..x1];
                pose.enter(&row, found);
                let (depths, ids) = (&mut self.depths[at + x0..at + x1], &mut self.ids[at + x0..at + x1]);
                match floor {
                    None => nearer(found, depths, ids, number),
                    Some(floor) => nearer_than(found, &floor[at + x0..at + x1], depths, ids, number),
                }
            }
        }
    }

    #[allow(clippy::cast_possible_truncation)]
    fn mesh(
        &mut self,
        (number, place): (u32, u32),
        geom: &Geom,
        level: &Level,
        view: &View,
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
        for (face, &[a, b, c]) in level.faces.iter().enumerate() {
            let corners = [vertices[a as usize], vertices[b as usize], vertices[c as usize]];
            let number = (number, place, face as u32);
            let [p, q, r] = corners.map(|corner| corner[3] > view.near);
            if p & q & r {
                self.triangle(number, corners, front, view.near, floor);
            } else if p | q | r {
                self.crossing(number, corners, front, view.near, floor);
            }
        }
        self.vertices = vertices;
    }

    /// Draws a triangle in front of the camera, if it faces it (`front` times its area is positive), or from both sides where `front`
    /// is 0.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    #[inline]
    fn triangle(
        &mut self,
        number: (u32, u32, u32),
        [a, b, c]: [[f32; 4]; 3],
        front: f32,
        near: f32,
        floor: Option<&[f32]>,
    ) {
        let area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        if area * front < 0.0 || area.abs() <= 1e-12 || !area.is_finite() {
            return;
        }
        // Pixels of which a sample may be inside.
        let [first, last] = self.reach;
        let low = |k: usize| (a[k].min(b[k]).min(c[k]) - last[k] + 1.0) as i32;
        let high = |k: usize| (a[k].max(b[k]).max(c[k]) - first[k] + 1.0) as i32;
        let (x0, y0) = (low(0).max(0), low(1).max(0));
        let (x1, y1) = (high(0).min(self.width as i32), high(1).min(self.height as i32));
        if x0 >= x1 || y0 >= y1 {
            return;
        }
        let base = [x0 as f32, y0 as f32];
        let by = 1.0 / area;
        let corner = |p: [f32; 4]| (p[0] - base[0], p[1] - base[1], by / p[2]);
        let (a, b, c, depths) = (corner(a), corner(b), corner(c), [a[3], b[3], c[3]]);
        // A corner's share falls to 0 at the opposite side; divided by w, it is linear on the screen.
        let share = |p: (f32, f32, f32), q: (f32, f32, f32), r: (f32, f32, f32)| {
            [(q.1 - r.1) * p.2, (r.0 - q.0) * p.2, (q.0 * r.1 - q.1 * r.0) * p.2]
        };
        let shares = [share(a, b, c), share(b, c, a), share(c, a, b)];
        self.fill(number, base, shares, depths, [x0 as usize, y0 as usize, x1 as usize, y1 as usize], near, floor);
    }

    /// Draws a triangle of which a part is too near to be seen.
    #[allow(clippy::cast_possible_truncation)]
    #[cold]
    fn crossing(
        &mut self,
        number: (u32, u32, u32),
        corners: [[f32; 4]; 3],
        front: f32,
        near: f32,
        floor: Option<&[f32]>,
    ) {
        // A share divided by w is linear on the screen: the inverse of the matrix of the corners.
        let [a, b, c] =
            corners.map(|[x, y, w, _]| [f64::from(x) * f64::from(w), f64::from(y) * f64::from(w), f64::from(w)]);
        let wedge = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let (bc, ca, ab) = (wedge(b, c), wedge(c, a), wedge(a, b));
        let determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2];
        if determinant * f64::from(front) < 0.0 || determinant == 0.0 || !determinant.is_finite() {
            return;
        }
        let shares = [bc, ca, ab].map(|row| row.map(|x| (x / determinant) as f32));
        let whole = [0, 0, self.width, self.height];
        self.fill(number, [0.0; 2], shares, corners.map(|corner| corner[3]), whole, near, floor);
    }

    /// Draws a triangle by the shares of its corners, divided by `w`, within a region.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss, clippy::too_many_arguments)]
    #[inline]
    fn fill(
        &mut self,
        (geom, level, face): (u32, u32, u32),
        base: [f32; 2],
        shares: [[f32; 3]; 3],
        depths: [f32; 3],
        [x0, y0, x1, y1]: Region,
        near: f32,
        floor: Option<&[f32]>,
    ) {
        let [p, q, r] = shares;
        let [u, v, w] = depths;
        let depth = [p[0] * u + q[0] * v + r[0] * w, p[1] * u + q[1] * v + r[1] * w, p[2] * u + q[2] * v + r[2] * w];
        let sum = [p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]];
        let id = TRIANGLE | self.triangles.len() as u32;
        let mut drawn = false;
        for y in y0..y1 {
            for (sample, offset) in self.pattern.iter().enumerate() {
                let at = self.place(y, sample);
                let dy = y as f32 - base[1] + offset[1];
                let row = |line: [f32; 3]| line[1] * dy + line[2];
                let (p0, q0, r0, sum0, depth0) = (row(p), row(q), row(r), row(sum), row(depth));
                for x in x0..x1 {
                    let dx = x as f32 - base[0] + offset[0];
                    let sum = sum0 + sum[0] * dx;
                    // Neighbours overlap by a hair, so that no sample falls between them.
                    let edge = -1e-5 * sum;
                    if (p0 + p[0] * dx < edge) | (q0 + q[0] * dx < edge) | (r0 + r[0] * dx < edge) | (sum <= 0.0) {
                        continue;
                    }
                    let far = (depth0 + depth[0] * dx) / sum;
                    if far <= self.depths[at + x] && far > near && floor.is_none_or(|floor| far > floor[at + x]) {
                        self.depths[at + x] = far;
                        self.ids[at + x] = id;
                        drawn = true;
                    }
                }
            }
        }
        if drawn {
            self.triangles.push(Triangle { geom, level, face, base, shares, depth });
        }
    }

    /// The geom behind a number.
    #[inline]
    pub fn geom(&self, id: u32) -> u32 {
        match id & TRIANGLE {
            0 => id,
            _ => self.triangles[(id & !TRIANGLE) as usize].geom,
        }
    }
}

/// The outline of a box around a geom: where it is in each row.
struct Outline {
    /// Its corners in pixels; `None` where one of them is behind the camera.
    corners: Option<[[f32; 2]; 8]>,
}

impl Outline {
    /// Of a box of these halves around a geom.
    fn new(geom: &Geom, halves: V3, view: &View) -> Self {
        let mut corners = [[0.0; 2]; 8];
        for (number, corner) in corners.iter_mut().enumerate() {
            let local = std::array::from_fn(|k| if number >> k & 1 == 1 { halves[k] } else { -halves[k] });
            let ([x, y, w], depth) = view.project(add(geom.position, rotate(&geom.rotation, local)));
            if !(depth > view.near && x.is_finite() && y.is_finite()) {
                return Self { corners: None };
            }
            *corner = [x / w, y / w];
        }
        Self { corners: Some(corners) }
    }

    /// The pixels of a row from `left` to before `right` that it may touch.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn span(&self, y: usize, left: usize, right: usize) -> (usize, usize) {
        let Some(corners) = &self.corners else { return (left, right) };
        let (top, bottom) = (y as f32, y as f32 + 1.0);
        let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
        for a in 0..8 {
            for b in [a | 1, a | 2, a | 4] {
                let ([ax, ay], [bx, by]) = (corners[a], corners[b]);
                if a == b || ay.min(by) > bottom || ay.max(by) < top {
                    continue;
                }
                // The part of the edge within the row.
                let slope = (bx - ax) / if by == ay { 1.0 } else { by - ay };
                let at = |y: f32| {
                    let x = ax + (y - ay) * slope;
                    x.clamp(ax.min(bx), ax.max(bx))
                };
                let (p, q) = if by == ay { (ax, bx) } else { (at(top), at(bottom)) };
                (low, high) = (low.min(p).min(q), high.max(p).max(q));
            }
        }
        // A hair wider than computed.
        let (low, high) = ((low - 0.01).max(left as f32), (high + 0.01).min(right as f32));
        if low < high { (low as usize, (high as usize + 1).min(right)) } else { (left, left) }
    }
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

vectorised! {
    /// Takes over what is nearer.
    fn nearer(found: &[f32], depths: &mut [f32], ids: &mut [u32], id: u32) {
        let n = found.len();
        let (depths, ids) = (&mut depths[..n], &mut ids[..n]);
        for i in 0..n {
            let closer = found[i] <= depths[i];
            depths[i] = if closer { found[i] } else { depths[i] };
            ids[i] = if closer { id } else { ids[i] };
        }
    }

    /// Takes over what is nearer, behind a floor.
    fn nearer_than(found: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32], id: u32) {
        let n = found.len();
        let (floor, depths, ids) = (&floor[..n], &mut depths[..n], &mut ids[..n]);
        for i in 0..n {
            let closer = (found[i] <= depths[i]) & (found[i] > floor[i]);
            depths[i] = if closer { found[i] } else { depths[i] };
            ids[i] = if closer { id } else { ids[i] };
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
