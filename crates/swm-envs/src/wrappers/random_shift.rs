//! A random shift by up to `pad` pixels on both axes; uncovered pixels repeat the nearest edge.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `pad` | pixels; both offsets are drawn uniformly from -pad ..= pad | 4 | 0 to 1024 |
//! | `resample` | when the offsets are sampled | `episode` | `episode`, `step` |
//!
//! Source: `RandomShiftWrapper` of the reference, which samples at every call. The paper samples once per episode,
//! which is the default here; `resample=step` samples per step, so that drawing a step twice gives equal frames.

use super::settings::{Domain, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use rand::Rng as _;
use serde::Deserialize;
use swm_core::{FrameMut, Key};

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "random-shift",
    summary: "shifts the frame by a random offset and repeats its edges",
    parameters: &[
        Parameter {
            name: "pad",
            summary: "greatest offset on both axes, pixels",
            domain: Domain::Integer { low: 0, high: 1024 },
            default: Some("4"),
        },
        Parameter {
            name: "resample",
            summary: "when the offset is sampled",
            domain: Domain::Choice(&["episode", "step"]),
            default: Some("episode"),
        },
    ],
    build: |settings| {
        let settings: Settings = typed(ENTRY.id, settings)?;
        Ok(Box::new(RandomShift { settings, episode: Key::new(0), old: vec![] }))
    },
};

#[derive(Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    pad: usize,
    resample: Resample,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Resample {
    Episode,
    Step,
}

#[derive(Clone)]
struct RandomShift {
    settings: Settings,
    episode: Key,
    old: Vec<u8>,
}

impl VisualWrapper for RandomShift {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn reset(&mut self, episode: Key) {
        self.episode = episode;
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        if frame.rgb.is_empty() {
            return;
        }
        let Settings { pad, resample } = self.settings;
        let key = match resample {
            Resample::Episode => self.episode,
            Resample::Step => which.key(self.episode),
        };
        let mut rng = key.rng();
        let [down, right] = [(); 2].map(|()| rng.random_range(0..=2 * pad));
        // Pixel `i` of the new frame is pixel `i + offset - pad` of the old one.
        let source = |i: usize, offset: usize, n: usize| (i + offset).saturating_sub(pad).min(n - 1);
        self.old.clear();
        self.old.extend_from_slice(frame.rgb);
        let (width, old) = (frame.width, self.old.as_chunks::<3>().0);
        // The columns whose source lies within the old frame, and the first of these sources.
        let start = pad.saturating_sub(right).min(width);
        let from = source(start, right, width);
        let inner = (width - from).min(width - start);
        for (y, row) in frame.rgb.as_chunks_mut::<3>().0.chunks_exact_mut(width).enumerate() {
            let old = &old[source(y, down, frame.height) * width..][..width];
            let (left, rest) = row.split_at_mut(start);
            let (middle, right) = rest.split_at_mut(inner);
            left.fill(old[0]);
            middle.copy_from_slice(&old[from..from + inner]);
            right.fill(old[width - 1]);
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
