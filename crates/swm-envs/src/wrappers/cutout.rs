//! Rectangles that hide parts of the frame, at new positions in every step.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `num` | rectangles | 1 | 0 to 256 |
//! | `size` | height, and independently width, as a share of the frame's; drawn uniformly | 0.1/0.2 | 0 to 1 |
//! | `color` | red/green/blue, or one value for all | 0 | 0 to 255 |
//!
//! Rectangles lie within the frame; all positions are equally likely. Source: `CutoutWrapper` of the reference.
//! Deviation: sampled per step instead of per call, so that drawing a step twice gives equal frames.

use super::patch::Patch;
use super::settings::{Color, Domain, Ends, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "cutout",
    summary: "masks rectangles, at new positions in every step",
    parameters: &[
        Parameter {
            name: "num",
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
        Parameter { name: "color", summary: "colour of the rectangles", domain: Domain::Color, default: Some("0") },
    ],
    build: |settings| {
        let Settings { num, size, color } = typed(ENTRY.id, settings)?;
        Ok(Box::new(Cutout { num, size: size.range(), color: color.rgb(), episode: Key::new(0) }))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    num: usize,
    size: Ends,
    color: Color,
}

#[derive(Clone)]
struct Cutout {
    num: usize,
    size: [f64; 2],
    color: [u8; 3],
    episode: Key,
}

impl VisualWrapper for Cutout {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        self.episode = episode;
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        let mut rng = which.key(self.episode).rng();
        for _ in 0..self.num {
            Patch::draw(self.size, &mut rng).rect(frame).fill(self.color, frame);
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
