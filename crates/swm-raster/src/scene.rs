//! What is drawn: geoms with materials, lights, a camera, a sky. The words and the meaning of the numbers are those of
//! OpenGL's fixed pipeline and of MuJoCo, which draws with it.

use crate::mesh::Mesh;
use crate::scalar::floor;
use crate::texture::Texture;
use crate::vector::V3;
use std::sync::Arc;

/// What scenes refer to by place, prepared once.
#[derive(Clone, Default)]
pub struct Assets {
    /// Textures.
    pub textures: Vec<Arc<Texture>>,
    /// Meshes.
    pub meshes: Vec<Arc<Mesh>>,
}

/// A scene. Its vectors are meant to be cleared and filled again for the next picture.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// Whence it is seen.
    pub camera: Camera,
    /// What is seen; later ones win where two are equally far.
    pub geoms: Vec<Geom>,
    /// Light falls from here; without any, everything is lit evenly and dimly.
    pub lights: Vec<Light>,
    /// The cube texture around everything, by its place.
    pub sky: Option<usize>,
    /// What veils the horizon of the first infinite plane; shown with a sky.
    pub haze: Option<Haze>,
    /// Whether lights that cast shadows do.
    pub shadows: bool,
    /// Whether the first reflecting geom reflects.
    pub reflections: bool,
    /// Half the side of the square that directional lights cast shadows in.
    pub shadow_reach: f32,
    /// What a spot light's angle is multiplied with where it casts shadows.
    pub shadow_angle: f32,
}

/// A camera: x to the right, y up.
#[derive(Clone, Copy, Debug, Default)]
pub struct Camera {
    /// Its place.
    pub position: V3,
    /// Where it looks, of length 1.
    pub forward: V3,
    /// What is above, of length 1, at right angles to `forward`.
    pub up: V3,
    /// Left, right, bottom and top of the picture on the near plane.
    pub frustum: [f32; 4],
    /// Nothing nearer is seen.
    pub near: f32,
    /// Nothing farther is seen.
    pub far: f32,
    /// Parallel rays instead of rays from one point.
    pub orthographic: bool,
}

/// What a geom is, around its own origin.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// A rectangle at z = 0, seen from both sides, thinner from behind. It is lit at the corners of a grid, between which
    /// colours are interpolated: one axis of it along x, one along y.
    Plane(Axis, Axis),
    /// An ellipsoid of these radii.
    Ellipsoid(V3),
    /// A cylinder along z that ends in half spheres: its radius, and half the cylinder's length.
    Capsule(f32, f32),
    /// A cylinder along z: radius, half its length.
    Cylinder(f32, f32),
    /// A box: half its sides.
    Box(V3),
    /// A mesh of [`Assets`].
    Mesh(usize),
}

/// Grid lines along an axis: cells of width `step`, but for the first and the last, which are `pad` wide.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    /// Half the width of all.
    pub half: f32,
    /// Width of the first and last cell.
    pub pad: f32,
    /// Width of the others.
    pub step: f32,
    /// Cells, at least 1.
    pub cells: usize,
    /// Whether it stands for an endless one.
    pub infinite: bool,
}

impl Axis {
    /// So many equal cells from `-half` to `half`.
    #[allow(clippy::cast_precision_loss)]
    pub fn even(half: f32, cells: usize) -> Self {
        let step = 2.0 * half / cells.max(1) as f32;
        Self { half, pad: step, step, cells: cells.max(1), infinite: false }
    }

    /// Where the line before cell `i`, a whole number, is.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn line(&self, i: f32) -> f32 {
        let inner = -self.half + self.pad + (i - 1.0) * self.step;
        let inner = if i > 0.0 { inner } else { -self.half };
        if i < self.cells as f32 { inner } else { self.half }
    }

    /// The cell a place is in, and how far into it, from 0 to 1.
    #[inline(always)]
    #[allow(clippy::cast_precision_loss, clippy::manual_clamp, reason = "`clamp` would keep what is no number")]
    pub(crate) fn cell(&self, x: f32) -> (f32, f32) {
        // Where it is among the inner lines; what is far outside, or no number, may be anywhere.
        let from = ((x + self.half - self.pad) / self.step).max(-1.0).min(1e6);
        let last = (self.cells - 1) as f32;
        let cell = floor(from) + 1.0;
        let cell = if cell < last { cell } else { last };
        let (low, high) = (self.line(cell), self.line(cell + 1.0));
        (cell, ((x - low) / (high - low).max(1e-12)).max(0.0).min(1.0))
    }
}

/// A thing in the scene.
#[derive(Clone, Copy, Debug)]
pub struct Geom {
    /// Its form and size.
    pub shape: Shape,
    /// Where its origin is.
    pub position: V3,
    /// Its axes, as columns of a matrix given row after row.
    pub rotation: [f32; 9],
    /// Colour, and opacity: below 0.995, what is behind shines through.
    pub rgba: [f32; 4],
    /// How much of its colour it glows with.
    pub emission: f32,
    /// The colour of highlights, a grey.
    pub specular: f32,
    /// How small highlights are: OpenGL's exponent, divided by 128.
    pub shininess: f32,
    /// How much of a mirror image a plane or the upper side of a box shows.
    pub reflectance: f32,
    /// What its colour is multiplied with.
    pub paint: Option<Paint>,
    /// Its number in pictures of labels; `None` leaves it out of them.
    pub label: Option<i32>,
    /// Whether it casts shadows.
    pub casts: bool,
}

/// A texture on a geom.
#[derive(Clone, Copy, Debug)]
pub struct Paint {
    /// Its place in [`Assets`].
    pub texture: usize,
    /// How it lies there.
    pub mapping: Mapping,
}

/// How a texture lies on a geom.
#[derive(Clone, Copy, Debug)]
pub enum Mapping {
    /// Seen along z: the texture's coordinates are `scale * (x, y) + offset`.
    Flat {
        /// By what local coordinates are multiplied.
        scale: [f32; 2],
        /// What is added.
        offset: [f32; 2],
    },
    /// On each side of a box, so many times.
    Sides([f32; 2]),
    /// A cube texture, by the direction from the origin of the geom, each axis multiplied.
    Cube(V3),
    /// By the coordinates of a mesh.
    Own,
}

/// A light.
#[derive(Clone, Copy, Debug)]
pub struct Light {
    /// Where it is; of a directional one, whence it casts shadows.
    pub position: V3,
    /// Where it shines, of length 1.
    pub direction: V3,
    /// All rays parallel; otherwise a spot.
    pub directional: bool,
    /// Constant, linear and quadratic decay with distance, of spots.
    pub attenuation: V3,
    /// Degrees from its direction that a spot reaches, at most 90; more stands for everywhere.
    pub cutoff: f32,
    /// How a spot fades towards its edge.
    pub exponent: f32,
    /// Light from everywhere.
    pub ambient: V3,
    /// Light that surfaces scatter.
    pub diffuse: V3,
    /// Light of highlights.
    pub specular: V3,
    /// Whether it casts shadows.
    pub shadows: bool,
}

/// A veil at the horizon.
#[derive(Clone, Copy, Debug)]
pub struct Haze {
    /// Its colour.
    pub rgb: V3,
    /// How far it reaches towards the camera, as a part of the distance of the sky.
    pub depth: f32,
}
