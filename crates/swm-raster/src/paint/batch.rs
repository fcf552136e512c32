//! Up to [`MANY`] fragments of one geom: their positions and normals, and their lighting in passes.

use super::light_grid::LightGrids;
use super::{Lane, Run};
use crate::cast::PosedShape;
use crate::layers::{Layers, TRIANGLE};
use crate::light::{Material, ShadingLight};
use crate::scene::{Assets, Geom, Scene, Shape};
use crate::shadow::Shadow;
use crate::texture::{MANY, Sampler};
use crate::vector::{V3, add, dot, rotate};
use crate::view::View;
use std::ops::Range;
use swm_simd::{LANES, vectorize};

/// Fragments of one geom.
pub(super) struct Batch {
    pub n: usize,
    pub x: Lane,
    pub y: Lane,
    /// Depths along the rays, relative to the depth of the pose.
    pub depth: Lane,
    pub position: [Lane; 3],
    pub local: [Lane; 3],
    pub normal: [Lane; 3],
    pub coordinates: [Lane; 2],
    /// The grid cell, for planes and boxes.
    pub cell: [u32; MANY],
    /// The position within the grid cell, from 0 to 1.
    pub within: [Lane; 2],
    /// The texels per pixel of a texture.
    pub texels_per_pixel: Lane,
    /// The face of a cube texture.
    pub face: [u32; MANY],
    pub sampler: Sampler,
    /// 1 for fragments that the current light reaches, 0 for fragments in its shadow.
    pub lit: Lane,
    pub tint: [Lane; 3],
    /// The light of one pass.
    pub pass: [Lane; 3],
    /// The light of all passes so far; the colours in the end.
    pub sum: [Lane; 3],
}

impl Default for Batch {
    fn default() -> Self {
        const ZERO: Lane = [0.0; MANY + LANES];
        Batch {
            n: 0,
            x: ZERO,
            y: ZERO,
            depth: ZERO,
            position: [ZERO; 3],
            local: [ZERO; 3],
            normal: [ZERO; 3],
            coordinates: [ZERO; 2],
            cell: [0; MANY],
            within: [ZERO; 2],
            texels_per_pixel: ZERO,
            face: [0; MANY],
            sampler: Sampler::default(),
            lit: ZERO,
            tint: [ZERO; 3],
            pass: [ZERO; 3],
            sum: [ZERO; 3],
        }
    }
}

/// The lights of a frame. The first lighting pass adds all lights without shadows; each further pass adds one light
/// with its shadow.
#[derive(Clone, Copy)]
pub(crate) struct Lighting<'a> {
    /// Lights without shadows.
    pub plain: &'a [ShadingLight],
    /// Lights with shadows.
    pub shadowed: &'a [ShadingLight],
    /// The shadow maps of the lights with shadows.
    pub shadows: &'a [Shadow],
}

/// The inputs of shading that are the same for all fragments.
pub(crate) struct ShadingContext<'a> {
    pub scene: &'a Scene,
    pub assets: &'a Assets,
    pub view: &'a View,
    pub lights: Lighting<'a>,
    /// Factor of all colours.
    pub dimmed: f32,
}

