//! Rays against shapes: where a row of rays enters a shape, and what its surface is like there.
//!
//! A shape is brought to unit size ([`Posed`]), so that few kernels serve all. They are loops over the rays of a row without
//! branches. Rays begin near the shape, not at the camera: small shapes far away would drown in rounding.

use crate::scene::{Geom, Shape};
use crate::vector::{V3, add, scale, sub, unrotate};
use crate::view::View;
use swm_simd::vectorize;

/// What a unit shape is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Unit {
    /// z = 0, |x| and |y| at most these.
    Plane([f32; 2]),
    /// Radius 1.
    Sphere,
    /// Radius 1, half its cylinder's length.
    Capsule(f32),
    /// Radius 1, z from -1 to 1.
    Cylinder,
    /// From -1 to 1.
    Cube,
}

/// Sizes are at least this.
const SMALLEST: f32 = 1e-6;

/// A shape of unit size, and the rays of a view as it sees them: at pixel (x, y), they pass depth `depth` at
/// `place + (x - base[0]) * places[0] + (y - base[1]) * places[1]`, and go on in the direction that is made in the same way.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Posed {
    pub unit: Unit,
    /// By what unit coordinates are multiplied to become local ones.
    pub sizes: V3,
    pub base: [f32; 2],
    pub depth: f32,
    pub near: f32,
    pub place: V3,
    pub places: [V3; 2],
    pub direction: V3,
    pub directions: [V3; 2],
}

/// The rays through a row of pixels: at `x` pixels from the left and `y` from the upper edge of the row, they pass the depth of
/// [`Posed`] at `place + x * places[0] + y * places[1]`, and so the direction.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Row {
    base: f32,
    place: V3,
    places: [V3; 2],
    direction: V3,
    directions: [V3; 2],
    depth: f32,
    near: f32,
}

/// Samples next to each other, and the nearest thing at each.
pub(crate) struct Samples<'a> {
    /// Where they are: from the left of the picture, and from the upper edge of the row.
    pub at: [&'a [f32]; 2],
    /// What is not farther than this does not count.
    pub floor: &'a [f32],
    pub depths: &'a mut [f32],
    pub ids: &'a mut [u32],
}

impl Shape {
    /// The unit shape, and its sizes; `None` of a mesh.
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

