//! Rectangles that move over the frame and bounce off its edges.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `num_patches` | rectangles | 1 | 0 to 256 |
//! | `size` | height, and independently width, as a share of the frame's; drawn uniformly | 0.1/0.2 | 0 to 1 |
//! | `color` | red/green/blue, or one value for all | 255 | 0 to 255 |
//! | `speed` | pixels a step | 2 | 0 to 1000 |
//!
//! Position and direction are drawn uniformly at the start of an episode. In the goal frame the rectangles are at their
//! start positions. Source: `MovingPatchWrapper` of the reference. The reference moves the rectangles step by step;
//! here the position is a function of the step. Both give the same path if `speed` is less than the free length of a
//! rectangle's path.

use super::patch::{Patch, Rect};
use super::settings::{Color, Domain, Ends, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use rand::Rng as _;
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "moving-patch",
    summary: "draws rectangles that move over the frame and bounce off its edges",
    parameters: &[
        Parameter {
            name: "num_patches",
            summary: "number of rectangles",
            domain: Domain::Integer { low: 0, high: 256 },
            default: Some("1"),
        },
        Parameter {
            name: "size",
            summary: "height and width, as shares of the frame's",
            domain: Domain::Range { low: 0.0, high: 1.0 },
            default: Some("0.1/0.2"),
        },
        Parameter { name: "color", summary: "colour of the rectangles", domain: Domain::Color, default: Some("255") },
        Parameter {
            name: "speed",
            summary: "pixels a step",
            domain: Domain::Number { low: 0.0, high: 1000.0 },
            default: Some("2"),
        },
    ],
    build: |settings| {
        let Settings { num_patches, size, color, speed } = typed(ENTRY.id, settings)?;
        Ok(Box::new(MovingPatch { num_patches, size: size.range(), color: color.rgb(), speed, patches: vec![] }))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    num_patches: usize,
    size: Ends,
    color: Color,
    speed: f64,
}

#[derive(Clone)]
struct MovingPatch {
    num_patches: usize,
    size: [f64; 2],
    color: [u8; 3],
    speed: f64,
    patches: Vec<Moving>,
}

/// A patch and its velocity, downwards and to the right, in pixels per step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moving {
    pub patch: Patch,
    pub velocity: [f64; 2],
}

impl Moving {
    /// Returns the rectangle after `step` steps.
    pub fn rect(&self, frame: &FrameMut<'_>, step: u64) -> Rect {
        let [height, width] = self.patch.pixels(frame);
        let free = [frame.height.saturating_sub(height) as f64, frame.width.saturating_sub(width) as f64];
        let along = |side: usize| {
            let path = self.patch.position[side] * free[side] + self.velocity[side] * step as f64;
            bounce(path, free[side]) as usize
        };
        Rect { x: along(1), y: along(0), width, height }
    }
}

/// Returns the position of a point that starts at 0, moves by `path`, and is reflected at 0 and at `end`.
fn bounce(path: f64, end: f64) -> f64 {
    if end <= 0.0 {
        return 0.0;
    }
    let path = path.rem_euclid(2.0 * end);
    if path > end { 2.0 * end - path } else { path }
}

impl VisualWrapper for MovingPatch {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        let mut rng = episode.rng();
        self.patches.clear();
        self.patches.extend((0..self.num_patches).map(|_| {
            let patch = Patch::draw(self.size, &mut rng);
            let (sin, cos) = (std::f64::consts::TAU * rng.random::<f64>()).sin_cos();
            Moving { patch, velocity: [self.speed * sin, self.speed * cos] }
        }));
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        for patch in &self.patches {
            patch.rect(frame, which.step()).fill(self.color, frame);
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
