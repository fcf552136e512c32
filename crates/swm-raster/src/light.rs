//! Lighting of OpenGL's fixed pipeline: ambient, diffuse and specular light at a point of a surface.

use crate::scalar::power;
use crate::scene::{Geom, Light, Scene};
use crate::vector::{V3, dot, scale, sub, unit};
use swm_simd::vectorize;

/// A light, prepared for a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ShadingLight {
    directional: bool,
    position: V3,
    direction: V3,
    attenuation: V3,
    /// Cosine of the cutoff angle; below -1 for a light that shines in all directions.
    edge: f32,
    exponent: f32,
    ambient: V3,
    diffuse: V3,
    specular: V3,
}

/// The material of a geom, in OpenGL's terms.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Material {
    /// Diffuse and ambient colour.
    pub rgb: V3,
    /// Emitted colour.
    pub emission: V3,
    /// Specular reflectance, a grey.
    pub specular: f32,
    /// Exponent of specular highlights.
    pub exponent: f32,
}

impl ShadingLight {
    pub fn new(light: &Light) -> Self {
        // OpenGL ignores angles between 90 and 180 degrees; a cutoff above 90 means a light in all directions.
        let omnidirectional = light.directional || light.cutoff > 90.0;
        Self {
            directional: light.directional,
            position: light.position,
            direction: unit(light.direction),
            attenuation: light.attenuation,
            edge: if omnidirectional { -2.0 } else { light.cutoff.to_radians().cos() },
            exponent: if omnidirectional { 0.0 } else { light.exponent },
            ambient: light.ambient,
            diffuse: light.diffuse,
            specular: light.specular,
        }
    }

    /// Returns the unit direction from a position to the light.
    #[inline(always)]
    pub fn direction_from(&self, position: V3) -> V3 {
        let offset = sub(self.position, position);
        let by = 1.0 / dot(offset, offset).max(1e-20).sqrt();
        if self.directional { scale(self.direction, -1.0) } else { scale(offset, by) }
    }

    /// Returns the light that a surface reflects to the eye.
    #[inline(always)]
    fn reflected<const DIRECTIONAL: bool>(&self, material: &Material, eye: V3, position: V3, normal: V3) -> V3 {
        let (to, strength) = if DIRECTIONAL {
            (scale(self.direction, -1.0), 1.0)
        } else {
            let offset = sub(self.position, position);
            let distance = dot(offset, offset).max(1e-20).sqrt();
            let to = scale(offset, 1.0 / distance);
            let [a, b, c] = self.attenuation;
            let fading = 1.0 / (a + distance * (b + distance * c)).max(1e-20);
            let along = -dot(to, self.direction);
            let spot = power(along.clamp(0.0, 1.0), self.exponent);
            (to, if along >= self.edge { fading * spot } else { 0.0 })
        };
        let view = sub(eye, position);
        let view = scale(view, 1.0 / dot(view, view).max(1e-20).sqrt());
        let half = [to[0] + view[0], to[1] + view[1], to[2] + view[2]];
        let facing = dot(normal, to);
        let mirrored = dot(normal, half) / dot(half, half).max(1e-20).sqrt();
        let shine = power(mirrored.clamp(0.0, 1.0), material.exponent) * material.specular;
        let shine = if facing > 0.0 { shine } else { 0.0 };
        let facing = facing.max(0.0);
        std::array::from_fn(|k| {
            strength * (material.rgb[k] * (self.ambient[k] + facing * self.diffuse[k]) + shine * self.specular[k])
        })
    }

    /// Returns the light that a surface reflects to the eye.
    pub fn at(&self, material: &Material, eye: V3, position: V3, normal: V3) -> V3 {
        match self.directional {
            true => self.reflected::<true>(material, eye, position, normal),
            false => self.reflected::<false>(material, eye, position, normal),
        }
    }

    /// Adds the light that surfaces reflect to the eye to `sums`.
    pub fn add(
        &self,
        material: &Material,
        eye: V3,
        positions: [&[f32]; 3],
        normals: [&[f32]; 3],
        sums: [&mut [f32]; 3],
    ) {
        match self.directional {
            true => add_directional(self, material, eye, positions, normals, sums),
            false => add_spot(self, material, eye, positions, normals, sums),
        }
    }
}

impl Material {
    /// Returns the material of a geom with its colour multiplied by `by`.
    pub fn new(geom: &Geom, by: f32) -> Self {
        let rgb = [0, 1, 2].map(|k| geom.rgba[k] * by);
        Self {
            rgb,
            emission: scale(rgb, geom.emission),
            specular: geom.specular,
            // OpenGL limits exponents to this range.
            exponent: (geom.shininess * 128.0).clamp(0.0, 128.0),
        }
    }

    /// Returns the colour without any light: emission, and dim ambient light in a scene without lights.
    pub fn base_colour(&self, scene: &Scene) -> V3 {
        let ambient = if scene.lights.is_empty() { 0.3 } else { 0.0 };
        [0, 1, 2].map(|k| self.emission[k] + ambient * self.rgb[k])
    }
}

vectorize! {
    fn add_directional(
        light: &ShadingLight, material: &Material, eye: V3, positions: [&[f32]; 3], normals: [&[f32]; 3], sums: [&mut [f32]; 3],
    ) {
        let n = positions[0].len();
        let ([px, py, pz], [nx, ny, nz]) = (positions.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let [r, g, b] = sums.map(|lane| &mut lane[..n]);
        for i in 0..n {
            let reflected = light.reflected::<true>(material, eye, [px[i], py[i], pz[i]], [nx[i], ny[i], nz[i]]);
            (r[i], g[i], b[i]) = (r[i] + reflected[0], g[i] + reflected[1], b[i] + reflected[2]);
        }
    }

    fn add_spot(
        light: &ShadingLight, material: &Material, eye: V3, positions: [&[f32]; 3], normals: [&[f32]; 3], sums: [&mut [f32]; 3],
    ) {
        let n = positions[0].len();
        let ([px, py, pz], [nx, ny, nz]) = (positions.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let [r, g, b] = sums.map(|lane| &mut lane[..n]);
        for i in 0..n {
            let reflected = light.reflected::<false>(material, eye, [px[i], py[i], pz[i]], [nx[i], ny[i], nz[i]]);
            (r[i], g[i], b[i]) = (r[i] + reflected[0], g[i] + reflected[1], b[i] + reflected[2]);
        }
    }
}