    /// The middle and half the sides of a box around it, along its axes; of a mesh, nothing.
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

impl Posed {
    /// A geom in a view; `None` of meshes.
    pub fn new(geom: &Geom, view: &View) -> Option<Self> {
        let (unit, sizes) = geom.shape.unit()?;
        let rays = view.rays();
        let ([x, y, w], depth) = view.project(geom.position);
        // The pixel and the depth the shape is near, or what comes close where it is behind the camera.
        let inside = |at: f32, most: usize| {
            #[allow(clippy::cast_precision_loss)]
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
        let place = add(sub(at(rays.origin, rays.origins), geom.position), scale(direction, depth));
        let places = [0, 1].map(|k| local(add(rays.origins[k], scale(rays.directions[k], depth))));
        Some(Self {
            unit,
            sizes,
            base,
            depth,
            near: view.near,
            place: local(place),
            places,
            direction: local(direction),
            directions: rays.directions.map(local),
        })
    }

    /// The rays of row `y`.
    #[allow(clippy::cast_precision_loss)]
    pub fn row(&self, y: usize) -> Row {
        let down = y as f32 - self.base[1];
        Row {
            base: self.base[0],
            place: add(self.place, scale(self.places[1], down)),
            places: self.places,
            direction: add(self.direction, scale(self.directions[1], down)),
            directions: self.directions,
            depth: self.depth,
            near: self.near,
        }
    }

    /// Puts the shape, as `id`, where it is nearer than what is there.
    pub fn enter(&self, row: &Row, id: u32, samples: Samples<'_>) {
        let Samples { at: [x, y], floor, depths, ids } = samples;
        match self.unit {
            Unit::Plane(halves) => enter_plane(&self.rectangle(halves), row, id, x, y, floor, depths, ids),
            Unit::Sphere => enter_sphere(row, id, x, y, floor, depths, ids),
            Unit::Capsule(half) => enter_capsule(&Rod(half), row, id, x, y, floor, depths, ids),
            Unit::Cylinder => enter_cylinder(row, id, x, y, floor, depths, ids),
            Unit::Cube => enter_cube(row, id, x, y, floor, depths, ids),
        }
    }

    fn rectangle(&self, halves: [f32; 2]) -> Rectangle {
        Rectangle(halves, self.near - self.depth)
    }

    /// What is seen through the middles of pixels: depth (added to that of the pose), unit coordinates, and the direction of the
    /// surface in unit coordinates, not of length 1. Rays that miss are led to the rim.
    pub fn surface(&self, x: &[f32], y: &[f32], depths: &mut [f32], places: [&mut [f32]; 3], normals: [&mut [f32]; 3]) {
        let ([px, py, pz], [nx, ny, nz]) = (places, normals);
        match self.unit {
            Unit::Plane(halves) => {
                surface_plane(&self.rectangle(halves), self, x, y, depths, px, py, pz, nx, ny, nz);
            }
            Unit::Sphere => surface_sphere(self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Capsule(half) => surface_capsule(&Rod(half), self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Cylinder => surface_cylinder(self, x, y, depths, px, py, pz, nx, ny, nz),
            Unit::Cube => surface_cube(self, x, y, depths, px, py, pz, nx, ny, nz),
        }
    }
}

/// A ray: where it is at the depth of the pose, and its direction.
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
        Ray { p: at(self.place, &self.places), d: at(self.direction, &self.directions) }
    }
}

impl Posed {
    #[inline(always)]
    fn ray(&self, x: f32, y: f32) -> Ray {
        let (x, y) = (x - self.base[0], y - self.base[1]);
        let at = |from: V3, steps: &[V3; 2]| add(from, add(scale(steps[0], x), scale(steps[1], y)));
        Ray { p: at(self.place, &self.places), d: at(self.direction, &self.directions) }
    }
}

/// Not zero, so that one can divide by it.
#[inline(always)]
fn nonzero(x: f32) -> f32 {
    if x.abs() > 1e-12 { x } else { 1e-12 }
}

/// A ball around (0, 0, z): the way to where a ray enters, and how far inside it passes (negative where it misses).
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

/// An endless cylinder of radius 1 along z: the ways to where a ray enters and leaves, and how far inside it passes.
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

/// The space between -1 and 1 of one coordinate: the ways to where a ray enters and leaves.
#[inline(always)]
fn slab(p: f32, d: f32) -> (f32, f32) {
    let by = 1.0 / nonzero(d);
    let (a, b) = ((-1.0 - p) * by, (1.0 - p) * by);
    (a.min(b), a.max(b))
}

/// A unit shape.
trait Solid {
    /// The way along a ray to where it enters, and whether it does.
    fn enter(&self, ray: Ray) -> (f32, bool);

    /// The way to where a ray enters, or comes close to the shape; the place, and the direction of the surface there.
    fn surface(&self, ray: Ray) -> (f32, V3, V3);
}

/// A rectangle at z = 0: its halves, and the least way along a ray that is in front of the camera.
struct Rectangle([f32; 2], f32);
struct Sphere;
/// A capsule: half the length of its cylinder.
struct Rod(f32);
struct Drum;
struct Cube;

impl Solid for Rectangle {
    #[inline(always)]
    fn enter(&self, Ray { p, d }: Ray) -> (f32, bool) {
        let t = -p[2] / nonzero(d[2]);
        (t, ((p[0] + t * d[0]).abs() <= self.0[0]) & ((p[1] + t * d[1]).abs() <= self.0[1]))
    }

