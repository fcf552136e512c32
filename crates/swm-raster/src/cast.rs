//! Ray casting: the points at which a row of rays enters a shape, and the surface at these points.
//!
//! Shapes are scaled to unit size ([`PosedShape`]), so that a few kernels suffice. The kernels are loops without
//! branches over the rays of a row. Rays begin near the shape and not at the camera, because rounding would lose
//! small shapes far away.

use crate::scene::{Geom, Shape};
use crate::vector::{V3, add, scale, sub, unrotate};
use crate::view::View;
use swm_simd::vectorize;

/// A shape of unit size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Unit {
    /// The rectangle z = 0 with these half sides.
    Plane([f32; 2]),
    /// The sphere of radius 1.
    Sphere,
    /// The capsule of radius 1 along z, with half the length of its cylinder.
    Capsule(f32),
    /// The cylinder of radius 1 with z from -1 to 1.
    Cylinder,
    /// The cube from -1 to 1.
    Cube,
}

/// Lower bound of all sizes.
const SMALLEST: f32 = 1e-6;

/// A shape of unit size, and the rays of a view in its coordinates.
///
/// The ray of pixel (x, y) reaches depth `depth` at `position + (x - base[0]) * positions[0] + (y - base[1]) *
/// positions[1]`; its direction is the same sum of `direction` and `directions`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PosedShape {
    pub unit: Unit,
    /// The scale from unit coordinates to the geom's local coordinates.
    pub sizes: V3,
    pub base: [f32; 2],
    pub depth: f32,
    pub near: f32,
    pub position: V3,
    pub positions: [V3; 2],
    pub direction: V3,
    pub directions: [V3; 2],
}

/// The rays through a row of pixels. At `x` pixels from the left and `y` from the upper edge of the row, a ray reaches
/// the depth of its [`PosedShape`] at `position + x * positions[0] + y * positions[1]`; its direction is the same sum
/// of `direction` and `directions`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row {
    base: f32,
    position: V3,
    positions: [V3; 2],
    direction: V3,
    directions: [V3; 2],
    depth: f32,
    near: f32,
}

/// Neighbouring samples with their depths and ids.
pub(crate) struct Samples<'a> {
    /// Coordinates of the samples, from the left of the frame and from the upper edge of the row.
    pub at: [&'a [f32]; 2],
    /// Depths that a geom must lie behind.
    pub floor: &'a [f32],
    pub depths: &'a mut [f32],
    pub ids: &'a mut [u32],
}

impl Shape {
    /// Returns the unit shape and its sizes, or `None` for a mesh.
    pub(crate) fn unit(&self) -> Option<(Unit, V3)> {
        let (unit, sizes) = match *self {
            Self::Plane(x, y) => (Unit::Plane([x.half, y.half]), [1.0; 3]),
            Self::Ellipsoid(radii) => (Unit::Sphere, radii),
            Self::Capsule(radius, half) => (Unit::Capsule((half / radius.max(SMALLEST)).max(0.0)), [radius; 3]),
            Self::Cylinder(radius, half) => (Unit::Cylinder, [radius, radius, half]),
            Self::Box(halves) => (Unit::Cube, halves),
            Self::Mesh(_) => return None,
        };
        Some((unit, sizes.map(|size| size.max(SMALLEST))))
    }

    /// Returns the centre and half sides of the local bounding box; zeros for a mesh.
    pub(crate) fn bounds(&self) -> (V3, V3) {
        let halves = match *self {
            Self::Plane(x, y) => [x.half, y.half, 0.0],
            Self::Ellipsoid(radii) => radii,
            Self::Capsule(radius, half) => [radius, radius, radius + half],
            Self::Cylinder(radius, half) => [radius, radius, half],
            Self::Box(halves) => halves,
            Self::Mesh(_) => [0.0; 3],
        };
        ([0.0; 3], halves)
    }
}

impl PosedShape {
    /// Returns the pose of a geom in a view, or `None` for a mesh.
    pub fn new(geom: &Geom, view: &View) -> Option<Self> {
        let (unit, sizes) = geom.shape.unit()?;
        let rays = view.rays();
        let ([x, y, w], depth) = view.project(geom.position);
        // The pixel and depth near the shape, clamped to the frame if the shape is behind the camera.
        let inside = |at: f32, most: usize| {
            let most = most as f32;
            if at.is_finite() { at.clamp(0.0, most) } else { 0.5 * most }
        };
        let base = [inside(x / w, view.width), inside(y / w, view.height)];
        let depth = if depth.is_finite() { depth.max(view.near) } else { view.near };
        let local = |a: V3| {
            let a = unrotate(&geom.rotation, a);
            [a[0] / sizes[0], a[1] / sizes[1], a[2] / sizes[2]]
        };
        let at = |from: V3, steps: [V3; 2]| add(from, add(scale(steps[0], base[0]), scale(steps[1], base[1])));
        let direction = at(rays.direction, rays.directions);
        let position = add(sub(at(rays.origin, rays.origins), geom.position), scale(direction, depth));
        let positions = [0, 1].map(|k| local(add(rays.origins[k], scale(rays.directions[k], depth))));
        Some(Self {
            unit,
            sizes,
            base,
            depth,
            near: view.near,
            position: local(position),
            positions,
            direction: local(direction),
            directions: rays.directions.map(local),
        })
    }

