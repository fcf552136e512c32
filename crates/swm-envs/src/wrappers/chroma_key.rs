//! Green screen: pixels near a colour show a background picture or video instead.
//!
//! A pixel is replaced when its Euclidean distance to one of the key colours is at most `tolerance`. The background
//! has the size of the picture (area interpolation). A video shows its first frame at step 0, another one every step,
//! and begins again after its last.
//!
//! | parameter | unit | default | range |
//! | --- | --- | --- | --- |
//! | `key_color` | red/green/blue, again for every further colour | must be given | 0 to 255 |
//! | `media` | path of a PNG, a folder of PNGs, or what `ffmpeg` decodes | must be given | |
//! | `tolerance` | levels of 255, distance in RGB | 0 | 0 to 442 |
//!
//! Source: `ChromaKeyWrapper` of the reference. Deviation: a video follows the steps of the episode, where the
//! reference's advances with every picture drawn and never goes back to its beginning.

use super::media::{Media, Sized};
use super::settings::{Domain, Parameter};
use super::{View, VisualWrapper, WrapperEntry, typed};
use serde::Deserialize;
use std::path::PathBuf;
use std::sync::Arc;
use swm_core::FrameMut;

/// The registry row.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "chroma-key",
    summary: "replaces colours by a picture or a video",
    parameters: &[
        Parameter { name: "key_color", summary: "what is replaced", domain: Domain::Colors, default: None },
        Parameter {
            name: "media",
            summary: "a PNG file, a folder of them, or a picture or video that ffmpeg decodes",
            domain: Domain::Path,
            default: None,
        },
        Parameter {
            name: "tolerance",
            summary: "how far from the key colour, levels of 255 in RGB",
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
    /// The greatest squared distance that is near.
    near: i32,
    media: Arc<Media>,
    sized: Option<Arc<Sized>>,
}

impl ChromaKey {
    #[allow(clippy::cast_possible_truncation)]
    pub fn new(keys: &[u8], media: Media, tolerance: f64) -> Self {
        let keys = keys.as_chunks::<3>().0.iter().map(|key| key.map(i32::from)).collect();
        // Rounding must not lose a distance that is the tolerance itself.
        Self { keys, near: (tolerance * tolerance + 1e-6) as i32, media: Arc::new(media), sized: None }
    }

    fn is_near(&self, pixel: [u8; 3]) -> bool {
        let [r, g, b] = pixel.map(i32::from);
        self.keys.iter().any(|key| (r - key[0]).pow(2) + (g - key[1]).pow(2) + (b - key[2]).pow(2) <= self.near)
    }
}

impl VisualWrapper for ChromaKey {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, view: View) {
        if frame.rgb.is_empty() {
            return;
        }
        let size = [frame.width, frame.height];
        let sized = match self.sized.take() {
            Some(sized) if sized.is_for(size) => sized,
            _ => self.media.sized(size),
        };
        let background = self.media.frame(&sized, view.step()).as_chunks::<3>().0;
        // Most pixels of a drawn world look like their neighbour.
        let mut last = ([0; 3], self.is_near([0; 3]));
        for (pixel, background) in frame.rgb.as_chunks_mut::<3>().0.iter_mut().zip(background) {
            if *pixel != last.0 {
                last = (*pixel, self.is_near(*pixel));
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
