//! [`Strip`]: some rows of a picture, which one thread draws.

use crate::layers::{Layers, NOTHING, Region, touched};
use crate::paint::{Lit, Look, Painter};
use crate::scalar::nearest;
use crate::scene::{Assets, Scene, Shape};
use crate::sky::{self, Backdrop, Veil};
use crate::still::{Setting, Still};
use crate::vector::{add, dot, scale, sub};
use crate::view::View;
use std::ops::Range;
use swm_simd::vectorize;

/// Rows of a picture, and the memory they need.
#[derive(Default)]
pub(crate) struct Strip {
    pub main: Layers,
    still: Still,
    mirror: Layers,
    glass: Layers,
    painter: Painter,
    backdrop: Backdrop,
    /// Red, green and blue of all pixels.
    colours: [Vec<f32>; 3],
    /// Places of geoms one sees through, from near to far, and how far they are.
    clear: Vec<(f32, usize)>,
}

/// A picture to be drawn: what is the same for all its strips.
#[derive(Clone, Copy)]
pub(crate) struct Picture<'a> {
    pub scene: &'a Scene,
    pub assets: &'a Assets,
    pub view: &'a View,
    /// Where samples are in a pixel.
    pub pattern: &'static [[f32; 2]],
}

/// Less opaque geoms let something through.
const OPAQUE: f32 = 0.995;

/// How much of a plane is left of its opacity, seen from behind.
const BEHIND: f32 = 0.3;

impl Strip {
    /// Finds what is nearest at every sample of some rows, of the geoms that count.
    pub fn find(&mut self, picture: &Picture<'_>, rows: Range<usize>, counts: impl Fn(usize) -> bool) {
        let Picture { scene, assets, view, pattern } = *picture;
        self.main.start(view.width, rows, pattern);
        let geoms = (0u32..).zip(&scene.geoms).filter(|(number, _)| counts(*number as usize));
        let setting = Setting { assets, view, far: scene.camera.far, casting: false };
        self.still.draw(&mut self.main, setting, geoms);
    }

    /// Writes depths; where nothing is, that of the sky, or how far one sees.
    #[allow(clippy::cast_precision_loss)]
    pub fn depths(&self, &Picture { scene, view, .. }: &Picture<'_>, metres: &mut [f32]) {
        let (rays, radius) = (view.rays(), sky::radius(scene));
        let [dx, dy] = self.main.pattern[0];
        for (y, metres) in self.main.rows.clone().zip(metres.chunks_exact_mut(view.width)) {
            let row = add(rays.direction, scale(rays.directions[1], y as f32 + dy));
            for (x, (metre, &depth)) in
                metres.iter_mut().zip(&self.main.depths[self.main.span(y, 0, view.width)]).enumerate()
            {
                let direction = add(row, scale(rays.directions[0], x as f32 + dx));
                *metre = if scene.sky.is_some() { depth.min(sky::depth(radius, direction)) } else { depth };
            }
        }
    }

    /// Writes labels.
    pub fn labels(&self, &Picture { scene, view, .. }: &Picture<'_>, labels: &mut [i32]) {
        for (y, labels) in self.main.rows.clone().zip(labels.chunks_exact_mut(view.width)) {
            for (label, &id) in labels.iter_mut().zip(&self.main.ids[self.main.span(y, 0, view.width)]) {
                *label = match id {
                    NOTHING => -1,
                    id => scene.geoms[self.main.geom(id) as usize].label.unwrap_or(-1),
                };
            }
        }
    }

    /// Writes colours. `unshaded` are the lamps without their shadows, for what is seen in mirrors and through glass.
    pub fn colours(&mut self, picture: &Picture<'_>, lamps: Lit<'_>, unshaded: Lit<'_>, bytes: &mut [u8]) {
        let Picture { scene, assets, view, .. } = *picture;
        self.painter.start(scene.geoms.len());
        for colours in &mut self.colours {
            colours.resize(view.width * self.main.rows.len(), 0.0);
        }
        self.backdrop.paint(scene, assets, view, &mut self.main, &mut self.colours);
        if scene.reflections {
            self.reflect(picture, unshaded);
            self.painter.start(scene.geoms.len());
        }
        let Self { main, painter, colours, .. } = self;
        let look = Look { scene, assets, view, lamps, dimmed: 1.0 };
        let whole = [0, 0, view.width, view.height];
        painter.paint(main, &look, whole, |pixels, part, seen| add_part(colours, pixels, part, seen));
        veil(scene, view, main, colours);
        self.see_through(picture, unshaded);
        let [r, g, b] = &self.colours;
        to_bytes(r, g, b, bytes.as_chunks_mut::<3>().0);
    }

