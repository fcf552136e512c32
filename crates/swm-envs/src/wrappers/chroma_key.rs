//! Chroma key: pixels near a key colour are replaced by a background image or video.
//!
//! A pixel is replaced when its Euclidean distance to one of the key colours is at most `tolerance`. The background is
//! resized to the frame (area interpolation). A video starts with its first frame at step 0, advances one frame per
//! step and repeats.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `key_color` | red/green/blue, again for every further colour | must be given | 0 to 255 |
//! | `media` | path of a PNG, a folder of PNGs, or a file that `ffmpeg` decodes | must be given | |
//! | `tolerance` | levels of 255, distance in RGB | 0 | 0 to 442 |
//!
//! Source: `ChromaKeyWrapper` of the reference. Deviation: a video follows the steps of the episode, but in the
//! reference it advances with every drawn frame and never restarts.

use super::media::{Media, SizedMedia};
use super::settings::{Domain, Parameter};
use super::{EpisodeFrame, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::FrameMut;

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "chroma-key",
    summary: "replaces colours by an image or a video",
    parameters: &[
        Parameter { name: "key_color", summary: "colours that are replaced", domain: Domain::Colors, default: None },
        Parameter {
            name: "media",
            summary: "a PNG file, a folder of them, or an image or video that ffmpeg decodes",
            domain: Domain::Path,
            default: None,
        },
        Parameter {
            name: "tolerance",
            summary: "greatest distance from a key colour, levels of 255 in RGB",
            domain: Domain::Number { low: 0.0, high: 442.0 },
            default: Some("0"),
        },
    ],
    build: |settings| {
        let Settings { key_color, media, tolerance } = typed(ENTRY.id, settings)?;
        Ok(Box::new(ChromaKey::new(&key_color, Media::read(&media)?, tolerance)))
    },
};

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Settings {
    key_color: Vec<u8>,
    media: PathBuf,
    tolerance: f64,
}

#[derive(Clone)]
pub(super) struct ChromaKey {
    keys: Vec<[i32; 3]>,
    /// The greatest squared distance at which a pixel is replaced.
    max_distance_squared: i32,
    media: Arc<Media>,
    sized: Option<Arc<SizedMedia>>,
}

impl ChromaKey {
    pub fn new(keys: &[u8], media: Media, tolerance: f64) -> Self {
        let keys = keys.as_chunks::<3>().0.iter().map(|key| key.map(i32::from)).collect();
        // The margin includes distances equal to the tolerance in spite of rounding errors.
        let max_distance_squared = (tolerance * tolerance + 1e-6) as i32;
        Self { keys, max_distance_squared, media: Arc::new(media), sized: None }
    }

    /// Returns whether a pixel is replaced.
    fn is_key(&self, pixel: [u8; 3]) -> bool {
        let [r, g, b] = pixel.map(i32::from);
        let distance_squared = |key: &[i32; 3]| (r - key[0]).pow(2) + (g - key[1]).pow(2) + (b - key[2]).pow(2);
        self.keys.iter().any(|key| distance_squared(key) <= self.max_distance_squared)
    }
}

impl VisualWrapper for ChromaKey {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, which: EpisodeFrame) {
        if frame.rgb.is_empty() {
            return;
        }
        let size = [frame.width, frame.height];
        let sized = match self.sized.take() {
            Some(sized) if sized.has_size(size) => sized,
            _ => self.media.sized(size),
        };
        let background = self.media.frame(&sized, which.step()).as_chunks::<3>().0;
        // Most pixels of a drawn frame have the colour of their neighbour, so the last result is cached.
        let mut last = ([0; 3], self.is_key([0; 3]));
        for (pixel, background) in frame.rgb.as_chunks_mut::<3>().0.iter_mut().zip(background) {
            if *pixel != last.0 {
                last = (*pixel, self.is_key(*pixel));
            }
            if last.1 {
                *pixel = *background;
            }
        }
        self.sized = Some(sized);
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(self.clone())
    }
}
