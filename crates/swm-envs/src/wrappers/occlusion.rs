//! Rectangles that hide parts of the frame, at the same positions throughout an episode.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `num_patches` | rectangles | 1 | 0 to 256 |
//! | `size` | height, and independently width, as a share of the frame's; drawn uniformly | 0.1/0.3 | 0 to 1 |
//! | `color` | red/green/blue, or one value for all | 0 | 0 to 255 |
//!
//! Rectangles lie within the frame; all positions are equally likely. Source: `OcclusionWrapper` of the reference.

use super::patch::Patch;
use super::settings::{Color, Domain, Ends, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "occlusion",
    summary: "masks rectangles, at the same positions throughout an episode",
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
            default: Some("0.1/0.3"),
        },
        Parameter { name: "color", summary: "colour of the rectangles", domain: Domain::Color, default: Some("0") },
    ],
    build: |settings| {
        let Settings { num_patches, size, color } = typed(ENTRY.id, settings)?;
        Ok(Box::new(Occlusion { num_patches, size: size.range(), color: color.rgb(), patches: vec![] }))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    num_patches: usize,
    size: Ends,
    color: Color,
}

#[derive(Clone)]
struct Occlusion {
    num_patches: usize,
    size: [f64; 2],
    color: [u8; 3],
    patches: Vec<Patch>,
}

impl VisualWrapper for Occlusion {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        let mut rng = episode.rng();
        self.patches.clear();
        self.patches.extend((0..self.num_patches).map(|_| Patch::draw(self.size, &mut rng)));
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        for patch in &self.patches {
            patch.rect(frame).fill(self.color, frame);
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
