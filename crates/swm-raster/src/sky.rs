//! What is behind everything: a cube texture on a cylinder around the camera, and haze before it.

use crate::scene::{Haze, Scene, Shape};
use crate::texture::Texture;
use crate::vector::{V3, dot, scale, sub, unrotate};

/// How far the sky is: just so near that no part of its cylinder is cut off, as a part of the depth one sees.
const NEAR: f32 = 0.7;

/// The cylinder's radius, and half its height.
pub(crate) fn radius(scene: &Scene) -> f32 {
    NEAR * scene.camera.far
}

/// The depth at which a ray meets the sky.
#[inline(always)]
pub(crate) fn depth(radius: f32, direction: V3) -> f32 {
    let [x, y, z] = direction;
    radius / (x * x + y * y).sqrt().max(z.abs()).max(1e-12)
}

/// The sky's colour in a direction, which changes so much from pixel to pixel.
#[inline]
pub(crate) fn colour(texture: &Texture, direction: V3, right: V3, down: V3) -> V3 {
    // The texture's y axis points upwards.
    let turn = |[x, y, z]: V3| [x, z, -y];
    texture.cube_at(turn(direction), turn(right), turn(down))
}

/// Haze above an infinite plane: a cone that begins on the plane, inside the sky's cylinder, and ends at the height of the eye, on
/// the cylinder. It is thickest where it crosses the way to where the plane meets the sky.
pub(crate) struct Veil {
    rotation: [f32; 9],
    elevation: f32,
    radius: f32,
    inner: f32,
    thickest: f32,
    pub rgb: V3,
}

impl Veil {
    /// The haze of a scene, if its first infinite plane is below the eye.
    pub fn new(scene: &Scene, haze: &Haze, eye: V3) -> Option<Self> {
        let plane =
            scene.geoms.iter().find(|geom| matches!(geom.shape, Shape::Plane(x, y) if x.infinite && y.infinite))?;
        let normal = [plane.rotation[2], plane.rotation[5], plane.rotation[8]];
        let elevation = dot(sub(eye, plane.position), normal) / radius(scene);
        let inner = haze.depth;
        // Where a line from the eye at 45 degrees would be for an eye at height 1.
        let alpha = 1f32.atan2(inner);
        let beta = 0.75 * std::f32::consts::PI - alpha;
        let thickest = 0.5f32.sqrt() * inner * alpha.sin() / beta.sin();
        (elevation > 0.0).then_some(Self {
            rotation: plane.rotation,
            elevation,
            radius: radius(scene),
            inner,
            thickest,
            rgb: haze.rgb,
        })
    }

    /// How thick it is along a ray, and at which depth.
    #[inline]
    pub fn at(&self, direction: V3) -> Option<(f32, f32)> {
        let local = unrotate(&self.rotation, direction);
        let across = (local[0] * local[0] + local[1] * local[1]).sqrt();
        let slope = local[2] / across.max(1e-12);
        // The part of the way down from the eye to the plane: on the cone, the radius is 1 - inner * part.
        let part = slope / (slope * self.inner - self.elevation);
        if !(0.0..=1.0).contains(&part) {
            return None;
        }
        let height = 1.0 - part;
        let opacity = match height < self.thickest {
            true => height / self.thickest,
            false => (1.0 - height) / (1.0 - self.thickest),
        };
        Some((opacity, self.radius * (1.0 - self.inner * part) / across.max(1e-12)))
    }
}

/// A colour behind another.
#[inline]
pub(crate) fn over(front: V3, opacity: f32, behind: V3) -> V3 {
    let behind = scale(behind, 1.0 - opacity);
    std::array::from_fn(|k| opacity * front[k] + behind[k])
}
