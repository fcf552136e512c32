//! Texture coordinates of fragments, and the number of texels that a pixel covers.

use super::batch::{Batch, ShadingContext};
use crate::scene::{Geom, Mapping};
use crate::texture::{Texture, TextureLookup};
use crate::vector::{V3, add, dot, scale, sub, unrotate};
use crate::view::{Rays, View};
use swm_simd::vectorize;

impl Batch {
    /// Looks up the texture colours of the fragments.
    pub(super) fn tint(&mut self, geom: &Geom, context: &ShadingContext<'_>, rays: &Rays) {
        let n = self.n;
        let Some((paint, texture)) =
            geom.paint.and_then(|paint| Some((paint, context.assets.textures.get(paint.texture)?)))
        else {
            self.tint.iter_mut().for_each(|lane| lane[..n].fill(1.0));
            return;
        };
        let rays = LocalRays::new(geom, context.view, rays);
        if let Mapping::Flat { scale, offset } = paint.mapping {
            let flat = FlatRays { rays, scale, offset };
            let (positions, normals) =
                (self.local.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
            let [s, t] = self.coordinates.each_mut().map(|l| &mut l[..n]);
            flat_coordinates(
                texture,
                &flat,
                &self.x[..n],
                &self.y[..n],
                positions,
                normals,
                s,
                t,
                &mut self.texels_per_pixel[..n],
            );
            self.face[..n].fill(0);
        } else if let Mapping::Cube(by) = paint.mapping {
            let (positions, normals) =
                (self.local.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
            let ([s, t], texels_per_pixel) =
                (self.coordinates.each_mut().map(|l| &mut l[..n]), &mut self.texels_per_pixel[..n]);
            let faces = &mut self.face[..n];
            cube_coordinates(
                texture,
                &rays,
                by,
                &self.x[..n],
                &self.y[..n],
                positions,
                normals,
                s,
                t,
                texels_per_pixel,
                faces,
            );
        } else {
            self.find_coordinates(geom, paint.mapping, texture, &rays);
        }
        let [s, t] = self.coordinates.each_ref().map(|l| &l[..n]);
        let lookup = TextureLookup { s, t, texels_per_pixel: &self.texels_per_pixel[..n], faces: &self.face[..n] };
        texture.colours(&lookup, &mut self.sampler, self.tint.each_mut().map(|l| &mut l[..n]));
    }

    /// Computes texture coordinates of mappings that are rare in scenes, one fragment at a time.
    fn find_coordinates(&mut self, geom: &Geom, mapping: Mapping, texture: &Texture, rays: &LocalRays) {
        for i in 0..self.n {
            let (position, normal) = (self.local.each_ref().map(|l| l[i]), self.normal.each_ref().map(|l| l[i]));
            self.face[i] = 0;
            let derivatives = rays.screen_derivatives(self.x[i], self.y[i], position, normal);
            let (s, t);
            match mapping {
                Mapping::Sides(repeat) => {
                    // The axes that run to the right and up on this side of the box.
                    let [u, v] = side_axes(unrotate(&geom.rotation, normal));
                    let (_, halves) = geom.shape.bounds();
                    let by = [0.5 * repeat[0] / halves[u].max(1e-6), 0.5 * repeat[1] / halves[v].max(1e-6)];
                    let change = [(0, u), (1, v)]
                        .map(|(k, axis)| by[k] * derivatives[0][axis].abs().max(derivatives[1][axis].abs()));
                    (s, t) = (by[0] * position[u] + 0.5 * repeat[0], 0.5 * repeat[1] - by[1] * position[v]);
                    self.texels_per_pixel[i] = texture.texels_per_pixel(change);
                }
                // The texture coordinates of a mesh are used unchanged, with the finest mip level.
                Mapping::Own | Mapping::Flat { .. } | Mapping::Cube(_) => {
                    [s, t] = self.coordinates.each_ref().map(|lane| lane[i]);
                    self.texels_per_pixel[i] = 0.0;
                }
            }
            (self.coordinates[0][i], self.coordinates[1][i]) = (s, t);
        }
    }
}

/// Returns the axes of a box's side that run to the right and up on its texture.
fn side_axes(normal: V3) -> [usize; 2] {
    if normal[0].abs() > 0.5 {
        [1, 2]
    } else if normal[1].abs() > 0.5 {
        [0, 2]
    } else {
        [0, 1]
    }
}

/// The rays of a view in a geom's coordinates.
#[derive(Clone, Copy)]
struct LocalRays {
    rotation: [f32; 9],
    eye: V3,
    ahead: V3,
    direction: V3,
    origins: [V3; 2],
    directions: [V3; 2],
}

/// The rays, and the mapping of a flat texture.
struct FlatRays {
    rays: LocalRays,
    scale: [f32; 2],
    offset: [f32; 2],
}

impl LocalRays {
    fn new(geom: &Geom, view: &View, rays: &Rays) -> Self {
        let local = |a: V3| unrotate(&geom.rotation, a);
        Self {
            rotation: geom.rotation,
            eye: local(sub(view.position, geom.position)),
            ahead: local(view.forward),
            direction: local(rays.direction),
            origins: rays.origins.map(local),
            directions: rays.directions.map(local),
        }
    }

    /// Returns the change of a position along its surface from this pixel to the right and to the lower neighbour.
    /// `normal` is in world coordinates.
    #[inline(always)]
    fn screen_derivatives(&self, x: f32, y: f32, position: V3, normal: V3) -> [V3; 2] {
        let normal = unrotate(&self.rotation, normal);
        let depth = dot(sub(position, self.eye), self.ahead);
        let direction = add(self.direction, add(scale(self.directions[0], x), scale(self.directions[1], y)));
        let facing = dot(normal, direction);
        let facing = 1.0 / if facing.abs() > 1e-6 { facing } else { 1e-6 };
        [
            self.screen_derivative(0, depth, direction, normal, facing),
            self.screen_derivative(1, depth, direction, normal, facing),
        ]
    }

    /// Returns the change towards the right neighbour (`side` 0) or the lower neighbour (`side` 1).
    #[inline(always)]
    fn screen_derivative(&self, side: usize, depth: f32, direction: V3, normal: V3, facing: f32) -> V3 {
        let free = add(self.origins[side], scale(self.directions[side], depth));
        sub(free, scale(direction, dot(normal, free) * facing))
    }
}

vectorize! {
    /// Computes coordinates on a flat texture and the texels per pixel.
    fn flat_coordinates(
        texture: &Texture, flat: &FlatRays, x: &[f32], y: &[f32], positions: [&[f32]; 3], normals: [&[f32]; 3],
        s: &mut [f32], t: &mut [f32], texels_per_pixel: &mut [f32],
    ) {
        let n = x.len();
        let ([px, py, pz], [nx, ny, nz]) = (positions.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let (y, s, t, texels_per_pixel) = (&y[..n], &mut s[..n], &mut t[..n], &mut texels_per_pixel[..n]);
        for i in 0..n {
            let position = [px[i], py[i], pz[i]];
            let [right, down] = flat.rays.screen_derivatives(x[i], y[i], position, [nx[i], ny[i], nz[i]]);
            s[i] = flat.scale[0] * position[0] + flat.offset[0];
            t[i] = flat.scale[1] * position[1] + flat.offset[1];
            let change = |k: usize| flat.scale[k].abs() * right[k].abs().max(down[k].abs());
            texels_per_pixel[i] = texture.texels_per_pixel([change(0), change(1)]);
        }
    }

    /// Computes faces of a cube texture, coordinates on these faces, and the texels per pixel.
    fn cube_coordinates(
        texture: &Texture, rays: &LocalRays, by: V3, x: &[f32], y: &[f32], positions: [&[f32]; 3], normals: [&[f32]; 3],
        s: &mut [f32], t: &mut [f32], texels_per_pixel: &mut [f32], faces: &mut [u32],
    ) {
        let n = x.len();
        let ([px, py, pz], [nx, ny, nz]) = (positions.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let (y, s, t, texels_per_pixel, faces) = (&y[..n], &mut s[..n], &mut t[..n], &mut texels_per_pixel[..n], &mut faces[..n]);
        let multiply = |a: V3| [a[0] * by[0], a[1] * by[1], a[2] * by[2]];
        for i in 0..n {
            let position = [px[i], py[i], pz[i]];
            let [right, down] = rays.screen_derivatives(x[i], y[i], position, [nx[i], ny[i], nz[i]]);
            let (face, position, texels) = texture.face_in(multiply(position), multiply(right), multiply(down));
            (faces[i], s[i], t[i], texels_per_pixel[i]) = (face, position[0], position[1], texels);
        }
    }
}
