//! The background: a cube texture on a cylinder around the camera, and haze in front of it.

use crate::layers::{Layers, NOTHING};
use crate::scene::{Assets, Geom, Haze, Scene, Shape};
use crate::texture::{MANY, Sampler, Texture, TextureLookup};
use crate::vector::{V3, add, dot, scale, sub, unrotate};
use crate::view::View;
use std::ops::Range;
use std::sync::Arc;
use swm_simd::vectorize;

/// Distance of the sky relative to the far plane: small enough that the far plane does not cut the sky's cylinder.
const DISTANCE: f32 = 0.7;

/// Returns the radius of the sky's cylinder, which is also half its height.
pub(crate) fn radius(scene: &Scene) -> f32 {
    DISTANCE * scene.camera.far
}

/// Returns the depth at which a ray meets the sky.
#[inline(always)]
pub(crate) fn depth(radius: f32, direction: V3) -> f32 {
    let [x, y, z] = direction;
    radius / (x * x + y * y).sqrt().max(z.abs()).max(1e-12)
}

/// The colours of the sky in the last frame. The sky does not depend on the camera's position, so its colours
/// stay valid until the camera turns.
#[derive(Default)]
pub(crate) struct SkyCache {
    /// The texture, and the rays along which it was looked up for `colours`.
    source: Option<(Arc<Texture>, V3, [V3; 2])>,
    width: usize,
    rows: Range<usize>,
    /// Red, green and blue of pixels.
    colours: [Vec<f32>; 3],
    /// Whether the colours of each row were looked up.
    known: Vec<bool>,
    sampler: Sampler,
    /// Scratch: the uncovered part of each pixel of a row.
    open: Vec<f32>,
    /// Scratch: the depth of the sky at each pixel of a row.
    far: Vec<f32>,
}

impl SkyCache {
    /// Writes the colours of the sky in the rows of the layers, weighted by the uncovered part of each pixel.
    pub fn paint(
        &mut self,
        scene: &Scene,
        assets: &Assets,
        view: &View,
        main: &mut Layers,
        colours: &mut [Vec<f32>; 3],
    ) {
        let Some(texture) = scene.sky.and_then(|sky| assets.textures.get(sky)) else {
            colours.iter_mut().for_each(|colours| colours.fill(0.0));
            return;
        };
        let rays = view.rays();
        let known = self.source.as_ref().is_some_and(|(cached, direction, directions)| {
            Arc::ptr_eq(cached, texture) && *direction == rays.direction && *directions == rays.directions
        });
        if !known || (self.width, &self.rows) != (view.width, &main.rows) {
            self.source = Some((Arc::clone(texture), rays.direction, rays.directions));
            (self.width, self.rows) = (view.width, main.rows.clone());
            self.colours.iter_mut().for_each(|colours| colours.resize(view.width * main.rows.len(), 0.0));
            self.known.clear();
            self.known.resize(main.rows.len(), false);
        }
        let infinite = |geom: &Geom| matches!(geom.shape, Shape::Plane(x, y) if x.infinite || y.infinite);
        let endless = scene.geoms.iter().any(infinite);
        let radius = radius(scene);
        let share = 1.0 / main.samples as f32;
        self.open.resize(view.width, 0.0);
        self.far.resize(view.width, 0.0);
        for (line, y) in main.rows.clone().enumerate() {
            let row = add(rays.direction, scale(rays.directions[1], y as f32 + 0.5));
            let samples = main.span(y, 0, view.width);
            if endless {
                // The sky hides the far ends of infinite planes.
                depths(radius, row, rays.directions[0], &mut self.far);
                hide(&self.far, main.samples, &main.depths[samples.clone()], &mut main.ids[samples.clone()]);
            }
            count_open(&main.ids[samples], main.samples, share, &mut self.open);
            let pixels = line * view.width..(line + 1) * view.width;
            if self.open.iter().all(|open| *open == 0.0) {
                colours.iter_mut().for_each(|colours| colours[pixels.clone()].fill(0.0));
                continue;
            }
            if !std::mem::replace(&mut self.known[line], true) {
                let [r, g, b] = self.colours.each_mut().map(|colours| &mut colours[pixels.clone()]);
                look_up(texture, &mut self.sampler, row, rays.directions, [r, g, b]);
            }
            for (colours, sky) in colours.iter_mut().zip(&self.colours) {
                weight_by_open(&sky[pixels.clone()], &self.open, &mut colours[pixels.clone()]);
            }
        }
    }
}

