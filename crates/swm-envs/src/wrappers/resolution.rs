//! Reduced resolution: the frame is shrunk to `scale` of its size, and enlarged to its old size in blocks.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `scale` | share of width and height; the sides are rounded and at least 1 | 0.5 | 0 to 1 |
//!
//! Source: `ResolutionWrapper` of the reference (area interpolation down, nearest neighbour up). Deviation:
//! `scale` is at most 1, because larger values leave the frame unchanged.

use super::settings::{Domain, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use swm_core::FrameMut;
use swm_image::resize::AreaResizer;

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "resolution",
    summary: "shrinks the frame and enlarges it to its old size in blocks",
    parameters: &[Parameter {
        name: "scale",
        summary: "factor of width and height",
        domain: Domain::Number { low: 0.0, high: 1.0 },
        default: Some("0.5"),
    }],
    build: |settings| {
        let Settings { scale } = typed(ENTRY.id, settings)?;
        Ok(Box::new(Resolution { scale, resizer: None, columns: vec![], small: vec![] }))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    scale: f64,
}

#[derive(Clone)]
struct Resolution {
    scale: f64,
    resizer: Option<AreaResizer>,
    /// The column of the small image for every column of the frame.
    columns: Vec<usize>,
    small: Vec<u8>,
}

impl VisualWrapper for Resolution {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        if frame.rgb.is_empty() {
            return;
        }
        let from = [frame.width, frame.height];
        let to = from.map(|side| ((side as f64 * self.scale).round_ties_even() as usize).max(1));
        let resizer = match &mut self.resizer {
            Some(resizer) if resizer.is_for(from, to) => resizer,
            outdated => {
                self.columns = (0..from[0]).map(|x| x * to[0] / from[0]).collect();
                outdated.insert(AreaResizer::new(from, to))
            }
        };
        self.small.resize(3 * to[0] * to[1], 0);
        resizer.resize(frame.rgb, &mut self.small);
        let small = self.small.as_chunks::<3>().0;
        let stride = 3 * from[0];
        let mut drawn = None;
        for y in 0..from[1] {
            let source = y * to[1] / from[1];
            if drawn == Some(source) {
                frame.rgb.copy_within(stride * (y - 1)..stride * y, stride * y);
                continue;
            }
            drawn = Some(source);
            let line = &small[source * to[0]..][..to[0]];
            let pixels = frame.rgb[stride * y..][..stride].as_chunks_mut::<3>().0;
            for (pixel, &column) in pixels.iter_mut().zip(&self.columns) {
                *pixel = line[column];
            }
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