    /// Returns the rays of row `y`.
    pub fn row(&self, y: usize) -> Row {
        let down = y as f32 - self.base[1];
        Row {
            base: self.base[0],
            position: add(self.position, scale(self.positions[1], down)),
            positions: self.positions,
            direction: add(self.direction, scale(self.directions[1], down)),
            directions: self.directions,
            depth: self.depth,
            near: self.near,
        }
    }

    /// Writes the shape as `id` to the samples in which it is the nearest shape.
    pub fn enter(&self, row: &Row, id: u32, samples: Samples<'_>) {
        let Samples { at: [x, y], floor, depths, ids } = samples;
        match self.unit {
            Unit::Plane(halves) => enter_plane(&self.rectangle(halves), row, id, x, y, floor, depths, ids),
            Unit::Sphere => enter_sphere(row, id, x, y, floor, depths, ids),
            Unit::Capsule(half) => enter_capsule(&Capsule(half), row, id, x, y, floor, depths, ids),
            Unit::Cylinder => enter_cylinder(row, id, x, y, floor, depths, ids),
            Unit::Cube => enter_cube(row, id, x, y, floor, depths, ids),
        }
    }

    fn rectangle(&self, halves: [f32; 2]) -> Rectangle {
        Rectangle(halves, self.near - self.depth)
    }

