//! [`Canvas`]: draws scenes, and keeps the memory it needs for that.

use crate::layers::pattern;
use crate::light::Lamp;
use crate::paint::Lit;
use crate::scene::{Assets, Light, Scene};
use crate::shadow::Shadow;
use crate::split::Split;
use crate::strip::{Picture, Strip, clear};
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
///
/// A sample takes 8 bytes for each layer it needs (what is seen, what is mirrored, what is behind glass), and as much again for each
/// of at most 4 views of which it keeps what stands still; a texel of a map of shadows, likewise.
#[derive(Default)]
pub struct Canvas {
    threads: usize,
    split: Split,
    strips: Vec<Strip>,
    lamps: Lamps,
    shadows: Vec<Shadow>,
}

impl Canvas {
    /// An empty one, which draws on the thread that asks.
    pub fn new() -> Self {
        Self::default()
    }

    /// Draws the next pictures on at most so many threads: that which asks, and others of the pool of `rayon` that it belongs to. A
    /// picture is cut where it has enough work for that; its bytes stay the same.
    pub fn spread(&mut self, threads: usize) {
        self.threads = threads;
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
        let pattern = match target {
            Target::Rgb(_) => pattern(samples),
            Target::Depth(_) => &pattern(samples)[..1],
            Target::Labels(_) => pattern(1),
        };
        let picture = Picture { scene, assets, view: &view, pattern };
        self.split.cut(&picture, self.threads);
        self.paint(&picture, target);
    }

    /// Draws a picture in the strips it was cut into.
    fn paint(&mut self, picture: &Picture<'_>, target: Target<'_>) {
        let &Picture { scene, assets, view, .. } = picture;
        let opaque = |geom: usize| !clear(scene, geom, view);
        let Split { ends, pays, .. } = &self.split;
        if self.strips.len() < ends.len() {
            self.strips.resize_with(ends.len(), Strip::default);
        }
        let strips = &mut self.strips[..ends.len()];
        match target {
            Target::Rgb(bytes) => {
                self.lamps.fill(scene);
                let Lamps { plain, shadowed, casting, all } = &self.lamps;
                if self.shadows.len() < casting.len() {
                    self.shadows.resize_with(casting.len(), Shadow::default);
                }
                let shadows = &mut self.shadows[..casting.len()];
                // Texels are to be smaller than pixels.
                let side = (2 * view.width.max(view.height)).clamp(192, 1024);
                both(
                    *pays,
                    || {
                        each(strips, ends, 0, (&mut [], 0), &|strip, rows, _: &mut [u8]| {
                            strip.find(picture, rows, opaque)
                        })
                    },
                    || cast(shadows, casting, *pays, &|shadow, light| shadow.cast(scene, assets, light, side)),
                );
                let lamps = Lit { plain, shadowed, shadows };
                let unshaded = Lit { plain: all, shadowed: &[], shadows: &[] };
                each(strips, ends, 0, (bytes, 3 * view.width), &|strip, _, bytes| {
                    strip.colours(picture, lamps, unshaded, bytes);
                });
            }
            Target::Depth(metres) => each(strips, ends, 0, (metres, view.width), &|strip, rows, metres| {
                strip.find(picture, rows, opaque);
                strip.depths(picture, metres);
            }),
            Target::Labels(labels) => each(strips, ends, 0, (labels, view.width), &|strip, rows, labels| {
                strip.find(picture, rows, |geom| scene.geoms[geom].label.is_some());
                strip.labels(picture, labels);
            }),
        }
    }
}

/// The lamps of a scene.
#[derive(Default)]
struct Lamps {
    /// Those without shadows, and those with, by the places of these.
    plain: Vec<Lamp>,
    shadowed: Vec<Lamp>,
    /// The lights that cast them.
    casting: Vec<Light>,
    /// All, those without shadows first.
    all: Vec<Lamp>,
}

impl Lamps {
    fn fill(&mut self, scene: &Scene) {
        let casts = |light: &&Light| scene.shadows && light.shadows;
        self.casting.clear();
        self.casting.extend(scene.lights.iter().filter(casts));
        self.shadowed.clear();
        self.shadowed.extend(self.casting.iter().map(Lamp::new));
        self.plain.clear();
        self.plain.extend(scene.lights.iter().filter(|light| !casts(light)).map(Lamp::new));
        self.all.clear();
        self.all.extend(self.plain.iter().chain(&self.shadowed));
    }
}

/// Does two things, on two threads where that pays.
fn both(pays: bool, a: impl FnOnce() + Send, b: impl FnOnce() + Send) {
    if pays {
        rayon::join(a, b);
    } else {
        a();
        b();
    }
}

/// Works on every strip, the first of which begins at row `top`, and on its rows of the target, so many numbers each; on a thread each.
fn each<T: Send>(
    strips: &mut [Strip],
    ends: &[usize],
    top: usize,
    (target, row): (&mut [T], usize),
    work: &(impl Fn(&mut Strip, Range<usize>, &mut [T]) + Sync),
) {
    match (strips, ends) {
        ([strip], [end]) => work(strip, top..*end, target),
        (strips, ends) => {
            let (upper, lower) = strips.split_at_mut(strips.len() / 2);
            let (first, last) = ends.split_at(upper.len());
            let middle = first.last().copied().unwrap_or(top);
            let (above, below) = target.split_at_mut((middle - top) * row);
            rayon::join(
                || each(upper, first, top, (above, row), work),
                || each(lower, last, middle, (below, row), work),
            );
        }
    }
}

/// Casts the shadows of lights, on a thread each where that pays.
fn cast(shadows: &mut [Shadow], lights: &[Light], pays: bool, work: &(impl Fn(&mut Shadow, &Light) + Sync)) {
    if let ([shadow, shadows @ ..], [light, lights @ ..]) = (shadows, lights) {
        both(pays && !lights.is_empty(), || work(shadow, light), || cast(shadows, lights, pays, work));
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::{assets, scene};
    use proptest::prelude::*;

    const SIZE: (usize, usize) = (11, 150);

    /// Colours, depths and labels, drawn in strips that end so.
    fn cut(canvas: &mut Canvas, scene: &Scene, ends: &[usize]) -> (Vec<u8>, Vec<u32>, Vec<i32>) {
        let (assets, view, n) = (assets(), View::of(&scene.camera, SIZE.0, SIZE.1), SIZE.0 * SIZE.1);
        let (mut rgb, mut depths, mut labels) = (vec![0; 3 * n], vec![0.0; n], vec![0; n]);
        if seeing(&view) {
            (canvas.split.ends, canvas.split.pays) = (ends.to_vec(), ends.len() > 1);
            let mut draw = |samples, target| {
                canvas.paint(&Picture { scene, assets: &assets, view: &view, pattern: pattern(samples) }, target);
            };
            draw(4, Target::Rgb(&mut rgb));
            draw(1, Target::Depth(&mut depths));
            draw(1, Target::Labels(&mut labels));
        }
        (rgb, depths.into_iter().map(f32::to_bits).collect(), labels)
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]
        #[test]
        fn strips_show_what_the_whole_shows(scene in scene()) {
            let mut canvas = Canvas::new();
            let whole = cut(&mut canvas, &scene, &[150]);
            for ends in [&[64, 150][..], &[128, 150], &[64, 128, 150], &[150]] {
                prop_assert_eq!(&cut(&mut canvas, &scene, ends), &whole, "{:?}", ends);
            }
        }
    }
}
