//! Shadow maps: the depth buffer of the scene, seen from a light.
//!
//! A map covers only the geoms that cast shadows, so that a small map is sharp. The parts of a convex
//! shape that lie in the shape's own shadow face away from the light. So only meshes are tested for their own shadow.

use crate::geometry_cache::{DrawSettings, GeometryCache};
use crate::layers::{Layers, NOTHING, pattern, touched};
use crate::light::ShadingLight;
use crate::scene::{Assets, Geom, Light, Scene, Shape};
use crate::texture::MANY;
use crate::vector::{V3, across, cross, dot, unit};
use crate::view::View;
use swm_simd::LANES;
use swm_simd::vectorize;

/// Texels along the side of the map that MuJoCo's renderer draws; a finer map is not needed.
const FINEST: usize = 4096;

/// Cosine up to which a surface counts as edge-on to the light.
const EDGE_ON: f32 = 0.01;

/// The shadow map of one light.
#[derive(Default)]
pub(crate) struct Shadow {
    layers: Layers,
    cache: GeometryCache,
    view: Option<View>,
    /// Whether each geom can shadow itself.
    shadows_itself: Vec<bool>,
}

impl Shadow {
    /// Draws the map of a light, with at most `side` texels along a side. Geoms nearer to the light than
    /// `scene.camera.near` cast no shadow.
    #[allow(clippy::too_many_lines, reason = "one setup of the view and its crop")]
    pub fn cast(&mut self, scene: &Scene, assets: &Assets, light: &Light, side: usize) {
        self.view = None;
        let forward = unit(light.direction);
        if !light.position.iter().chain(&light.direction).all(|x| x.is_finite()) || forward == [0.0; 3] {
            return;
        }
        let up = across(forward);
        let reach = match light.directional {
            true => scene.shadow_reach,
            false => (0.5 * (2.0 * light.cutoff * scene.shadow_angle).min(160.0).to_radians()).tan(),
        };
        if !(reach > 0.0 && reach.is_finite()) {
            return;
        }
        let pixels_per_unit = FINEST as f32 / (2.0 * reach);
        let full = View {
            position: light.position,
            right: cross(forward, up),
            up,
            forward,
            left: -reach,
            top: reach,
            pixels_per_unit: [pixels_per_unit; 2],
            near: scene.camera.near,
            orthographic: light.directional,
            width: FINEST,
            height: FINEST,
            mirrored: false,
        };
        let casts = |geom: &Geom| geom.casts && !matches!(geom.shape, Shape::Plane(..));
        let casters = || (0u32..).zip(&scene.geoms).filter(|(_, geom)| casts(geom));
        let mut region = [usize::MAX, usize::MAX, 0, 0];
        for [x0, y0, x1, y1] in casters().filter_map(|(_, geom)| touched(geom, assets, &full)) {
            region = [region[0].min(x0), region[1].min(y0), region[2].max(x1), region[3].max(y1)];
        }
        let [x0, y0, x1, y1] = region;
        if x0 >= x1 || y0 >= y1 {
            return;
        }
        let (wide, high) = (x1 - x0, y1 - y0);
        let longest = wide.max(high);
        let (width, height) = match longest > side {
            true => ((wide * side).div_ceil(longest), (high * side).div_ceil(longest)),
            false => (wide, high),
        };
        let view = View {
            left: full.left + x0 as f32 / pixels_per_unit,
            top: full.top - y0 as f32 / pixels_per_unit,
            pixels_per_unit: [
                pixels_per_unit * width as f32 / wide as f32,
                pixels_per_unit * height as f32 / high as f32,
            ],
            width,
            height,
            ..full
        };
        self.layers.start(width, 0..height, pattern(1));
        self.shadows_itself.clear();
        self.shadows_itself.extend(scene.geoms.iter().map(|geom| matches!(geom.shape, Shape::Mesh(_))));
        let settings = DrawSettings { assets, view: &view, far: scene.camera.far, casting: true };
        self.cache.draw(&mut self.layers, settings, casters());
        self.view = Some(view);
    }

