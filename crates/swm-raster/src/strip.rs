//! [`Strip`]: some rows of a frame, drawn by one thread.

use crate::geometry_cache::{DrawSettings, GeometryCache};
use crate::layers::{Layers, NOTHING, Region, touched};
use crate::paint::{Lighting, Painter, ShadingContext};
use crate::scalar::nearest;
use crate::scene::{Assets, Scene, Shape};
use crate::sky::{self, HazeCone, SkyCache};
use crate::vector::{add, dot, scale, sub};
use crate::view::View;
use std::ops::Range;
use swm_simd::vectorize;

/// Rows of a frame, and the memory for drawing them.
#[derive(Default)]
pub(crate) struct Strip {
    pub main: Layers,
    cache: GeometryCache,
    mirror: Layers,
    transparent: Layers,
    painter: Painter,
    sky_cache: SkyCache,
    /// Red, green and blue of all pixels.
    colours: [Vec<f32>; 3],
    /// Distances and indices of transparent geoms, from near to far.
    transparent_geoms: Vec<(f32, usize)>,
}

/// The frame to draw; its fields are the same for all strips.
#[derive(Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub scene: &'a Scene,
    pub assets: &'a Assets,
    pub view: &'a View,
    /// Positions of samples within a pixel.
    pub pattern: &'static [[f32; 2]],
}

/// Opacity below which geoms are transparent.
const MIN_OPAQUE: f32 = 0.995;

/// Factor of a plane's opacity when it is seen from behind.
const BACK_OPACITY: f32 = 0.3;

impl Strip {
    /// Draws the selected geoms into the depth buffer of some rows.
    pub fn draw_geoms(&mut self, frame: &Frame<'_>, rows: Range<usize>, selected: impl Fn(usize) -> bool) {
        let Frame { scene, assets, view, pattern } = *frame;
        self.main.start(view.width, rows, pattern);
        let geoms = (0u32..).zip(&scene.geoms).filter(|(index, _)| selected(*index as usize));
        let settings = DrawSettings { assets, view, far: scene.camera.far, casting: false };
        self.cache.draw(&mut self.main, settings, geoms);
    }

    /// Writes depths, limited to the depth of the sky or of the far plane.
    pub fn write_depths(&self, &Frame { scene, view, .. }: &Frame<'_>, target_depths: &mut [f32]) {
        let (rays, radius) = (view.rays(), sky::radius(scene));
        let [dx, dy] = self.main.pattern[0];
        for (y, target_depths) in self.main.rows.clone().zip(target_depths.chunks_exact_mut(view.width)) {
            let row = add(rays.direction, scale(rays.directions[1], y as f32 + dy));
            for (x, (target, &depth)) in
                target_depths.iter_mut().zip(&self.main.depths[self.main.span(y, 0, view.width)]).enumerate()
            {
                let direction = add(row, scale(rays.directions[0], x as f32 + dx));
                *target = if scene.sky.is_some() { depth.min(sky::depth(radius, direction)) } else { depth };
            }
        }
    }

    /// Writes the labels of the visible geoms; -1 for pixels without a labelled geom.
    pub fn write_labels(&self, &Frame { scene, view, .. }: &Frame<'_>, labels: &mut [i32]) {
        for (y, labels) in self.main.rows.clone().zip(labels.chunks_exact_mut(view.width)) {
            for (label, &id) in labels.iter_mut().zip(&self.main.ids[self.main.span(y, 0, view.width)]) {
                *label = match id {
                    NOTHING => -1,
                    id => scene.geoms[self.main.geom(id) as usize].label.unwrap_or(-1),
                };
            }
        }
    }

    /// Writes colours. `unshaded` are all lights without their shadows, for mirrored and transparent geoms.
    pub fn write_colours(&mut self, frame: &Frame<'_>, lights: Lighting<'_>, unshaded: Lighting<'_>, bytes: &mut [u8]) {
        let Frame { scene, assets, view, .. } = *frame;
        self.painter.start(scene.geoms.len());
        for colours in &mut self.colours {
            colours.resize(view.width * self.main.rows.len(), 0.0);
        }
        self.sky_cache.paint(scene, assets, view, &mut self.main, &mut self.colours);
        if scene.reflections {
            self.draw_reflection(frame, unshaded);
            self.painter.start(scene.geoms.len());
        }
        let Self { main, painter, colours, .. } = self;
        let context = ShadingContext { scene, assets, view, lights, dimmed: 1.0 };
        let full = [0, 0, view.width, view.height];
        painter.paint(main, &context, full, |pixels, part, light| add_part(colours, pixels, part, light));
        draw_haze(scene, view, main, colours);
        self.draw_transparent(frame, unshaded);
        let [r, g, b] = &self.colours;
        to_bytes(r, g, b, bytes.as_chunks_mut::<3>().0);
    }

