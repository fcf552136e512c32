//! [`Canvas`]: draws scenes and reuses its memory from frame to frame.

use crate::layers::pattern;
use crate::light::ShadingLight;
use crate::paint::Lighting;
use crate::scene::{Assets, Light, Scene};
use crate::shadow::Shadow;
use crate::split::Split;
use crate::strip::{Frame, Strip, is_transparent};
use crate::view::View;
use std::ops::Range;

/// The quantity to draw, with the memory for the result: `height` rows of `width` pixels, the upper row first.
pub enum Target<'a> {
    /// Red, green and blue, `[height, width, 3]`.
    Rgb(&'a mut [u8]),
    /// Depth along the camera's direction, in the scene's unit of length, `[height, width]`.
    Depth(&'a mut [f32]),
    /// Labels of geoms, `[height, width]`; -1 for pixels without a labelled geom.
    Labels(&'a mut [i32]),
}

/// Draws scenes of any content and size. After the first frames of a scene, the canvas does not allocate memory.
///
/// A sample takes 8 bytes in each layer that a frame needs (main, mirrored, transparent), and 8 bytes for each of at
/// most 4 views with cached static geometry. A texel of a shadow map takes 8 bytes as well.
#[derive(Default)]
pub struct Canvas {
    threads: usize,
    split: Split,
    strips: Vec<Strip>,
    lights: LightSet,
    shadows: Vec<Shadow>,
}

impl Canvas {
    /// Makes an empty canvas that draws on the calling thread.
    pub fn new() -> Self {
        Self::default()
    }

    /// Sets the number of threads of the next frames: the calling thread and further threads of its `rayon` pool.
    /// Frames with too little work are not split; the bytes of a frame do not depend on the number of threads.
    pub fn set_threads(&mut self, threads: usize) {
        self.threads = threads;
    }

    /// Draws a scene at `width` × `height` pixels, colours with 1, 2 or 4 samples per pixel. As on graphics cards,
    /// labels are sampled at the centre of every pixel and depths at its first sample.
    ///
    /// Invalid input draws nothing and never panics: targets that are too small stay unchanged, and geoms with unknown
    /// assets or values that are not finite are left out. A camera with values that are not finite gives an empty
    /// frame.
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
            Target::Depth(depths) => depths.len(),
            Target::Labels(labels) => labels.len(),
        };
        if width == 0 || height == 0 || width > 1 << 14 || height > 1 << 14 || size < width * height {
            return;
        }
        if !is_valid(&view) {
            match target {
                Target::Rgb(bytes) => bytes.fill(0),
                Target::Depth(depths) => depths.fill(scene.camera.far),
                Target::Labels(labels) => labels.fill(-1),
            }
            return;
        }
        let pattern = match target {
            Target::Rgb(_) => pattern(samples),
            Target::Depth(_) => &pattern(samples)[..1],
            Target::Labels(_) => pattern(1),
        };
        let frame = Frame { scene, assets, view: &view, pattern };
        self.split.cut(&frame, self.threads);
        self.paint(&frame, target);
    }

    /// Draws a frame in the strips of `self.split`.
    fn paint(&mut self, frame: &Frame<'_>, target: Target<'_>) {
        let &Frame { scene, assets, view, .. } = frame;
        let opaque = |geom: usize| !is_transparent(scene, geom, view);
        let Split { ends, parallel, .. } = &self.split;
        if self.strips.len() < ends.len() {
            self.strips.resize_with(ends.len(), Strip::default);
        }
        let strips = &mut self.strips[..ends.len()];
        match target {
            Target::Rgb(bytes) => {
                self.lights.fill(scene);
                let LightSet { plain, shadowed, casting, all } = &self.lights;
                if self.shadows.len() < casting.len() {
                    self.shadows.resize_with(casting.len(), Shadow::default);
                }
                let shadows = &mut self.shadows[..casting.len()];
                // Texels must be smaller than pixels.
                let side = (2 * view.width.max(view.height)).clamp(192, 1024);
                join_if(
                    *parallel,
                    || {
                        for_each_strip(strips, ends, 0, (&mut [], 0), &|strip, rows, _: &mut [u8]| {
                            strip.draw_geoms(frame, rows, opaque)
                        })
                    },
                    || {
                        cast_shadows(shadows, casting, *parallel, &|shadow, light| {
                            shadow.cast(scene, assets, light, side)
                        })
                    },
                );
                let lights = Lighting { plain, shadowed, shadows };
                let unshaded = Lighting { plain: all, shadowed: &[], shadows: &[] };
                for_each_strip(strips, ends, 0, (bytes, 3 * view.width), &|strip, _, bytes| {
                    strip.write_colours(frame, lights, unshaded, bytes);
                });
            }
            Target::Depth(depths) => for_each_strip(strips, ends, 0, (depths, view.width), &|strip, rows, depths| {
                strip.draw_geoms(frame, rows, opaque);
                strip.write_depths(frame, depths);
            }),
            Target::Labels(labels) => for_each_strip(strips, ends, 0, (labels, view.width), &|strip, rows, labels| {
                strip.draw_geoms(frame, rows, |geom| scene.geoms[geom].label.is_some());
                strip.write_labels(frame, labels);
            }),
        }
    }
}

