//! [`Scene`]: geoms with materials, lights, a camera and a sky. Terms and units are those of OpenGL's fixed pipeline
//! and of MuJoCo, which uses it. Lengths share one unit, angles are degrees, colours are 0 to 1.

use crate::mesh::Mesh;
use crate::scalar::floor;
use crate::texture::Texture;
use crate::vector::V3;
use std::sync::Arc;

/// The textures and meshes that scenes refer to by index, prepared once.
#[derive(Clone, Default)]
pub struct Assets {
    /// Textures, flat and cube.
    pub textures: Vec<Arc<Texture>>,
    /// Meshes.
    pub meshes: Vec<Arc<Mesh>>,
}

/// A scene. Its vectors are meant to be cleared and filled again for the next frame.
#[derive(Clone, Debug, Default)]
pub struct Scene {
    /// The camera.
    pub camera: Camera,
    /// The geoms. Of two geoms at the same depth, the later one is visible.
    pub geoms: Vec<Geom>,
    /// The lights. A scene without lights is lit evenly and dimly.
    pub lights: Vec<Light>,
    /// Index of the cube texture that surrounds the scene.
    pub sky: Option<usize>,
    /// Haze at the horizon of the first infinite plane; drawn only with a sky.
    pub haze: Option<Haze>,
    /// Whether shadows are drawn.
    pub shadows: bool,
    /// Whether reflections in the first reflective geom are drawn.
    pub reflections: bool,
    /// Half the side of the square in which directional lights cast shadows.
    pub shadow_reach: f32,
    /// Factor of a spot light's cutoff angle within which it casts shadows.
    pub shadow_angle: f32,
}

/// A camera: x to the right, y up.
#[derive(Clone, Copy, Debug, Default)]
pub struct Camera {
    /// Position.
    pub position: V3,
    /// Viewing direction, a unit vector.
    pub forward: V3,
    /// Upward direction, a unit vector perpendicular to `forward`.
    pub up: V3,
    /// Left, right, bottom and top of the frame on the near plane.
    pub frustum: [f32; 4],
    /// Distance of the near plane.
    pub near: f32,
    /// Distance of the far plane.
    pub far: f32,
    /// Whether rays are parallel instead of meeting in the camera.
    pub orthographic: bool,
}

/// The shape of a geom, relative to the geom's origin.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// A rectangle at z = 0, visible from both sides and more transparent from behind. Light is computed at the corners
    /// of a grid, whose axes are x and y, and colours are interpolated between them.
    Plane(Axis, Axis),
    /// An ellipsoid with these radii.
    Ellipsoid(V3),
    /// A capsule along z: its radius, and half the length of its cylinder.
    Capsule(f32, f32),
    /// A cylinder along z: its radius, and half its length.
    Cylinder(f32, f32),
    /// A box with these half sides.
    Box(V3),
    /// A mesh, by its index in [`Assets`].
    Mesh(usize),
}

/// The grid of a plane along one axis: cells of width `step`, except for the first and the last of width `pad`.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    /// Half the width of the plane.
    pub half: f32,
    /// Width of the first and the last cell.
    pub pad: f32,
    /// Width of the inner cells.
    pub step: f32,
    /// Number of cells, at least 1.
    pub cells: usize,
    /// Whether the plane is infinite along this axis.
    pub infinite: bool,
}

impl Axis {
    /// Makes a grid of `cells` equal cells from `-half` to `half`.
    pub fn even(half: f32, cells: usize) -> Self {
        let step = 2.0 * half / cells.max(1) as f32;
        Self { half, pad: step, step, cells: cells.max(1), infinite: false }
    }

    /// Returns the coordinate of the line before cell `i`, an integer.
    #[inline(always)]
    pub(crate) fn line(&self, i: f32) -> f32 {
        let inner = -self.half + self.pad + (i - 1.0) * self.step;
        let inner = if i > 0.0 { inner } else { -self.half };
        if i < self.cells as f32 { inner } else { self.half }
    }

    /// Returns the cell of a coordinate, and the position within it from 0 to 1.
    #[inline(always)]
    #[allow(clippy::manual_clamp, reason = "`clamp` would keep NaN")]
    pub(crate) fn cell(&self, x: f32) -> (f32, f32) {
        // Position among the inner lines. Values far outside and NaN are clamped.
        let from = ((x + self.half - self.pad) / self.step).max(-1.0).min(1e6);
        let last = (self.cells - 1) as f32;
        let cell = floor(from) + 1.0;
        let cell = if cell < last { cell } else { last };
        let (low, high) = (self.line(cell), self.line(cell + 1.0));
        (cell, ((x - low) / (high - low).max(1e-12)).max(0.0).min(1.0))
    }
}

/// A geom: a shape with a pose and a material.
#[derive(Clone, Copy, Debug)]
pub struct Geom {
    /// Shape and size.
    pub shape: Shape,
    /// Position of the origin.
    pub position: V3,
    /// Rotation, `[3, 3]` row-major; its columns are the local axes.
    pub rotation: [f32; 9],
    /// Colour and opacity. A geom with an opacity below 0.995 is transparent.
    pub rgba: [f32; 4],
    /// Emission, as a factor of the colour.
    pub emission: f32,
    /// Specular reflectance, a grey.
    pub specular: f32,
    /// Shininess: OpenGL's exponent divided by 128.
    pub shininess: f32,
    /// Weight of the mirror image on a plane or on the upper side of a box.
    pub reflectance: f32,
    /// The texture that multiplies the colour.
    pub paint: Option<Paint>,
    /// The label; a geom without a label is not drawn in label images.
    pub label: Option<i32>,
    /// Whether the geom casts shadows.
    pub casts: bool,
}

/// A texture on a geom.
#[derive(Clone, Copy, Debug)]
pub struct Paint {
    /// Index of the texture in [`Assets`].
    pub texture: usize,
    /// The mapping of the texture to the geom.
    pub mapping: Mapping,
}

/// The mapping of a texture to a geom.
#[derive(Clone, Copy, Debug)]
pub enum Mapping {
    /// A projection along z: texture coordinates are `scale * (x, y) + offset`.
    Flat {
        /// Factor of the local coordinates.
        scale: [f32; 2],
        /// The offset.
        offset: [f32; 2],
    },
    /// The texture on each side of a box, repeated this number of times along each axis.
    Sides([f32; 2]),
    /// A cube texture, by the direction from the geom's origin, with a factor per axis.
    Cube(V3),
    /// The texture coordinates of the mesh.
    Own,
}

/// A light.
#[derive(Clone, Copy, Debug)]
pub struct Light {
    /// Position; for a directional light, the position from which its shadow map is drawn.
    pub position: V3,
    /// Direction, a unit vector.
    pub direction: V3,
    /// Whether all rays are parallel. A light that is not directional is a spot light.
    pub directional: bool,
    /// Constant, linear and quadratic attenuation with distance, of spot lights.
    pub attenuation: V3,
    /// Half opening angle of a spot light in degrees, at most 90; a light with a larger angle shines in all
    /// directions.
    pub cutoff: f32,
    /// Exponent of a spot light's falloff towards its edge.
    pub exponent: f32,
    /// Ambient colour.
    pub ambient: V3,
    /// Diffuse colour.
    pub diffuse: V3,
    /// Specular colour.
    pub specular: V3,
    /// Whether the light casts shadows.
    pub shadows: bool,
}

/// Haze at the horizon.
#[derive(Clone, Copy, Debug)]
pub struct Haze {
    /// Colour.
    pub rgb: V3,
    /// Extent towards the camera, relative to the distance of the sky.
    pub depth: f32,
}
