//! The lighting of OpenGL's fixed pipeline: ambient, scattered and mirrored light, at a point of a surface.

use crate::scalar::power;
use crate::scene::{Geom, Light, Scene};
use crate::vector::{V3, dot, scale, sub, unit};
use swm_simd::vectorize;

/// A light, prepared for a picture.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lamp {
    directional: bool,
    position: V3,
    direction: V3,
    attenuation: V3,
    /// The cosine of the cut-off angle; less than -1 for a lamp that shines everywhere alike.
    edge: f32,
    exponent: f32,
    ambient: V3,
    diffuse: V3,
    specular: V3,
}

/// How a surface answers light.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Matter {
    /// What it scatters.
    pub rgb: V3,
    /// What it shows in the dark.
    pub glow: V3,
    /// What it mirrors of a light.
    pub specular: f32,
    /// How narrow highlights are.
    pub exponent: f32,
}

impl Lamp {
    pub fn new(light: &Light) -> Self {
        // OpenGL ignores angles between 90 and 180 degrees, and a lamp that was told none shines everywhere.
        let everywhere = light.directional || light.cutoff > 90.0;
        Self {
            directional: light.directional,
            position: light.position,
            direction: unit(light.direction),
            attenuation: light.attenuation,
            edge: if everywhere { -2.0 } else { light.cutoff.to_radians().cos() },
            exponent: if everywhere { 0.0 } else { light.exponent },
            ambient: light.ambient,
            diffuse: light.diffuse,
            specular: light.specular,
        }
    }

    /// The direction from a place to the lamp.
    #[inline(always)]
    pub fn from(&self, place: V3) -> V3 {
        let way = sub(self.position, place);
        let by = 1.0 / dot(way, way).max(1e-20).sqrt();
        if self.directional { scale(self.direction, -1.0) } else { scale(way, by) }
    }

    /// What a surface sends to the eye of this lamp's light.
    #[inline(always)]
    fn seen<const DIRECTIONAL: bool>(&self, matter: &Matter, eye: V3, place: V3, normal: V3) -> V3 {
        let (to, strength) = if DIRECTIONAL {
            (scale(self.direction, -1.0), 1.0)
        } else {
            let way = sub(self.position, place);
            let distance = dot(way, way).max(1e-20).sqrt();
            let to = scale(way, 1.0 / distance);
            let [a, b, c] = self.attenuation;
            let fading = 1.0 / (a + distance * (b + distance * c)).max(1e-20);
            let along = -dot(to, self.direction);
            let spot = power(along.clamp(0.0, 1.0), self.exponent);
            (to, if along >= self.edge { fading * spot } else { 0.0 })
        };
        let view = sub(eye, place);
        let view = scale(view, 1.0 / dot(view, view).max(1e-20).sqrt());
        let half = [to[0] + view[0], to[1] + view[1], to[2] + view[2]];
        let facing = dot(normal, to);
        let mirrored = dot(normal, half) / dot(half, half).max(1e-20).sqrt();
        let shine = power(mirrored.clamp(0.0, 1.0), matter.exponent) * matter.specular;
        let shine = if facing > 0.0 { shine } else { 0.0 };
        let facing = facing.max(0.0);
        std::array::from_fn(|k| {
            strength * (matter.rgb[k] * (self.ambient[k] + facing * self.diffuse[k]) + shine * self.specular[k])
        })
    }

    /// What a surface sends to the eye of this lamp's light.
    pub fn at(&self, matter: &Matter, eye: V3, place: V3, normal: V3) -> V3 {
        match self.directional {
            true => self.seen::<true>(matter, eye, place, normal),
            false => self.seen::<false>(matter, eye, place, normal),
        }
    }

    /// Adds what surfaces send to the eye of this lamp's light.
    pub fn add(&self, matter: &Matter, eye: V3, places: [&[f32]; 3], normals: [&[f32]; 3], sums: [&mut [f32]; 3]) {
        match self.directional {
            true => add_directional(self, matter, eye, places, normals, sums),
            false => add_spot(self, matter, eye, places, normals, sums),
        }
    }
}

impl Matter {
    /// What a geom is made of, its colour multiplied.
    pub fn new(geom: &Geom, by: f32) -> Self {
        let rgb = [0, 1, 2].map(|k| geom.rgba[k] * by);
        Self {
            rgb,
            glow: scale(rgb, geom.emission),
            specular: geom.specular,
            // OpenGL's limits.
            exponent: (geom.shininess * 128.0).clamp(0.0, 128.0),
        }
    }

    /// What is there without any lamp.
    pub fn dark(&self, scene: &Scene) -> V3 {
        let everywhere = if scene.lights.is_empty() { 0.3 } else { 0.0 };
        [0, 1, 2].map(|k| self.glow[k] + everywhere * self.rgb[k])
    }
}

vectorize! {
    fn add_directional(
        lamp: &Lamp, matter: &Matter, eye: V3, places: [&[f32]; 3], normals: [&[f32]; 3], sums: [&mut [f32]; 3],
    ) {
        let n = places[0].len();
        let ([px, py, pz], [nx, ny, nz]) = (places.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let [r, g, b] = sums.map(|lane| &mut lane[..n]);
        for i in 0..n {
            let seen = lamp.seen::<true>(matter, eye, [px[i], py[i], pz[i]], [nx[i], ny[i], nz[i]]);
            (r[i], g[i], b[i]) = (r[i] + seen[0], g[i] + seen[1], b[i] + seen[2]);
        }
    }

    fn add_spot(
        lamp: &Lamp, matter: &Matter, eye: V3, places: [&[f32]; 3], normals: [&[f32]; 3], sums: [&mut [f32]; 3],
    ) {
        let n = places[0].len();
        let ([px, py, pz], [nx, ny, nz]) = (places.map(|lane| &lane[..n]), normals.map(|lane| &lane[..n]));
        let [r, g, b] = sums.map(|lane| &mut lane[..n]);
        for i in 0..n {
            let seen = lamp.seen::<false>(matter, eye, [px[i], py[i], pz[i]], [nx[i], ny[i], nz[i]]);
            (r[i], g[i], b[i]) = (r[i] + seen[0], g[i] + seen[1], b[i] + seen[2]);
        }
    }
}
