//! Where a picture is cut into [`Strip`](crate::strip::Strip)s, so that threads have about equally much to do.
//!
//! Strips begin with bands of rows ([`BAND`]). Where they begin is decided by the scene alone, and nothing that is seen depends on it.

use crate::layers::{cell, touched};
use crate::paint::BAND;
use crate::scene::Shape;
use crate::strip::Picture;

/// Work is counted in nanoseconds of one thread, roughly: what a pixel takes, a sample of a shape, a triangle.
const PER_PIXEL: f32 = 30.0;
const PER_SAMPLE: f32 = 0.6;
const PER_TRIANGLE: f32 = 35.0;

/// Less work than this is not handed to another thread: waking it takes a part of it.
const WORTH: f32 = 250_000.0;

/// Where strips end, and scratch.
#[derive(Default)]
pub(crate) struct Split {
    /// The row after the last one of each strip.
    pub ends: Vec<usize>,
    /// Whether there is work for more than one thread.
    pub pays: bool,
    /// By band: its work.
    work: Vec<f32>,
}

impl Split {
    /// Cuts a picture for at most so many threads, each of which is to have enough to do.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn cut(&mut self, picture: &Picture<'_>, threads: usize) {
        self.ends.clear();
        self.pays = false;
        if threads > 1 {
            self.estimate(picture);
            let whole: f32 = self.work.iter().sum();
            let strips = threads.min((whole / WORTH) as usize);
            self.pays = strips > 1;
            self.cut_into(strips, whole);
        }
        self.ends.push(picture.view.height);
    }

    /// Cuts so that strips, of which there are at most so many, have equal shares of all work.
    #[allow(clippy::cast_precision_loss)]
    fn cut_into(&mut self, strips: usize, whole: f32) {
        let mut done = 0.0;
        for (band, work) in self.work.iter().enumerate() {
            // A band belongs to the strip in whose share its middle is.
            let share = whole * (self.ends.len() + 1) as f32 / strips as f32;
            if band > 0 && self.ends.len() + 1 < strips && done + 0.5 * work > share {
                self.ends.push(band * BAND);
            }
            done += work;
        }
    }

    /// Estimates the work on each band.
    #[allow(clippy::cast_precision_loss)]
    fn estimate(&mut self, picture: &Picture<'_>) {
        let Picture { scene, assets, view, pattern } = *picture;
        self.work.clear();
        self.work.resize(view.height.div_ceil(BAND), PER_PIXEL * (view.width * BAND) as f32);
        for geom in &scene.geoms {
            let Some([x0, y0, x1, y1]) = touched(geom, assets, view) else { continue };
            let row = match geom.shape {
                Shape::Mesh(mesh) => {
                    let faces = assets.meshes[mesh].level_for(cell(&assets.meshes[mesh], geom, view, false));
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
    use crate::scene::{Assets, Camera, Geom, Scene};
    use crate::vector::IDENTITY;
    use crate::view::View;

    /// Where a square picture of a scene is cut.
    fn ends(scene: &Scene, side: usize, threads: usize) -> Vec<usize> {
        let (assets, view) = (Assets::default(), View::of(&scene.camera, side, side));
        let mut split = Split::default();
        split.cut(&Picture { scene, assets: &assets, view: &view, pattern: pattern(4) }, threads);
        split.ends
    }

    #[test]
    fn strips_begin_with_bands_and_share_the_work() {
        let camera = Camera {
            forward: [0.0, 1.0, 0.0],
            up: [0.0, 0.0, 1.0],
            frustum: [-0.1, 0.1, -0.1, 0.1],
            near: 0.1,
            far: 100.0,
            ..Camera::default()
        };
        let mut scene = Scene { camera, ..Scene::default() };
        assert_eq!(ends(&scene, 16, 4), [16], "too little work");
        assert_eq!(ends(&scene, 256, 1), [256], "nobody to share it with");
        assert_eq!(ends(&scene, 256, 2), [128, 256]);
        assert_eq!(ends(&scene, 256, 4), [64, 128, 192, 256]);
        assert_eq!(ends(&scene, 1024, 100).len(), 16, "no strip is less than a band");
        // Much to do below: upper strips are wider.
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