    #[inline(always)]
    fn surface(&self, Ray { p, d }: Ray) -> (f32, V3, V3) {
        // A pixel whose middle is past the horizon or the rim takes what is there.
        let way = -p[2] / nonzero(d[2]);
        let way = if way > self.1 { way } else { 1e6 };
        (way, [p[0] + way * d[0], p[1] + way * d[1], 0.0], [0.0, 0.0, 1.0])
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
        let (way, _) = ball(ray, 0.0);
        let at = add(ray.p, scale(ray.d, way));
        (way, at, at)
    }
}

impl Solid for Rod {
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
        // Past the rim: where it passes the axis, or the nearer end.
        let (body, _, _) = tube(ray);
        let end = (ray.p[2] + body * ray.d[2]).clamp(-self.0, self.0);
        let (rim, _) = ball(ray, end);
        let way = if is_hit { hit } else { rim };
        let at = add(ray.p, scale(ray.d, way));
        (way, at, [at[0], at[1], at[2] - at[2].clamp(-self.0, self.0)])
    }
}

impl Solid for Drum {
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
        let way = enter.max(low);
        let at = add(ray.p, scale(ray.d, way));
        let end = low > enter;
        let up = if ray.d[2] > 0.0 { -1.0 } else { 1.0 };
        (way, at, [if end { 0.0 } else { at[0] }, if end { 0.0 } else { at[1] }, if end { up } else { 0.0 }])
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
        let way = a.max(b).max(c);
        let against = |d: f32| if d > 0.0 { -1.0 } else { 1.0 };
        let (on_x, on_y) = ((a >= b) & (a >= c), b >= c);
        let normal = [
            if on_x { against(d[0]) } else { 0.0 },
            if !on_x & on_y { against(d[1]) } else { 0.0 },
            if on_x | on_y { 0.0 } else { against(d[2]) },
        ];
        (way, [p[0] + way * d[0], p[1] + way * d[1], p[2] + way * d[2]], normal)
    }
}

/// Puts a solid where it is nearer than what is there.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "references to numbers of which the compiler knows that they are apart")]
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
        let (way, hit) = solid.enter(row.ray(x[i], y[i]));
        let depth = row.depth + way;
        let closer = hit & (depth > row.near) & (depth <= depths[i]) & (depth > floor[i]);
        depths[i] = if closer { depth } else { depths[i] };
        ids[i] = if closer { id } else { ids[i] };
    }
}

/// What is seen of a solid at many places.
#[inline(always)]
#[allow(clippy::too_many_arguments, reason = "as above")]
fn surfaces(
    solid: &impl Solid,
    pose: &Posed,
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
        let (way, place, normal) = solid.surface(pose.ray(x[i], y[i]));
        t[i] = way;
        (px[i], py[i], pz[i]) = (place[0], place[1], place[2]);
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
        solid: &Rod, row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(solid, row, id, x, y, floor, depths, ids);
    }

    fn enter_cylinder(
        row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(&Drum, row, id, x, y, floor, depths, ids);
    }

    fn enter_cube(
        row: &Row, id: u32, x: &[f32], y: &[f32], floor: &[f32], depths: &mut [f32], ids: &mut [u32],
    ) {
        enter(&Cube, row, id, x, y, floor, depths, ids);
    }

    fn surface_plane(
        solid: &Rectangle, pose: &Posed, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(solid, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_sphere(
        pose: &Posed, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Sphere, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_capsule(
        solid: &Rod, pose: &Posed, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(solid, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_cylinder(
        pose: &Posed, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Drum, pose, x, y, t, px, py, pz, nx, ny, nz);
    }

    fn surface_cube(
        pose: &Posed, x: &[f32], y: &[f32], t: &mut [f32],
        px: &mut [f32], py: &mut [f32], pz: &mut [f32], nx: &mut [f32], ny: &mut [f32], nz: &mut [f32],
    ) {
        surfaces(&Cube, pose, x, y, t, px, py, pz, nx, ny, nz);
    }
}
