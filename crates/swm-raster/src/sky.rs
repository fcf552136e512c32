//! What is behind everything: a cube texture on a cylinder around the camera, and haze before it.

use crate::layers::{Layers, NOTHING};
use crate::scene::{Assets, Geom, Haze, Scene, Shape};
use crate::simd::vectorised;
use crate::texture::{Reader, Texture};
use crate::vector::{V3, add, dot, scale, sub, unrotate};
use crate::view::View;
use std::sync::Arc;

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
fn colour(texture: &Texture, reader: &mut Reader, direction: V3, right: V3, down: V3) -> V3 {
    // The texture's y axis points upwards.
    let turn = |[x, y, z]: V3| [x, z, -y];
    texture.colour(reader, texture.face_in(turn(direction), turn(right), turn(down)))
}

/// The sky as it was seen last. It is so far away that it stays the same while a camera only moves: its pixels are
/// looked up once.
#[derive(Default)]
pub(crate) struct Backdrop {
    /// The texture and the rays it was seen along.
    seen: Option<(Arc<Texture>, V3, [V3; 2])>,
    size: (usize, usize),
    /// Colours of pixels; negative where nobody has looked yet.
    colours: Vec<V3>,
    reader: Reader,
    /// Scratch: how much of each pixel of a row is open.
    open: Vec<f32>,
}

/// Nobody has looked yet.
const UNSEEN: V3 = [-1.0; 3];

impl Backdrop {
    /// Paints the sky where nothing is before it.
    #[allow(clippy::cast_precision_loss)]
    pub fn paint(&mut self, scene: &Scene, assets: &Assets, view: &View, main: &mut Layers, colours: &mut [V3]) {
        let Some(texture) = scene.sky.and_then(|sky| assets.textures.get(sky)) else { return };
        let rays = view.rays();
        let known = self.seen.as_ref().is_some_and(|(seen, direction, directions)| {
            Arc::ptr_eq(seen, texture) && *direction == rays.direction && *directions == rays.directions
        });
        if !known || self.size != (view.width, view.height) {
            self.seen = Some((Arc::clone(texture), rays.direction, rays.directions));
            self.size = (view.width, view.height);
            self.colours.clear();
            self.colours.resize(view.width * view.height, UNSEEN);
        }
        let infinite = |geom: &Geom| matches!(geom.shape, Shape::Plane(x, y) if x.infinite || y.infinite);
        let endless = scene.geoms.iter().any(infinite);
        let radius = radius(scene);
        let share = 1.0 / main.samples as f32;
        self.open.resize(view.width, 0.0);
        for y in 0..view.height {
            let row = add(rays.direction, scale(rays.directions[1], y as f32 + 0.5));
            let at = |x: usize| add(row, scale(rays.directions[0], x as f32 + 0.5));
            let samples = main.span(y, 0, view.width);
            if endless {
                // The sky is nearer than the far ends of endless planes.
                let pixels = main.depths[samples.clone()].chunks_exact(main.samples);
                for (x, (depths, ids)) in
                    pixels.zip(main.ids[samples.clone()].chunks_exact_mut(main.samples)).enumerate()
                {
                    let far = depth(radius, at(x));
                    for (depth, id) in depths.iter().zip(ids) {
                        *id = if *depth > far { NOTHING } else { *id };
                    }
                }
            }
            count_open(&main.ids[samples], main.samples, share, &mut self.open);
            let row = y * view.width..(y + 1) * view.width;
            let (seen, colours) = (&mut self.colours[row.clone()], &mut colours[row]);
            for (x, (seen, open)) in seen.iter_mut().zip(&self.open).enumerate() {
                if *open > 0.0 && seen[0] < 0.0 {
                    *seen = colour(texture, &mut self.reader, at(x), rays.directions[0], rays.directions[1]);
                }
            }
            shine_through(seen, &self.open, colours);
        }
    }
}

vectorised! {
    /// Finds how much of every pixel shows nothing: a share for every sample.
    fn count_open(ids: &[u32], samples: usize, share: f32, open: &mut [f32]) {
        #[inline(always)]
        fn count<const SAMPLES: usize>(ids: &[u32], share: f32, open: &mut [f32]) {
            for (open, ids) in open.iter_mut().zip(ids.as_chunks::<SAMPLES>().0) {
                *open = ids.iter().fold(0.0, |open, id| open + if *id == NOTHING { share } else { 0.0 });
            }
        }
        match samples {
            1 => count::<1>(ids, share, open),
            2 => count::<2>(ids, share, open),
            _ => count::<4>(ids, share, open),
        }
    }

    /// Adds the sky as far as pixels are open.
    fn shine_through(sky: &[V3], open: &[f32], colours: &mut [V3]) {
        for ((sky, open), colour) in sky.iter().zip(open).zip(colours) {
            for k in 0..3 {
                colour[k] += if *open > 0.0 { open * sky[k] } else { 0.0 };
            }
        }
    }
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
