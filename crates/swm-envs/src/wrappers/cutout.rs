//! Rectangles that hide parts of the picture, elsewhere in every picture.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `num` | rectangles | 1 | 0 to 256 |
//! | `size` | height, and independently width, as a part of the picture's; drawn uniformly | 0.1/0.2 | 0 to 1 |
//! | `color` | red/green/blue, or one number for all | 0 | 0 to 255 |
//!
//! Rectangles lie within the picture, every place equally likely. Source: `CutoutWrapper` of the reference.
//! Deviation: redrawn with every step instead of with every call, so that drawing a step again shows the same.

use super::patch::Patch;
use super::settings::{Color, Domain, Ends, Parameter};
use super::{View, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "cutout",
    summary: "masks rectangles, elsewhere in every picture",
    parameters: &[
        Parameter {
            name: "num",
            summary: "how many rectangles",
            domain: Domain::Integer { low: 0, high: 256 },
            default: Some("1"),
        },
        Parameter {
            name: "size",
            summary: "height and width, as parts of the picture's",
            domain: Domain::Range { low: 0.0, high: 1.0 },
            default: Some("0.1/0.2"),
        },
        Parameter { name: "color", summary: "what they show", domain: Domain::Color, default: Some("0") },
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

    fn apply(&mut self, frame: &mut FrameMut<'_>, view: View) {
        let mut rng = view.key(self.episode).rng();
        for _ in 0..self.num {
            Patch::draw(self.size, &mut rng).rect(frame).fill(self.color, frame);
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
