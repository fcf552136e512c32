//! [`Canvas`]: draws scenes, and keeps the memory it needs for that.

use crate::layers::{Layers, NOTHING, Region, pattern, touched};
use crate::light::Lamp;
use crate::paint::{Lamps, Look, Painter};
use crate::scene::{Assets, Scene, Shape};
use crate::shadow::Shadow;
use crate::simd::{nearest, vectorised};
use crate::sky::{self, Backdrop, Veil};
use crate::vector::{add, dot, scale, sub};
use crate::view::View;
use std::ops::Range;

/// What to draw, and where: `height` rows of `width` pixels, the upper row first.
pub enum Target<'a> {
    /// Red, green, blue: three bytes a pixel.
    Rgb(&'a mut [u8]),
    /// Distance along the direction the camera looks in.
    Depth(&'a mut [f32]),
    /// Labels of geoms, -1 where there is none.
    Labels(&'a mut [i32]),
}

/// Draws scenes. One canvas serves any scenes and sizes; after the first pictures of a kind, it allocates nothing.
#[derive(Default)]
pub struct Canvas {
    main: Layers,
    mirror: Layers,
    glass: Layers,
    shadows: Vec<Shadow>,
    plain: Vec<Lamp>,
    shadowed: Vec<(Lamp, usize)>,
    painter: Painter,
    backdrop: Backdrop,
    /// Red, green and blue of all pixels.
    colours: [Vec<f32>; 3],
    /// Places of geoms one sees through, from near to far, and how far they are.
    clear: Vec<(f32, usize)>,
}

/// Less opaque geoms let something through.
const OPAQUE: f32 = 0.995;

/// How much of a plane is left of its opacity, seen from behind.
const BEHIND: f32 = 0.3;

impl Canvas {
    /// An empty one.
    pub fn new() -> Self {
        Self::default()
    }

    /// Draws a scene at `width` times `height` pixels, colours with so many samples a pixel (1, 2 or 4). Labels are taken in the middle
    /// of every pixel, depths at its first sample, as graphics cards do.
    ///
    /// Whatever does not fit is left as it is: rows beyond the end of the target, places beyond the end of the assets, geoms with
    /// numbers that are not finite. A camera with such numbers sees nothing.
    pub fn draw(
        &mut self,
        scene: &Scene,
        assets: &Assets,
        (width, height): (usize, usize),
        samples: usize,
        target: Target<'_>,
    ) {
        let view = View::of(&scene.camera, width, height);
        let size = match &target {
            Target::Rgb(bytes) => bytes.len() / 3,
            Target::Depth(metres) => metres.len(),
            Target::Labels(labels) => labels.len(),
        };
        if width == 0 || height == 0 || width > 1 << 14 || height > 1 << 14 || size < width * height {
            return;
        }
        if !seeing(&view) {
            match target {
                Target::Rgb(bytes) => bytes.fill(0),
                Target::Depth(metres) => metres.fill(scene.camera.far),
                Target::Labels(labels) => labels.fill(-1),
            }
            return;
        }
        match target {
            Target::Rgb(bytes) => self.colours(scene, assets, &view, samples, bytes),
            Target::Depth(metres) => {
                self.visible(scene, assets, &view, &pattern(samples)[..1], |geom| !clear(scene, geom, &view));
                self.depths(scene, &view, metres);
            }
            Target::Labels(labels) => {
                self.visible(scene, assets, &view, pattern(1), |geom| scene.geoms[geom].label.is_some());
                for (y, labels) in labels.chunks_exact_mut(width).take(height).enumerate() {
                    for (label, &id) in labels.iter_mut().zip(&self.main.ids[self.main.span(y, 0, width)]) {
                        *label = match id {
                            NOTHING => -1,
                            id => scene.geoms[self.main.geom(id) as usize].label.unwrap_or(-1),
                        };
                    }
                }
            }
        }
    }

    /// Finds what is nearest at every sample, of the geoms that count.
    fn visible(
        &mut self,
        scene: &Scene,
        assets: &Assets,
        view: &View,
        at: &'static [[f32; 2]],
        counts: impl Fn(usize) -> bool,
    ) {
        self.main.start(view.width, view.height, at);
        self.main.clear(scene.camera.far);
        for (number, geom) in (0u32..).zip(&scene.geoms) {
            if counts(number as usize) {
                self.main.draw(number, geom, (assets, view), None, false);
            }
        }
    }

    /// Writes depths; where nothing is, that of the sky, or how far one sees.
    #[allow(clippy::cast_precision_loss)]
    fn depths(&self, scene: &Scene, view: &View, metres: &mut [f32]) {
        let (rays, radius) = (view.rays(), sky::radius(scene));
        let [dx, dy] = self.main.pattern[0];
        for (y, metres) in metres.chunks_exact_mut(view.width).take(view.height).enumerate() {
            let row = add(rays.direction, scale(rays.directions[1], y as f32 + dy));
            for (x, (metre, &depth)) in
                metres.iter_mut().zip(&self.main.depths[self.main.span(y, 0, view.width)]).enumerate()
            {
                let direction = add(row, scale(rays.directions[0], x as f32 + dx));
                *metre = if scene.sky.is_some() { depth.min(sky::depth(radius, direction)) } else { depth };
            }
        }
    }

    fn colours(&mut self, scene: &Scene, assets: &Assets, view: &View, samples: usize, bytes: &mut [u8]) {
        let whole = [0, 0, view.width, view.height];
        self.visible(scene, assets, view, pattern(samples), |geom| !clear(scene, geom, view));
        self.lamps(scene, assets, view);
        self.painter.start(scene.geoms.len());
        for colours in &mut self.colours {
            colours.resize(view.width * view.height, 0.0);
        }
        self.backdrop.paint(scene, assets, view, &mut self.main, &mut self.colours);
        if scene.reflections {
            self.reflect(scene, assets, view);
            self.painter.start(scene.geoms.len());
        }
        let Self { main, shadows, plain, shadowed, painter, colours, .. } = self;
        let look = Look {
            scene,
            assets,
            view,
            lamps: Lamps { plain: plain.as_slice(), shadowed: shadowed.as_slice(), shadows: shadows.as_slice() },
            dimmed: 1.0,
        };
        painter.paint(main, &look, whole, |pixels, part, seen| add_part(colours, pixels, part, seen));
        veil(scene, view, main, colours);
        self.see_through(scene, assets, view);
        let [r, g, b] = &self.colours;
        to_bytes(r, g, b, bytes.as_chunks_mut::<3>().0);
    }

    /// Prepares lights and their shadows.
    fn lamps(&mut self, scene: &Scene, assets: &Assets, view: &View) {
        self.plain.clear();
        self.shadowed.clear();
        // Texels are to be smaller than pixels.
        let side = (2 * view.width.max(view.height)).clamp(192, 1024);
        for light in &scene.lights {
            if scene.shadows && light.shadows {
                let number = self.shadowed.len();
                if self.shadows.len() == number {
                    self.shadows.push(Shadow::default());
                }
                self.shadows[number].cast(scene, assets, light, side);
                self.shadowed.push((Lamp::new(light), number));
            } else {
                self.plain.push(Lamp::new(light));
            }
        }
    }

    /// Draws the mirror image in the first geom that reflects. It is lit without shadows.
    fn reflect(&mut self, scene: &Scene, assets: &Assets, view: &View) {
        let reflecting = |number: &usize| {
            let geom = &scene.geoms[*number];
            let shape = matches!(geom.shape, Shape::Plane(..) | Shape::Box(_));
            shape && geom.reflectance > 0.0 && !clear(scene, *number, view)
        };
        let Some(number) = (0..scene.geoms.len()).find(reflecting) else { return };
        let geom = &scene.geoms[number];
        let normal = [geom.rotation[2], geom.rotation[5], geom.rotation[8]];
        // Of a box, the upper side reflects.
        let height = if let Shape::Box(halves) = geom.shape { halves[2] } else { 0.0 };
        let point = add(geom.position, scale(normal, height));
        let Some(region) = touched(geom, assets, view) else { return };
        if dot(sub(view.position, point), normal) < 0.0 {
            return;
        }
        let mirrored = view.mirrored(point, normal);
        let Self { main, mirror, shadows, plain, shadowed, painter, colours, .. } = self;
        mirror.start(view.width, view.height, main.pattern);
        mirror.ids.fill(NOTHING);
        // One sees only where the mirror is, and what is in front of it.
        let own = u32::try_from(number).unwrap_or(NOTHING);
        for (depth, &id) in mirror.depths.iter_mut().zip(&main.ids) {
            *depth = if id == own { scene.camera.far } else { f32::NEG_INFINITY };
        }
        let mut seen = [usize::MAX, usize::MAX, 0, 0];
        for (other, geom) in (0u32..).zip(&scene.geoms) {
            if other != own && !clear(scene, other as usize, view) {
                let touched = mirror.draw(other, geom, (assets, &mirrored), Some(&main.depths), false);
                seen = touched.map_or(seen, |touched| around(seen, touched));
            }
        }
        let seen = within(seen, region);
        // Mirrored lamps shine on mirrored things: the same light as on the things themselves. Nothing is in a shadow.
        let all = plain.len();
        plain.extend(shadowed.iter().map(|(lamp, _)| *lamp));
        let look = Look {
            scene,
            assets,
            view: &mirrored,
            lamps: Lamps { plain: plain.as_slice(), shadowed: &[], shadows: shadows.as_slice() },
            dimmed: geom.reflectance,
        };
        painter.paint(mirror, &look, seen, |pixels, part, seen| add_part(colours, pixels, part, seen));
        plain.truncate(all);
    }

    /// Draws what one sees through: from near to far, and again from far to near. Nothing shades it.
    fn see_through(&mut self, scene: &Scene, assets: &Assets, view: &View) {
        let Self { main, glass, shadows, plain, shadowed, painter, colours, clear, .. } = self;
        clear.clear();
        for (number, geom) in scene.geoms.iter().enumerate().filter(|(number, _)| self::clear(scene, *number, view)) {
            let distance = match geom.shape {
                Shape::Plane(..) => 1e10,
                shape => {
                    let (_, halves) = shape.bounds();
                    let way = sub(geom.position, view.position);
                    dot(way, way).sqrt() - dot(halves, halves).sqrt()
                }
            };
            clear.push((distance, number));
        }
        if clear.is_empty() {
            return;
        }
        clear.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let all = plain.len();
        plain.extend(shadowed.iter().map(|(lamp, _)| *lamp));
        painter.start(scene.geoms.len());
        let look = Look {
            scene,
            assets,
            view,
            lamps: Lamps { plain: plain.as_slice(), shadowed: &[], shadows: shadows.as_slice() },
            dimmed: 1.0,
        };
        glass.start(view.width, view.height, main.pattern);
        for &(_, number) in clear.iter().chain(clear.iter().rev()) {
            let geom = &scene.geoms[number];
            let Some(region) = touched(geom, assets, view) else { continue };
            let [x0, y0, x1, y1] = region;
            for row in (y0..y1).map(|y| main.span(y, x0, x1)) {
                glass.depths[row.clone()].copy_from_slice(&main.depths[row.clone()]);
                glass.ids[row].fill(NOTHING);
            }
            glass.forget();
            glass.draw(u32::try_from(number).unwrap_or(NOTHING), geom, (assets, view), None, false);
            let opacity = match geom.shape {
                Shape::Plane(..) if hind(scene, number, view) => BEHIND * geom.rgba[3],
                _ => geom.rgba[3],
            };
            painter.paint(glass, &look, region, |pixels, part, seen| {
                let opacity = (part * opacity).clamp(0.0, 1.0);
                for (colours, seen) in colours.iter_mut().zip(seen) {
                    for (colour, seen) in colours[pixels.clone()].iter_mut().zip(seen) {
                        *colour = sky::over(*seen, opacity, *colour);
                    }
                }
            });
        }
        plain.truncate(all);
    }
}

/// Adds parts of colours to those of pixels.
fn add_part(colours: &mut [Vec<f32>; 3], pixels: Range<usize>, part: f32, seen: [&[f32]; 3]) {
    for (colours, seen) in colours.iter_mut().zip(seen) {
        for (colour, seen) in colours[pixels.clone()].iter_mut().zip(seen) {
            *colour += part * seen;
        }
    }
}

/// The smallest region around two.
fn around(a: Region, b: Region) -> Region {
    [a[0].min(b[0]), a[1].min(b[1]), a[2].max(b[2]), a[3].max(b[3])]
}

/// What is in both of two regions; of regions that lie apart, one without pixels.
fn within(a: Region, b: Region) -> Region {
    let [x, y] = [a[0].max(b[0]), a[1].max(b[1])];
    [x, y, a[2].min(b[2]).max(x), a[3].min(b[3]).max(y)]
}

/// Whether a camera's numbers make a picture.
fn seeing(view: &View) -> bool {
    let numbers = [view.position, view.right, view.up, view.forward];
    let density = view.dense[0] * view.dense[1];
    numbers.iter().flatten().all(|x| x.is_finite())
        && density.is_finite()
        && density > 0.0
        && view.left.is_finite()
        && view.top.is_finite()
        && view.near > 0.0
}

/// Whether one sees the back of a plane.
fn hind(scene: &Scene, number: usize, view: &View) -> bool {
    let geom = &scene.geoms[number];
    let normal = [geom.rotation[2], geom.rotation[5], geom.rotation[8]];
    matches!(geom.shape, Shape::Plane(..)) && dot(sub(view.position, geom.position), normal) < 0.0
}

/// Whether one sees through a geom.
fn clear(scene: &Scene, number: usize, view: &View) -> bool {
    scene.geoms[number].rgba[3] < OPAQUE || hind(scene, number, view)
}

/// Draws haze over the sky and the far ends of planes.
#[allow(clippy::cast_precision_loss)]
fn veil(scene: &Scene, view: &View, main: &Layers, colours: &mut [Vec<f32>; 3]) {
    let Some(veil) = scene.haze.filter(|_| scene.sky.is_some()).and_then(|haze| Veil::new(scene, &haze, view.position))
    else {
        return;
    };
    let rays = view.rays();
    let share = 1.0 / main.samples as f32;
    for y in 0..view.height {
        let row = add(rays.direction, scale(rays.directions[1], y as f32 + 0.5));
        for x in 0..view.width {
            let Some((opacity, depth)) = veil.at(add(row, scale(rays.directions[0], x as f32 + 0.5))) else { continue };
            let open = main.depths[main.span(y, x, x + 1)].iter().filter(|far| **far > depth).count();
            for (colours, veil) in colours.iter_mut().zip(veil.rgb) {
                let colour = &mut colours[y * view.width + x];
                *colour = sky::over(veil, opacity * open as f32 * share, *colour);
            }
        }
    }
}

vectorised! {
    /// Colours to bytes, rounded; what is no number is black.
    #[allow(clippy::manual_clamp, reason = "`clamp` would keep what is no number")]
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
    fn regions_that_lie_apart_share_no_pixels() {
        assert_eq!(within([2, 3, 9, 8], [4, 1, 20, 6]), [4, 3, 9, 6]);
        assert_eq!(within([0, 0, 3, 3], [5, 0, 9, 3]), [5, 0, 5, 3]);
        assert_eq!(within([0, 6, 3, 9], [0, 0, 3, 4]), [0, 6, 3, 6]);
    }
}
