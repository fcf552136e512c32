//! What is behind everything: a cube texture on a cylinder around the camera, and haze before it.

use crate::layers::{Layers, NOTHING};
use crate::scene::{Assets, Geom, Haze, Scene, Shape};
use crate::texture::{MANY, Reader, Spots, Texture};
use crate::vector::{V3, add, dot, scale, sub, unrotate};
use crate::view::View;
use std::ops::Range;
use std::sync::Arc;
use swm_simd::vectorize;

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

/// The sky as it was seen last. It is so far away that it stays the same while a camera only moves: its rows are looked up once.
#[derive(Default)]
pub(crate) struct Backdrop {
    /// The texture and the rays it was seen along.
    seen: Option<(Arc<Texture>, V3, [V3; 2])>,
    width: usize,
    rows: Range<usize>,
    /// Red, green and blue of pixels, and by row whether they were looked up.
    colours: [Vec<f32>; 3],
    known: Vec<bool>,
    reader: Reader,
    /// Scratch: how much of each pixel of a row is open, and how far the sky is there.
    open: Vec<f32>,
    far: Vec<f32>,
}

impl Backdrop {
    /// Paints the sky where nothing is before it, and black elsewhere, in the rows of the layers.
    #[allow(clippy::cast_precision_loss)]
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
        let known = self.seen.as_ref().is_some_and(|(seen, direction, directions)| {
            Arc::ptr_eq(seen, texture) && *direction == rays.direction && *directions == rays.directions
        });
        if !known || (self.width, &self.rows) != (view.width, &main.rows) {
            self.seen = Some((Arc::clone(texture), rays.direction, rays.directions));
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
                // The sky is nearer than the far ends of endless planes.
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
                look_up(texture, &mut self.reader, row, rays.directions, [r, g, b]);
            }
            for (colours, sky) in colours.iter_mut().zip(&self.colours) {
                shine_through(&sky[pixels.clone()], &self.open, &mut colours[pixels.clone()]);
            }
        }
    }
}

/// The sky's colours along the rays of a row, which begins so, and to the right and down.
fn look_up(texture: &Texture, reader: &mut Reader, row: V3, [right, down]: [V3; 2], [r, g, b]: [&mut [f32]; 3]) {
    // The texture's y axis points upwards.
    let turn = |[x, y, z]: V3| [x, z, -y];
    let (row, right, down) = (turn(row), turn(right), turn(down));
    let ([mut s, mut t, mut dense], mut faces) = ([[0.0; MANY]; 3], [0; MANY]);
    for from in (0..r.len()).step_by(MANY) {
        let part = from..r.len().min(from + MANY);
        let n = part.len();
        find(texture, &row, &right, &down, from, &mut s, &mut t, &mut dense, &mut faces);
        let spots = Spots { s: &s[..n], t: &t[..n], dense: &dense[..n], faces: &faces[..n] };
        texture.colours(&spots, reader, [&mut r[part.clone()], &mut g[part.clone()], &mut b[part]]);
    }
}

vectorize! {
    /// Where on the sky rays of a row meet it, from pixel `from` on.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    fn find(
        texture: &Texture, row: &V3, right: &V3, down: &V3, from: usize, s: &mut [f32; MANY], t: &mut [f32; MANY],
        dense: &mut [f32; MANY], faces: &mut [u32; MANY],
    ) {
        for i in 0..MANY {
            let direction = add(*row, scale(*right, from as f32 + (i as u32 as i32 as f32 + 0.5)));
            let (face, spot, texels) = texture.face_in(direction, *right, *down);
            (faces[i], s[i], t[i], dense[i]) = (face, spot[0], spot[1], texels);
        }
    }

    /// The depths at which rays of a row, which begins so, meet the sky.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    fn depths(radius: f32, row: V3, right: V3, far: &mut [f32]) {
        for (i, far) in far.iter_mut().enumerate() {
            *far = depth(radius, add(row, scale(right, i as u32 as i32 as f32 + 0.5)));
        }
    }

    /// Takes away what is farther than the sky.
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

    /// The sky as far as pixels are open.
    fn shine_through(sky: &[f32], open: &[f32], colours: &mut [f32]) {
        for ((sky, open), colour) in sky.iter().zip(open).zip(colours) {
            *colour = sky * open;
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
pub(crate) fn over(front: f32, opacity: f32, behind: f32) -> f32 {
    opacity * front + (1.0 - opacity) * behind
}