    /// Writes 1 for positions on the surface of a geom that a light reaches, and 0 for positions in its shadow.
    pub fn write_lit(
        &self,
        geom: u32,
        light: &ShadingLight,
        positions: [&[f32]; 3],
        normals: [&[f32]; 3],
        lit: &mut [f32],
    ) {
        facing(light, positions, normals, lit);
        let Some(view) = &self.view else {
            lit.iter_mut().for_each(|lit| *lit = if *lit < -EDGE_ON { 0.0 } else { 1.0 });
            return;
        };
        let mut texels = [[0.0; MANY]; 3];
        project(view, positions, &mut texels);
        let [x, y, depths] = &texels;
        for (from, lit) in (0..).step_by(LANES).zip(lit.chunks_mut(LANES)) {
            // Surfaces that face away from the light are in their own shadow. Edge-on surfaces count as lit, so that
            // they receive the light's ambient part.
            let (mut cosines, mut count) = ([0.0; LANES], 0);
            for ((cosine, lit), x) in cosines.iter_mut().zip(lit.iter_mut()).zip(&x[from..]) {
                *cosine = *lit;
                *lit = if *cosine < -EDGE_ON { 0.0 } else { 1.0 };
                count += u32::from((*x >= 0.0) & (*cosine >= -EDGE_ON));
            }
            if count == 0 {
                continue;
            }
            for (i, (lit, facing)) in (from..).zip(lit.iter_mut().zip(cosines)) {
                let inside = x[i] >= 0.0 && facing >= -EDGE_ON;
                if inside && self.is_shadowed(view, geom, [x[i], y[i], depths[i]], facing) {
                    *lit = 0.0;
                }
            }
        }
    }

    /// Whether a geom lies between the light and a position on the map.
    #[inline]
    fn is_shadowed(&self, view: &View, geom: u32, [x, y, depth]: V3, facing: f32) -> bool {
        let at = self.layers.span(y as usize, x as usize, x as usize).start;
        let id = self.layers.ids[at];
        if id == NOTHING {
            return false;
        }
        let caster = self.layers.geom(id);
        if caster == geom && !self.shadows_itself.get(caster as usize).copied().unwrap_or(true) {
            return false;
        }
        // A texel holds the depth at its centre: half a texel away, a slanted surface is nearer by this margin.
        let slope = ((1.0 - facing * facing).max(0.0).sqrt() / facing.max(0.05)).min(8.0);
        let margin = (0.5 + slope) / view.pixels_at(depth);
        depth > self.layers.depths[at] + margin
    }
}

vectorize! {
    /// Projects positions onto the map. The x of a position outside the map is -1.
    fn project(view: &View, positions: [&[f32]; 3], texels: &mut [[f32; MANY]; 3]) {
        let n = positions[0].len().min(MANY);
        let [px, py, pz] = positions.map(|lane| &lane[..n]);
        let [x, y, depths] = texels;
        let (width, height) = (view.width as f32, view.height as f32);
        for i in 0..n {
            let ([u, v, w], depth) = view.project([px[i], py[i], pz[i]]);
            let (u, v) = (u / w, v / w);
            let inside = (u >= 0.0) & (v >= 0.0) & (u < width) & (v < height) & (depth > view.near);
            x[i] = if inside { u } else { -1.0 };
            y[i] = v;
            depths[i] = depth;
        }
    }

    /// Computes the cosines between normals and the directions to a light.
    fn facing(light: &ShadingLight, positions: [&[f32]; 3], normals: [&[f32]; 3], cosines: &mut [f32]) {
        let n = cosines.len();
        let ([px, py, pz], [nx, ny, nz]) = (positions.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        for i in 0..n {
            cosines[i] = dot([nx[i], ny[i], nz[i]], light.direction_from([px[i], py[i], pz[i]]));
        }
    }
}
