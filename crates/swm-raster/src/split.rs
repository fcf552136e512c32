//! Splits a frame into [`Strip`](crate::strip::Strip)s of about equal work for threads.
//!
//! Strips begin at multiples of [`BAND`] rows. The split depends on the scene alone, and the content of the frame
//! does not depend on the split.

use crate::layers::{mesh_cell, touched};
use crate::paint::BAND;
use crate::scene::Shape;
use crate::strip::Frame;

/// Estimated work per pixel, in nanoseconds on one thread.
const PER_PIXEL: f32 = 30.0;
/// Estimated work per sample of a primitive, in nanoseconds on one thread.
const PER_SAMPLE: f32 = 0.6;
/// Estimated work per triangle, in nanoseconds on one thread.
const PER_TRIANGLE: f32 = 35.0;

/// The least work for which another thread is used, in nanoseconds.
const MIN_WORK: f32 = 250_000.0;

/// The ends of strips, and scratch memory.
#[derive(Default)]
pub(crate) struct Split {
    /// The row after the last row of each strip.
    pub ends: Vec<usize>,
    /// Whether there is enough work for more than one thread.
    pub parallel: bool,
    /// The estimated work of each band, in nanoseconds.
    work: Vec<f32>,
}

impl Split {
    /// Splits a frame for at most `threads` threads, each with enough work.
    pub fn cut(&mut self, frame: &Frame<'_>, threads: usize) {
        self.ends.clear();
        self.parallel = false;
        if threads > 1 {
            self.estimate(frame);
            let total: f32 = self.work.iter().sum();
            let strips = threads.min((total / MIN_WORK) as usize);
            self.parallel = strips > 1;
            self.cut_into(strips, total);
        }
        self.ends.push(frame.view.height);
    }

    /// Splits the bands into at most `strips` strips of equal work.
    fn cut_into(&mut self, strips: usize, total: f32) {
        let mut done = 0.0;
        for (band, work) in self.work.iter().enumerate() {
            // A band belongs to the strip that contains the middle of the band's work.
            let share = total * (self.ends.len() + 1) as f32 / strips as f32;
            if band > 0 && self.ends.len() + 1 < strips && done + 0.5 * work > share {
                self.ends.push(band * BAND);
            }
            done += work;
        }
    }

    /// Estimates the work of each band.
    fn estimate(&mut self, frame: &Frame<'_>) {
        let Frame { scene, assets, view, pattern } = *frame;
        self.work.clear();
        self.work.resize(view.height.div_ceil(BAND), PER_PIXEL * (view.width * BAND) as f32);
        for geom in &scene.geoms {
            let Some([x0, y0, x1, y1]) = touched(geom, assets, view) else { continue };
            let row = match geom.shape {
                Shape::Mesh(mesh) => {
                    let faces = assets.meshes[mesh].level_for(mesh_cell(&assets.meshes[mesh], geom, view, false));
                    PER_TRIANGLE * assets.meshes[mesh].level(faces).faces.len() as f32 / (y1 - y0) as f32
                }
                _ => PER_SAMPLE * ((x1 - x0) * pattern.len()) as f32,
            };
            for band in y0 / BAND..y1.div_ceil(BAND) {
                let rows = y1.min((band + 1) * BAND) - y0.max(band * BAND);
                self.work[band] += row * rows as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::pattern;
    use crate::scene::{Assets, Geom, Scene};
    use crate::scenes::CAMERA;
    use crate::vector::IDENTITY;
    use crate::view::View;

    /// Returns the ends of the strips of a square frame.
    fn ends(scene: &Scene, side: usize, threads: usize) -> Vec<usize> {
        let (assets, view) = (Assets::default(), View::of(&scene.camera, side, side));
        let mut split = Split::default();
        split.cut(&Frame { scene, assets: &assets, view: &view, pattern: pattern(4) }, threads);
        split.ends
    }

    #[test]
    fn strips_begin_at_bands_and_have_similar_work() {
        let mut scene = Scene { camera: CAMERA, ..Scene::default() };
        assert_eq!(ends(&scene, 16, 4), [16], "a small scene is not split");
        assert_eq!(ends(&scene, 256, 1), [256], "one thread draws one strip");
        assert_eq!(ends(&scene, 256, 2), [128, 256]);
        assert_eq!(ends(&scene, 256, 4), [64, 128, 192, 256]);
        assert_eq!(ends(&scene, 1024, 100).len(), 16, "no strip is less than a band");
        // More work in the lower half: upper strips are wider.
        let ball = Geom {
            shape: Shape::Ellipsoid([1.0; 3]),
            position: [0.0, 2.0, -1.5],
            rotation: IDENTITY,
            rgba: [1.0; 4],
            emission: 0.0,
            specular: 0.0,
            shininess: 0.0,
            reflectance: 0.0,
            paint: None,
            label: None,
            casts: true,
        };
        scene.geoms = vec![ball; 100];
        assert!(ends(&scene, 256, 2)[0] > 128, "{:?}", ends(&scene, 256, 2));
    }
}