    /// Draws the mirror image in the first reflective geom, without shadows.
    fn draw_reflection(&mut self, &Frame { scene, assets, view, .. }: &Frame<'_>, lights: Lighting<'_>) {
        let reflecting = |index: &usize| {
            let geom = &scene.geoms[*index];
            let shape = matches!(geom.shape, Shape::Plane(..) | Shape::Box(_));
            shape && geom.reflectance > 0.0 && !is_transparent(scene, *index, view)
        };
        let Some(index) = (0..scene.geoms.len()).find(reflecting) else { return };
        let geom = &scene.geoms[index];
        let normal = [geom.rotation[2], geom.rotation[5], geom.rotation[8]];
        // A box reflects on its upper side.
        let height = if let Shape::Box(halves) = geom.shape { halves[2] } else { 0.0 };
        let point = add(geom.position, scale(normal, height));
        let Some(region) = touched(geom, assets, view) else { return };
        if dot(sub(view.position, point), normal) < 0.0 {
            return;
        }
        let mirrored = view.mirrored(point, normal);
        let Self { main, mirror, painter, colours, .. } = self;
        mirror.start(view.width, main.rows.clone(), main.pattern);
        mirror.ids.fill(NOTHING);
        // Restricts drawing to the pixels of the mirror and to geoms in front of the mirror.
        let own = u32::try_from(index).unwrap_or(NOTHING);
        select_mirror(own, scene.camera.far, &main.ids, &mut mirror.depths);
        let mut visible = [usize::MAX, usize::MAX, 0, 0];
        for (other, geom) in (0u32..).zip(&scene.geoms) {
            if other != own && !is_transparent(scene, other as usize, view) {
                let touched = mirror.draw(other, geom, (assets, &mirrored), Some(&main.depths), false);
                visible = touched.map_or(visible, |touched| union(visible, touched));
            }
        }
        let visible = intersection(visible, region);
        // Only the view is mirrored: mirroring geoms and lights together does not change the lighting.
        let context = ShadingContext { scene, assets, view: &mirrored, lights, dimmed: geom.reflectance };
        painter.paint(mirror, &context, visible, |pixels, part, light| add_part(colours, pixels, part, light));
    }

    /// Draws transparent geoms from near to far, and again from far to near as MuJoCo does, without shadows.
    fn draw_transparent(&mut self, &Frame { scene, assets, view, .. }: &Frame<'_>, lights: Lighting<'_>) {
        let Self { main, transparent, painter, colours, transparent_geoms, .. } = self;
        transparent_geoms.clear();
        for (index, geom) in scene.geoms.iter().enumerate().filter(|(index, _)| is_transparent(scene, *index, view)) {
            let distance = match geom.shape {
                Shape::Plane(..) => 1e10,
                shape => {
                    let (_, halves) = shape.bounds();
                    let offset = sub(geom.position, view.position);
                    dot(offset, offset).sqrt() - dot(halves, halves).sqrt()
                }
            };
            transparent_geoms.push((distance, index));
        }
        if transparent_geoms.is_empty() {
            return;
        }
        transparent_geoms.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        painter.start(scene.geoms.len());
        let context = ShadingContext { scene, assets, view, lights, dimmed: 1.0 };
        transparent.start(view.width, main.rows.clone(), main.pattern);
        for &(_, index) in transparent_geoms.iter().chain(transparent_geoms.iter().rev()) {
            let geom = &scene.geoms[index];
            let Some(region) = touched(geom, assets, view) else { continue };
            let [x0, y0, x1, y1] = main.clip_to_rows(region);
            for row in (y0..y1).map(|y| main.span(y, x0, x1)) {
                transparent.depths[row.clone()].copy_from_slice(&main.depths[row.clone()]);
                transparent.ids[row].fill(NOTHING);
            }
            transparent.clear_triangles();
            transparent.draw(u32::try_from(index).unwrap_or(NOTHING), geom, (assets, view), None, false);
            let opacity = match geom.shape {
                Shape::Plane(..) if is_seen_from_behind(scene, index, view) => BACK_OPACITY * geom.rgba[3],
                _ => geom.rgba[3],
            };
            painter.paint(transparent, &context, region, |pixels, part, light| {
                let opacity = (part * opacity).clamp(0.0, 1.0);
                for (colours, light) in colours.iter_mut().zip(light) {
                    for (colour, light) in colours[pixels.clone()].iter_mut().zip(light) {
                        *colour = sky::over(*light, opacity, *colour);
                    }
                }
            });
        }
    }
}