    /// Computes the visible surface at pixel positions: depths relative to the depth of the pose, unit coordinates, and
    /// normals in unit coordinates, which are not normalised. Rays that miss the shape get the nearest point of the
    /// shape's outline.
    pub fn surface(
        &self,
        x: &[f32],
        y: &[f32],
        depths: &mut [f32],
        positions: [&mut [f32]; 3],
        normals: [&mut [f32]; 3],
    ) {
        let ([px, py, pz], [nx, ny, nz]) = (positions, normals);
        match self.unit {
            Unit::Plane(halves) => {
                surface_plane(&self.rectangle(halves), self, x, y, depths, px, py, pz, nx, ny, nz);
            }
            Unit::Sphere => surface_sphere(self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Capsule(half) => surface_capsule(&Capsule(half), self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Cylinder => surface_cylinder(self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Cube => surface_cube(self, x, y, depths, px, py, pz, nx, ny, nz),
        }
    }
}

/// A ray: its position at the depth of the pose, and its direction.
#[derive(Clone, Copy)]
struct Ray {
    p: V3,
    d: V3,
}

impl Row {
    #[inline(always)]
    fn ray(&self, x: f32, y: f32) -> Ray {
        let x = x - self.base;
        let at = |from: V3, steps: &[V3; 2]| add(from, add(scale(steps[0], x), scale(steps[1], y)));
        Ray { p: at(self.position, &self.positions), d: at(self.direction, &self.directions) }
    }
}

impl PosedShape {
    #[inline(always)]
    fn ray(&self, x: f32, y: f32) -> Ray {
        let (x, y) = (x - self.base[0], y - self.base[1]);
        let at = |from: V3, steps: &[V3; 2]| add(from, add(scale(steps[0], x), scale(steps[1], y)));
        Ray { p: at(self.position, &self.positions), d: at(self.direction, &self.directions) }
    }
}

/// Returns `x`, or a small value if `x` is too close to 0 for a division.
#[inline(always)]
fn nonzero(x: f32) -> f32 {
    if x.abs() > 1e-12 { x } else { 1e-12 }
}

/// Intersects the unit sphere around (0, 0, z). Returns the ray parameter of the entry, and 1 minus the squared
/// distance from the centre, which is negative for a miss.
#[inline(always)]
fn ball(ray: Ray, z: f32) -> (f32, f32) {
    let Ray { p: [x, y, pz], d: [a, b, c] } = ray;
    let pz = pz - z;
    let square = (a * a + b * b + c * c).max(1e-24);
    let k = -(x * a + y * b + pz * c) / square;
    let (fx, fy, fz) = (x + k * a, y + k * b, pz + k * c);
    let inside = 1.0 - (fx * fx + fy * fy + fz * fz);
    (k - (inside.max(0.0) / square).sqrt(), inside)
}

/// Intersects the infinite cylinder of radius 1 along z. Returns the ray parameters of entry and exit, and 1 minus
/// the squared distance from the axis.
#[inline(always)]
fn tube(ray: Ray) -> (f32, f32, f32) {
    let Ray { p: [x, y, _], d: [a, b, _] } = ray;
    let square = (a * a + b * b).max(1e-24);
    let k = -(x * a + y * b) / square;
    let (fx, fy) = (x + k * a, y + k * b);
    let inside = 1.0 - (fx * fx + fy * fy);
    let half = (inside.max(0.0) / square).sqrt();
    (k - half, k + half, inside)
}

/// Intersects the slab from -1 to 1 of one coordinate. Returns the ray parameters of entry and exit.
#[inline(always)]
fn slab(p: f32, d: f32) -> (f32, f32) {
    let by = 1.0 / nonzero(d);
    let (a, b) = ((-1.0 - p) * by, (1.0 - p) * by);
    (a.min(b), a.max(b))
}

/// A unit shape that rays intersect.
trait Solid {
    /// Returns the ray parameter of the entry, and whether the ray hits.
    fn enter(&self, ray: Ray) -> (f32, bool);

    /// Returns the ray parameter of the entry, or of the closest approach for a miss, and the position and normal
    /// at this parameter.
    fn surface(&self, ray: Ray) -> (f32, V3, V3);
}

/// A rectangle at z = 0: half sides, and the smallest ray parameter in front of the camera.
struct Rectangle([f32; 2], f32);
struct Sphere;
/// A capsule: half the length of its cylinder.
struct Capsule(f32);
struct Cylinder;
struct Cube;

impl Solid for Rectangle {
    #[inline(always)]
    fn enter(&self, Ray { p, d }: Ray) -> (f32, bool) {
        let t = -p[2] / nonzero(d[2]);
        (t, ((p[0] + t * d[0]).abs() <= self.0[0]) & ((p[1] + t * d[1]).abs() <= self.0[1]))
    }

    #[inline(always)]
    fn surface(&self, Ray { p, d }: Ray) -> (f32, V3, V3) {
        // A pixel whose centre lies past the horizon or the edge takes a point far away on the plane.
        let parameter = -p[2] / nonzero(d[2]);
        let parameter = if parameter > self.1 { parameter } else { 1e6 };
        (parameter, [p[0] + parameter * d[0], p[1] + parameter * d[1], 0.0], [0.0, 0.0, 1.0])
    }
}

impl Solid for Sphere {
    #[inline(always)]
    fn enter(&self, ray: Ray) -> (f32, bool) {
        let (t, inside) = ball(ray, 0.0);
        (t, inside >= 0.0)
    }

    #[inline(always)]
    fn surface(&self, ray: Ray) -> (f32, V3, V3) {
        let (parameter, _) = ball(ray, 0.0);
        let at = add(ray.p, scale(ray.d, parameter));
        (parameter, at, at)
    }
}

impl Solid for Capsule {
    #[inline(always)]
    fn enter(&self, ray: Ray) -> (f32, bool) {
        let (body, _, inside) = tube(ray);
        let on_body = (inside >= 0.0) & ((ray.p[2] + body * ray.d[2]).abs() <= self.0);
        let (upper, in_upper) = ball(ray, self.0);
        let (lower, in_lower) = ball(ray, -self.0);
        let mut t = if on_body { body } else { f32::INFINITY };
        t = if in_upper >= 0.0 { t.min(upper) } else { t };
        t = if in_lower >= 0.0 { t.min(lower) } else { t };
        (t, t < f32::INFINITY)
    }

    #[inline(always)]
    fn surface(&self, ray: Ray) -> (f32, V3, V3) {
        let (hit, is_hit) = self.enter(ray);
        // A ray that misses gets the point closest to the axis or to the nearer end.
        let (body, _, _) = tube(ray);
        let end = (ray.p[2] + body * ray.d[2]).clamp(-self.0, self.0);
        let (rim, _) = ball(ray, end);
        let parameter = if is_hit { hit } else { rim };
        let at = add(ray.p, scale(ray.d, parameter));
        (parameter, at, [at[0], at[1], at[2] - at[2].clamp(-self.0, self.0)])
    }
}

impl Solid for Cylinder {
    #[inline(always)]
    fn enter(&self, ray: Ray) -> (f32, bool) {
        let (enter, leave, inside) = tube(ray);
        let (low, high) = slab(ray.p[2], ray.d[2]);
        let t = enter.max(low);
        (t, (inside >= 0.0) & (t <= leave.min(high)))
    }

    #[inline(always)]
    fn surface(&self, ray: Ray) -> (f32, V3, V3) {
        let (enter, _, _) = tube(ray);
        let (low, _) = slab(ray.p[2], ray.d[2]);
        let parameter = enter.max(low);
        let at = add(ray.p, scale(ray.d, parameter));
        let end = low > enter;
        let up = if ray.d[2] > 0.0 { -1.0 } else { 1.0 };
        (parameter, at, [if end { 0.0 } else { at[0] }, if end { 0.0 } else { at[1] }, if end { up } else { 0.0 }])
    }
}

impl Solid for Cube {
    #[inline(always)]
    fn enter(&self, Ray { p, d }: Ray) -> (f32, bool) {
        let ((ax, bx), (ay, by), (az, bz)) = (slab(p[0], d[0]), slab(p[1], d[1]), slab(p[2], d[2]));
        let t = ax.max(ay).max(az);
        (t, t <= bx.min(by).min(bz))
    }

    #[inline(always)]
    fn surface(&self, Ray { p, d }: Ray) -> (f32, V3, V3) {
        let ((a, _), (b, _), (c, _)) = (slab(p[0], d[0]), slab(p[1], d[1]), slab(p[2], d[2]));
        let parameter = a.max(b).max(c);
        let against = |d: f32| if d > 0.0 { -1.0 } else { 1.0 };
        let (on_x, on_y) = ((a >= b) & (a >= c), b >= c);
        let normal = [
            if on_x { against(d[0]) } else { 0.0 },
            if !on_x & on_y { against(d[1]) } else { 0.0 },
            if on_x | on_y { 0.0 } else { against(d[2]) },
        ];
        (parameter, [p[0] + parameter * d[0], p[1] + parameter * d[1], p[2] + parameter * d[2]], normal)
    }
}

/// Writes a solid to the samples in which it is the nearest shape.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "references that do not alias let the compiler vectorise the loops")]
fn enter(
    solid: &impl Solid,
    row: &Row,
    id: u32,
    x: &[f32],
    y: &[f32],
    floor: &[f32],
    depths: &mut [f32],
    ids: &mut [u32],
) {
    let (row, n) = (*row, depths.len());
    let (x, y, floor, depths, ids) = (&x[..n], &y[..n], &floor[..n], &mut depths[..n], &mut ids[..n]);
    for i in 0..n {
        let (parameter, hit) = solid.enter(row.ray(x[i], y[i]));
        let depth = row.depth + parameter;
        let closer = hit & (depth > row.near) & (depth <= depths[i]) & (depth > floor[i]);
        depths[i] = if closer { depth } else { depths[i] };
        ids[i] = if closer { id } else { ids[i] };
    }
}

/// Computes the visible surface of a solid at many pixel positions.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "references that do not alias let the compiler vectorise the loops")]
fn surfaces(
    solid: &impl Solid,
    pose: &PosedShape,
    x: &[f32],
    y: &[f32],
    t: &mut [f32],
    px: &mut [f32],
    py: &mut [f32],
    pz: &mut [f32],
    nx: &mut [f32],
    ny: &mut [f32],
    nz: &mut [f32],
) {
    let (pose, n) = (*pose, x.len());
    let (y, t, px, py, pz) = (&y[..n], &mut t[..n], &mut px[..n], &mut py[..n], &mut pz[..n]);
    let (nx, ny, nz) = (&mut nx[..n], &mut ny[..n], &mut nz[..n]);
    for i in 0..n {
        let (parameter, position, normal) = solid.surface(pose.ray(x[i], y[i]));
        t[i] = parameter;
        (px[i], py[i], pz[i]) = (position[0], position[1], position[2]);
        (nx[i], ny[i], nz[i]) = (normal[0], normal[1], normal[2]);
    }
}

vectorize! {
    fn enter_plane(
        solid: &Rectangle, row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(solid, row, id, x, y, floor, depths, ids);
    }

    fn enter_sphere(
        row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(&Sphere, row, id, x, y, floor, depths, ids);
    }

    fn enter_capsule(
        solid: &Capsule, row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(solid, row, id, x, y, floor, depths, ids);
    }

    fn enter_cylinder(
        row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(&Cylinder, row, id, x, y, floor, depths, ids);
    }

    fn enter_cube(
        row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(&Cube, row, id, x, y, floor, depths, ids);
    }

    fn surface_plane(
        solid: &Rectangle, pose: &PosedShape, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(solid, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_sphere(
        pose: &PosedShape, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Sphere, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_capsule(
        solid: &Capsule, pose: &PosedShape, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(solid, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_cylinder(
        pose: &PosedShape, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Cylinder, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_cube(
        pose: &PosedShape, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Cube, pose, x, y, t, px, py, pz, nx, ny, nz);
    }
}