/// Looks up the sky's colours along the rays of a row. `row` is the direction of the first ray; `right` and `down` are
/// its changes per pixel.
fn look_up(texture: &Texture, sampler: &mut Sampler, row: V3, [right, down]: [V3; 2], [r, g, b]: [&mut [f32]; 3]) {
    // The texture's y axis points upwards.
    let turn = |[x, y, z]: V3| [x, z, -y];
    let (row, right, down) = (turn(row), turn(right), turn(down));
    let ([mut s, mut t, mut texels_per_pixel], mut faces) = ([[0.0; MANY]; 3], [0; MANY]);
    for from in (0..r.len()).step_by(MANY) {
        let chunk = from..r.len().min(from + MANY);
        let n = chunk.len();
        find(texture, &row, &right, &down, from, &mut s, &mut t, &mut texels_per_pixel, &mut faces);
        let lookup =
            TextureLookup { s: &s[..n], t: &t[..n], texels_per_pixel: &texels_per_pixel[..n], faces: &faces[..n] };
        texture.colours(&lookup, sampler, [&mut r[chunk.clone()], &mut g[chunk.clone()], &mut b[chunk]]);
    }
}

vectorize! {
    /// Computes faces and coordinates of the rays of a row, from pixel `from` on.
    fn find(
        texture: &Texture, row: &V3, right: &V3, down: &V3, from: usize, s: &mut [f32; MANY], t: &mut [f32; MANY],
        texels_per_pixel: &mut [f32; MANY], faces: &mut [u32; MANY],
    ) {
        for i in 0..MANY {
            let direction = add(*row, scale(*right, from as f32 + (i as u32 as i32 as f32 + 0.5)));
            let (face, position, texels) = texture.face_in(direction, *right, *down);
            (faces[i], s[i], t[i], texels_per_pixel[i]) = (face, position[0], position[1], texels);
        }
    }

    /// Computes the depths at which the rays of a row meet the sky.
    fn depths(radius: f32, row: V3, right: V3, far: &mut [f32]) {
        for (i, far) in far.iter_mut().enumerate() {
            *far = depth(radius, add(row, scale(right, i as u32 as i32 as f32 + 0.5)));
        }
    }

    /// Removes samples that lie behind the sky.
    fn hide(far: &[f32], samples: usize, depths: &[f32], ids: &mut [u32]) {
        #[inline(always)]
        fn hide<const SAMPLES: usize>(far: &[f32], depths: &[f32], ids: &mut [u32]) {
            let (depths, ids) = (depths.as_chunks::<SAMPLES>().0, ids.as_chunks_mut::<SAMPLES>().0);
            for ((far, depths), ids) in far.iter().zip(depths).zip(ids) {
                for (depth, id) in depths.iter().zip(ids) {
                    *id = if *depth > *far { NOTHING } else { *id };
                }
            }
        }
        match samples {
            1 => hide::<1>(far, depths, ids),
            2 => hide::<2>(far, depths, ids),
            _ => hide::<4>(far, depths, ids),
        }
    }

    /// Computes the uncovered part of every pixel: `share` per empty sample.
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

    /// Weights the sky's colours by the uncovered part of pixels.
    fn weight_by_open(sky: &[f32], open: &[f32], colours: &mut [f32]) {
        for ((sky, open), colour) in sky.iter().zip(open).zip(colours) {
            *colour = sky * open;
        }
    }
}

/// Haze above an infinite plane: a cone from a circle on the plane, inside the sky's cylinder, to the cylinder at the
/// height of the eye. The opacity of the cone is greatest at an
/// intermediate height, `thickest`.
pub(crate) struct HazeCone {
    rotation: [f32; 9],
    elevation: f32,
    radius: f32,
    inner: f32,
    thickest: f32,
    pub rgb: V3,
}

impl HazeCone {
    /// Returns the haze of a scene if its first infinite plane is below the eye.
    pub fn new(scene: &Scene, haze: &Haze, eye: V3) -> Option<Self> {
        let plane =
            scene.geoms.iter().find(|geom| matches!(geom.shape, Shape::Plane(x, y) if x.infinite && y.infinite))?;
        let normal = [plane.rotation[2], plane.rotation[5], plane.rotation[8]];
        let elevation = dot(sub(eye, plane.position), normal) / radius(scene);
        let inner = haze.depth;
        // The relative height at which a line from an eye at height 1, inclined by 45 degrees, meets the cone.
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

    /// Returns the opacity and the depth of the haze along a ray; `None` if the ray misses the haze.
    #[inline]
    pub fn at(&self, direction: V3) -> Option<(f32, f32)> {
        let local = unrotate(&self.rotation, direction);
        let across = (local[0] * local[0] + local[1] * local[1]).sqrt();
        let slope = local[2] / across.max(1e-12);
        // The relative drop from the eye (0) to the plane (1); the radius of the cone there is 1 - inner * part.
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

/// Blends a colour over another.
#[inline]
pub(crate) fn over(front: f32, opacity: f32, behind: f32) -> f32 {
    opacity * front + (1.0 - opacity) * behind
}