impl Batch {
    /// Computes the colours of fragments into `sum`.
    pub fn shade(
        &mut self,
        grids: &mut LightGrids,
        runs: &[Run],
        (index, geom, shape_pose): (u32, &Geom, Option<&PosedShape>),
        layers: &Layers,
        context: &ShadingContext<'_>,
    ) {
        self.set_pixels(runs, layers);
        let n = self.n;
        match shape_pose {
            Some(shape_pose) => self.place_on_primitive(geom, shape_pose),
            None => self.place_on_mesh(geom, runs, layers, context),
        }
        let rays = context.view.rays();
        self.tint(geom, context, &rays);
        let material = Material::new(geom, context.dimmed);
        let lit_at_corners = self.is_coarse(geom, context.view);
        let passes = 1 + context.lights.shadowed.len();
        let start = if lit_at_corners { grids.of(index, geom, passes) } else { 0 };
        if lit_at_corners {
            self.cells(geom);
        }
        for pass in 0..passes {
            if lit_at_corners {
                self.light_of_corners(grids, start, (pass, passes), geom, &material, context);
            } else {
                self.light(pass, &material, context);
            }
            if pass == 0 {
                for (sum, light) in self.sum.iter_mut().zip(&self.pass) {
                    sum[..n].copy_from_slice(&light[..n]);
                }
            } else {
                let (light, shadow) = (&context.lights.shadowed[pass - 1], &context.lights.shadows[pass - 1]);
                let (positions, normals) =
                    (self.position.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
                let lit = &mut self.lit[..n];
                shadow.write_lit(index, light, positions, normals, lit);
                for (sum, light) in self.sum.iter_mut().zip(&self.pass) {
                    add_lit(&mut sum[..n], &light[..n], lit);
                }
            }
        }
        for (sum, tint) in self.sum.iter_mut().zip(&self.tint) {
            multiply_tints(&mut sum[..n], &tint[..n]);
        }
    }

    /// Sets the pixel positions at which fragments are shaded.
    fn set_pixels(&mut self, runs: &[Run], layers: &Layers) {
        self.n = 0;
        for run in runs {
            let [dx, dy] = layers.centres[usize::from(run.samples)];
            let fragments = self.n..self.n + usize::from(run.count);
            for (x, i) in self.x[fragments.clone()].iter_mut().zip(0u16..) {
                *x = f32::from(run.x + i) + dx;
            }
            self.y[fragments.clone()].fill(f32::from(run.y) + dy);
            self.n = fragments.end;
        }
    }

    /// Calls `show` with the pixels, the covered fraction and the colours of each run.
    pub fn show(&self, runs: &[Run], layers: &Layers, show: &mut impl FnMut(Range<usize>, f32, [&[f32]; 3])) {
        let mut begin = 0;
        for run in runs {
            let row = usize::from(run.y) - layers.rows.start;
            let (pixel, count) = (row * layers.width + usize::from(run.x), usize::from(run.count));
            let covered = run.samples.count_ones() as f32 / layers.samples as f32;
            show(pixel..pixel + count, covered, self.sum.each_ref().map(|lane| &lane[begin..begin + count]));
            begin += count;
        }
    }

    /// Computes positions and normals on a primitive.
    fn place_on_primitive(&mut self, geom: &Geom, shape_pose: &PosedShape) {
        let n = self.n;
        self.coordinates.iter_mut().for_each(|lane| lane[..n].fill(0.0));
        let [px, py, pz] = &mut self.local;
        let [nx, ny, nz] = &mut self.normal;
        shape_pose.surface(
            &self.x[..n],
            &self.y[..n],
            &mut self.depth[..n],
            [&mut px[..n], &mut py[..n], &mut pz[..n]],
            [&mut nx[..n], &mut ny[..n], &mut nz[..n]],
        );
        to_world(geom, shape_pose.sizes, n, &mut self.local, &mut self.normal, &mut self.position);
    }

    /// Computes positions and normals on a mesh.
    fn place_on_mesh(&mut self, geom: &Geom, runs: &[Run], layers: &Layers, context: &ShadingContext<'_>) {
        let Shape::Mesh(mesh) = geom.shape else { return };
        let mesh = &context.assets.meshes[mesh];
        // A fully covered pixel shows the triangle of its first sample.
        let ids = runs.iter().flat_map(|run| {
            let (x, y, count) = (usize::from(run.x), usize::from(run.y), usize::from(run.count));
            let covered = run.samples.count_ones() as usize == layers.samples;
            let first = layers.span(y, x, x + count).step_by(layers.samples);
            first.map(move |at| if covered { layers.ids[at] } else { run.id })
        });
        for (i, id) in ids.enumerate() {
            let triangle = &layers.triangles[(id & !TRIANGLE) as usize];
            let level = mesh.level(triangle.level as usize);
            let (face, corners) = (level.faces[triangle.face as usize], level.corners[triangle.face as usize]);
            // If the centre of the pixel is outside the triangle, a point on the triangle's edge is shaded.
            let (shares, _) = triangle.at(self.x[i], self.y[i]);
            let shares = shares.map(|share| share.clamp(0.0, 1.0));
            let sum = shares[0] + shares[1] + shares[2];
            let shares = shares.map(|share| share / if sum > 0.0 { sum } else { 1.0 });
            let mix = |of: [V3; 3]| -> V3 {
                std::array::from_fn(|k| shares[0] * of[0][k] + shares[1] * of[1][k] + shares[2] * of[2][k])
            };
            let local = mix(face.map(|position| level.positions[position as usize]));
            let normal = rotate(&geom.rotation, mix(corners.map(|corner| level.normals[corner as usize])));
            let by = 1.0 / dot(normal, normal).max(1e-20).sqrt();
            let position = add(geom.position, rotate(&geom.rotation, local));
            for k in 0..3 {
                (self.local[k][i], self.position[k][i], self.normal[k][i]) = (local[k], position[k], normal[k] * by);
            }
            for k in 0..2 {
                let of = corners.map(|corner| level.coordinates[corner as usize][k]);
                self.coordinates[k][i] = shares[0] * of[0] + shares[1] * of[1] + shares[2] * of[2];
            }
        }
    }

    /// Computes one lighting pass at every fragment.
    fn light(&mut self, pass: usize, material: &Material, context: &ShadingContext<'_>) {
        let n = self.n;
        let base = if pass == 0 { material.base_colour(context.scene) } else { [0.0; 3] };
        for (lane, base) in self.pass.iter_mut().zip(base) {
            lane[..n].fill(base);
        }
        let (positions, normals) = (self.position.each_ref().map(|l| &l[..n]), self.normal.each_ref().map(|l| &l[..n]));
        match pass {
            0 => {
                for light in context.lights.plain {
                    let sums = self.pass.each_mut().map(|l| &mut l[..n]);
                    light.add(material, context.view.position, positions, normals, sums);
                }
            }
            pass => {
                let sums = self.pass.each_mut().map(|l| &mut l[..n]);
                context.lights.shadowed[pass - 1].add(material, context.view.position, positions, normals, sums);
            }
        }
        for lane in &mut self.pass {
            lane[..n].iter_mut().for_each(|x| *x = x.min(1.0));
        }
    }
}

vectorize! {
    /// Multiplies light with texture colours and clips to white.
    fn multiply_tints(sums: &mut [f32], tints: &[f32]) {
        for (sum, tint) in sums.iter_mut().zip(tints) {
            *sum = (*sum * tint).min(1.0);
        }
    }

    /// Adds light multiplied by `lit`.
    fn add_lit(sums: &mut [f32], light: &[f32], lit: &[f32]) {
        for ((sum, light), lit) in sums.iter_mut().zip(light).zip(lit) {
            *sum += light * lit;
        }
    }

    /// Converts unit coordinates to local and world coordinates, and normals to unit normals in world coordinates.
    fn to_world(
        geom: &Geom, sizes: V3, n: usize, local: &mut [Lane; 3], normal: &mut [Lane; 3], position: &mut [Lane; 3],
    ) {
        let [lx, ly, lz] = local;
        let [nx, ny, nz] = normal;
        let [px, py, pz] = position;
        let by = sizes.map(|size| 1.0 / size);
        for i in 0..n.min(MANY) {
            let at = [lx[i] * sizes[0], ly[i] * sizes[1], lz[i] * sizes[2]];
            (lx[i], ly[i], lz[i]) = (at[0], at[1], at[2]);
            let [x, y, z] = add(geom.position, rotate(&geom.rotation, at));
            (px[i], py[i], pz[i]) = (x, y, z);
            let [x, y, z] = rotate(&geom.rotation, [nx[i] * by[0], ny[i] * by[1], nz[i] * by[2]]);
            let length = (x * x + y * y + z * z).max(1e-30).sqrt();
            (nx[i], ny[i], nz[i]) = (x / length, y / length, z / length);
        }
    }
}
