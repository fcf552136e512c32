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
const INVISIBLE: f32 = 0.4;

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
    /// Depths; before anything is drawn, how far one sees.
    pub depths: Vec<f32>,
    /// Places of geoms, or [`TRIANGLE`] and the place of a triangle.
    pub ids: Vec<u32>,
    /// Triangles that were drawn since the start.
    pub triangles: Vec<Triangle>,
    /// Scratch: depths of a row.
    row: Vec<f32>,
    /// Scratch: vertices of a mesh in pixels times `w`, `w`, and depth.
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

    /// Draws a geom over what is there, where it is nearer, and farther than `floor` if there is one. Returns where it may be
    /// seen.
    pub fn draw(
        &mut self,
        number: u32,
        geom: &Geom,
        (assets, view): (&Assets, &View),
        floor: Option<&[f32]>,
        both_sides: bool,
    ) -> Option<Region> {
        let region = touched(geom, assets, view)?;
        match geom.shape {
            Shape::Mesh(mesh) => {
                let mesh = assets.meshes.get(mesh)?;
                let (low, high) = mesh.bounds();
                let reach = 0.5 * length([high[0] - low[0], high[1] - low[1], high[2] - low[2]]);
                let middle = add(geom.position, rotate(&geom.rotation, scale(add(low, high), 0.5)));
                let nearest = view.project(middle).1 - reach;
                let number_of_level = mesh.level_for(INVISIBLE / view.pixels_at(nearest));
                let level = mesh.level(number_of_level);
                let place = u32::try_from(number_of_level).unwrap_or(0);
                self.mesh((number, place), geom, level, view, floor, both_sides);
            }
            _ => self.shape(number, &Posed::new(geom, view)?, region, floor),
        }
        Some(region)
    }

    #[allow(clippy::cast_precision_loss)]
    fn shape(&mut self, number: u32, pose: &Posed, [x0, y0, x1, y1]: Region, floor: Option<&[f32]>) {
        self.row.resize(self.width, 0.0);
        for y in y0..y1 {
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
        for (face, corners) in level.faces.iter().enumerate() {
            let corners = corners.map(|corner| vertices[corner as usize]);
            let number = (number, place, u32::try_from(face).unwrap_or(u32::MAX));
            self.triangle(number, corners, if both_sides { 0.0 } else { front }, view.near, floor);
        }
        self.vertices = vertices;
    }

    /// Draws a triangle, if it faces the camera (`front` times its determinant is positive), or from both sides where `front` is 0.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn triangle(
        &mut self,
        (geom, level, face): (u32, u32, u32),
        corners: [[f32; 4]; 3],
        front: f32,
        near: f32,
        floor: Option<&[f32]>,
    ) {
        let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        let behind = corners.iter().filter(|corner| corner[3] <= near).count();
        if behind == 3 {
            return;
        }
        if behind == 0 {
            for [x, y, w, _] in corners {
                let (x, y) = (x / w, y / w);
                bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
            }
        } else {
            bounds = [0.0, 0.0, self.width as f32, self.height as f32];
        }
        // Samples are at least an eighth of a pixel from the edges of their pixel.
        let low = |x: f32, most: usize| ((x + 0.125).floor() as usize).min(most);
        let high = |x: f32, most: usize| ((x + 0.875).floor() as usize).min(most);
        let [x0, y0] = [low(bounds[0], self.width), low(bounds[1], self.height)];
        let [x1, y1] = [high(bounds[2], self.width), high(bounds[3], self.height)];
        if x0 >= x1 || y0 >= y1 {
            return;
        }
        // A share divided by w is linear on the screen: the inverse of the matrix of the corners.
        let base = [x0 as f64, y0 as f64];
        let [a, b, c] = corners.map(|[x, y, w, _]| {
            let w = f64::from(w);
            [f64::from(x) - base[0] * w, f64::from(y) - base[1] * w, w]
        });
        let wedge = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let (bc, ca, ab) = (wedge(b, c), wedge(c, a), wedge(a, b));
        let determinant = a[0] * bc[0] + a[1] * bc[1] + a[2] * bc[2];
        if determinant * f64::from(front) < 0.0 || determinant == 0.0 || !determinant.is_finite() {
            return;
        }
        let by = 1.0 / determinant;
        let shares = [bc, ca, ab].map(|row| row.map(|x| (x * by) as f32));
        let depths = corners.map(|corner| corner[3]);
        let depth = std::array::from_fn(|k| (0..3).map(|i| shares[i][k] * depths[i]).sum());
        let triangle = Triangle { geom, level, face, base: [x0 as f32, y0 as f32], shares, depth };
        let id = TRIANGLE | u32::try_from(self.triangles.len()).unwrap_or(0);
        let mut drawn = false;
        for y in y0..y1 {
            for (sample, offset) in self.pattern.iter().enumerate() {
                let at = self.place(y, sample);
                let dy = (y - y0) as f32 + offset[1];
                let [s, t, u] = shares.map(|[_, by, c]| by * dy + c);
                let z = depth[1] * dy + depth[2];
                for x in x0..x1 {
                    let dx = (x - x0) as f32 + offset[0];
                    let (s, t, u) = (s + shares[0][0] * dx, t + shares[1][0] * dx, u + shares[2][0] * dx);
                    if s.min(t).min(u) < 0.0 {
                        continue;
                    }
                    let far = (z + depth[0] * dx) / (s + t + u);
                    if far <= self.depths[at + x] && far > near && floor.is_none_or(|floor| far > floor[at + x]) {
                        self.depths[at + x] = far;
                        self.ids[at + x] = id;
                        drawn = true;
                    }
                }
            }
        }
        if drawn {
            self.triangles.push(triangle);
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

    /// Vertices in pixels.
    fn to_pixels(places: &[V3], axes: &[[f32; 4]; 3], origin: [f32; 4], vertices: &mut [[f32; 4]]) {
        for (place, vertex) in places.iter().zip(vertices) {
            *vertex = std::array::from_fn(|k| {
                origin[k] + axes[0][k] * place[0] + axes[1][k] * place[1] + axes[2][k] * place[2]
            });
        }
    }
}