/// The lights of a scene.
#[derive(Default)]
struct LightSet {
    /// Lights without shadows. Lights with shadows are in `shadowed`, in the order of `casting`.
    plain: Vec<ShadingLight>,
    shadowed: Vec<ShadingLight>,
    /// The scene's lights that cast shadows.
    casting: Vec<Light>,
    /// All lights, those without shadows first.
    all: Vec<ShadingLight>,
}

impl LightSet {
    fn fill(&mut self, scene: &Scene) {
        let casts = |light: &&Light| scene.shadows && light.shadows;
        self.casting.clear();
        self.casting.extend(scene.lights.iter().filter(casts));
        self.shadowed.clear();
        self.shadowed.extend(self.casting.iter().map(ShadingLight::new));
        self.plain.clear();
        self.plain.extend(scene.lights.iter().filter(|light| !casts(light)).map(ShadingLight::new));
        self.all.clear();
        self.all.extend(self.plain.iter().chain(&self.shadowed));
    }
}

/// Runs two functions, in parallel if `parallel` is set.
fn join_if(parallel: bool, a: impl FnOnce() + Send, b: impl FnOnce() + Send) {
    if parallel {
        rayon::join(a, b);
    } else {
        a();
        b();
    }
}

/// Runs `work` on every strip and its rows of the target, a thread per strip. The first strip begins at row `top`; a
/// row of the target has `row` values.
fn for_each_strip<T: Send>(
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
                || for_each_strip(upper, first, top, (above, row), work),
                || for_each_strip(lower, last, middle, (below, row), work),
            );
        }
    }
}

/// Draws the shadow maps of lights, one thread per light if `parallel` is set.
fn cast_shadows(
    shadows: &mut [Shadow],
    lights: &[Light],
    parallel: bool,
    work: &(impl Fn(&mut Shadow, &Light) + Sync),
) {
    if let ([shadow, shadows @ ..], [light, lights @ ..]) = (shadows, lights) {
        join_if(
            parallel && !lights.is_empty(),
            || work(shadow, light),
            || cast_shadows(shadows, lights, parallel, work),
        );
    }
}

/// Whether a camera's values are finite and its frame has a positive size.
fn is_valid(view: &View) -> bool {
    let values = [view.position, view.right, view.up, view.forward];
    let density = view.pixels_per_unit[0] * view.pixels_per_unit[1];
    values.iter().flatten().all(|x| x.is_finite())
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

    /// Colours, depths and labels, drawn in strips with the given ends.
    fn draw_in_strips(canvas: &mut Canvas, scene: &Scene, ends: &[usize]) -> (Vec<u8>, Vec<u32>, Vec<i32>) {
        let (assets, view, n) = (assets(), View::of(&scene.camera, SIZE.0, SIZE.1), SIZE.0 * SIZE.1);
        let (mut rgb, mut depths, mut labels) = (vec![0; 3 * n], vec![0.0; n], vec![0; n]);
        if is_valid(&view) {
            (canvas.split.ends, canvas.split.parallel) = (ends.to_vec(), ends.len() > 1);
            let mut draw = |samples, target| {
                canvas.paint(&Frame { scene, assets: &assets, view: &view, pattern: pattern(samples) }, target);
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
        fn strips_equal_the_whole_frame(scene in scene()) {
            let mut canvas = Canvas::new();
            let unsplit = draw_in_strips(&mut canvas, &scene, &[150]);
            for ends in [&[64, 150][..], &[128, 150], &[64, 128, 150], &[150]] {
                prop_assert_eq!(&draw_in_strips(&mut canvas, &scene, ends), &unsplit, "{:?}", ends);
            }
        }
    }
}