/// Adds colours to pixels, weighted by the covered part.
fn add_part(colours: &mut [Vec<f32>; 3], pixels: Range<usize>, part: f32, light: [&[f32]; 3]) {
    for (colours, light) in colours.iter_mut().zip(light) {
        for (colour, light) in colours[pixels.clone()].iter_mut().zip(light) {
            *colour += part * light;
        }
    }
}

/// Returns the smallest region around two regions.
fn union(a: Region, b: Region) -> Region {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

/// Returns the intersection of two regions; it is empty if they do not overlap.
fn intersection(a: Region, b: Region) -> Region {
    let [x, y] = [a[0].max(b[0]), a[1].max(b[1])];
    [x, y, a[2].min(b[2]).max(x), a[3].min(b[3]).max(y)]
}

/// Whether a geom is a plane that is seen from behind.
fn is_seen_from_behind(scene: &Scene, index: usize, view: &View) -> bool {
    let geom = &scene.geoms[index];
    let normal = [geom.rotation[2], geom.rotation[5], geom.rotation[8]];
    matches!(geom.shape, Shape::Plane(..)) && dot(sub(view.position, geom.position), normal) < 0.0
}

/// Whether a geom is transparent in a view.
pub(crate) fn is_transparent(scene: &Scene, index: usize, view: &View) -> bool {
    scene.geoms[index].rgba[3] < MIN_OPAQUE || is_seen_from_behind(scene, index, view)
}

/// Draws haze over the sky and the far ends of planes.
fn draw_haze(scene: &Scene, view: &View, main: &Layers, colours: &mut [Vec<f32>; 3]) {
    let Some(cone) =
        scene.haze.filter(|_| scene.sky.is_some()).and_then(|haze| HazeCone::new(scene, &haze, view.position))
    else {
        return;
    };
    let rays = view.rays();
    let share = 1.0 / main.samples as f32;
    for (line, y) in main.rows.clone().enumerate() {
        let row = add(rays.direction, scale(rays.directions[1], y as f32 + 0.5));
        for x in 0..view.width {
            let Some((opacity, depth)) = cone.at(add(row, scale(rays.directions[0], x as f32 + 0.5))) else { continue };
            let open = main.depths[main.span(y, x, x + 1)].iter().filter(|far| **far > depth).count();
            for (colours, haze) in colours.iter_mut().zip(cone.rgb) {
                let colour = &mut colours[line * view.width + x];
                *colour = sky::over(haze, opacity * open as f32 * share, *colour);
            }
        }
    }
}

vectorize! {
    /// Sets the depths of samples that show the mirror to the far plane, and excludes all other samples.
    fn select_mirror(own: u32, far: f32, ids: &[u32], depths: &mut [f32]) {
        for (depth, id) in depths.iter_mut().zip(ids) {
            *depth = if *id == own { far } else { f32::NEG_INFINITY };
        }
    }

    /// Converts colours to bytes, rounded; NaN becomes black.
    #[allow(clippy::manual_clamp, reason = "`clamp` would keep NaN")]
    fn to_bytes(r: &[f32], g: &[f32], b: &[f32], bytes: &mut [[u8; 3]]) {
        let n = bytes.len().min(r.len());
        let (r, g, b, bytes) = (&r[..n], &g[..n], &b[..n], &mut bytes[..n]);
        let byte = |x: f32| nearest((x * 255.0).max(0.0).min(255.0)) as u8;
        for i in 0..n {
            bytes[i] = [byte(r[i]), byte(g[i]), byte(b[i])];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intersection_of_distant_regions_is_empty() {
        assert_eq!(intersection([2, 3, 9, 8], [4, 1, 20, 6]), [4, 3, 9, 6]);
        assert_eq!(intersection([0, 0, 3, 3], [5, 0, 9, 3]), [5, 0, 5, 3]);
        assert_eq!(intersection([0, 6, 3, 9], [0, 0, 3, 4]), [0, 6, 3, 6]);
    }
}