    /// Draws the mirror image in the first geom that reflects. It is lit without shadows.
    fn reflect(&mut self, &Picture { scene, assets, view, .. }: &Picture<'_>, lamps: Lit<'_>) {
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
        let Self { main, mirror, painter, colours, .. } = self;
        mirror.start(view.width, main.rows.clone(), main.pattern);
        mirror.ids.fill(NOTHING);
        // One sees only where the mirror is, and what is in front of it.
        let own = u32::try_from(number).unwrap_or(NOTHING);
        open(own, scene.camera.far, &main.ids, &mut mirror.depths);
        let mut seen = [usize::MAX, usize::MAX, 0, 0];
        for (other, geom) in (0u32..).zip(&scene.geoms) {
            if other != own && !clear(scene, other as usize, view) {
                let touched = mirror.draw(other, geom, (assets, &mirrored), Some(&main.depths), false);
                seen = touched.map_or(seen, |touched| around(seen, touched));
            }
        }
        let seen = within(seen, region);
        // Mirrored lamps shine on mirrored things: the same light as on the things themselves. Nothing is in a shadow.
        let look = Look { scene, assets, view: &mirrored, lamps, dimmed: geom.reflectance };
        painter.paint(mirror, &look, seen, |pixels, part, seen| add_part(colours, pixels, part, seen));
    }

    /// Draws what one sees through: from near to far, and again from far to near. Nothing shades it.
    fn see_through(&mut self, &Picture { scene, assets, view, .. }: &Picture<'_>, lamps: Lit<'_>) {
        let Self { main, glass, painter, colours, clear, .. } = self;
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
        painter.start(scene.geoms.len());
        let look = Look { scene, assets, view, lamps, dimmed: 1.0 };
        glass.start(view.width, main.rows.clone(), main.pattern);
        for &(_, number) in clear.iter().chain(clear.iter().rev()) {
            let geom = &scene.geoms[number];
            let Some(region) = touched(geom, assets, view) else { continue };
            let [x0, y0, x1, y1] = main.part(region);
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

/// Whether one sees the back of a plane.
fn hind(scene: &Scene, number: usize, view: &View) -> bool {
    let geom = &scene.geoms[number];
    let normal = [geom.rotation[2], geom.rotation[5], geom.rotation[8]];
    matches!(geom.shape, Shape::Plane(..)) && dot(sub(view.position, geom.position), normal) < 0.0
}

/// Whether one sees through a geom.
pub(crate) fn clear(scene: &Scene, number: usize, view: &View) -> bool {
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
    for (line, y) in main.rows.clone().enumerate() {
        let row = add(rays.direction, scale(rays.directions[1], y as f32 + 0.5));
        for x in 0..view.width {
            let Some((opacity, depth)) = veil.at(add(row, scale(rays.directions[0], x as f32 + 0.5))) else { continue };
            let open = main.depths[main.span(y, x, x + 1)].iter().filter(|far| **far > depth).count();
            for (colours, veil) in colours.iter_mut().zip(veil.rgb) {
                let colour = &mut colours[line * view.width + x];
                *colour = sky::over(veil, opacity * open as f32 * share, *colour);
            }
        }
    }
}

vectorize! {
    /// One sees so far where a geom is, and nothing elsewhere.
    fn open(own: u32, far: f32, ids: &[u32], depths: &mut [f32]) {
        for (depth, id) in depths.iter_mut().zip(ids) {
            *depth = if *id == own { far } else { f32::NEG_INFINITY };
        }
    }

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
