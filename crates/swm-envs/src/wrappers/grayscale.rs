//! Replaces each channel by the luma: `Y = 0.299 R + 0.587 G + 0.114 B`.
//!
//! The wrapper has no parameters. Source: `GrayscaleWrapper` of the reference, which calls OpenCV; the result is equal
//! bit for bit (weights in units of 2⁻¹⁵). Deviation: frames always have three channels, so there is no
//! `keep_channels`.

use super::{EpisodeFrame, VisualWrapper, WrapperEntry};
use swm_core::FrameMut;

/// The registry row of this wrapper.
pub const ENTRY: WrapperEntry = WrapperEntry {
    id: "grayscale",
    summary: "removes colour and keeps brightness",
    parameters: &[],
    build: |_| Ok(Box::new(Grayscale)),
};

struct Grayscale;

impl VisualWrapper for Grayscale {
    fn id(&self) -> &'static str {
        ENTRY.id
    }

    fn apply(&mut self, frame: &mut FrameMut<'_>, _which: EpisodeFrame) {
        for pixel in frame.rgb.as_chunks_mut::<3>().0 {
            let [r, g, b] = pixel.map(u32::from);
            *pixel = [((r * 9798 + g * 19235 + b * 3735 + (1 << 14)) >> 15) as u8; 3];
        }
    }

    fn fork(&self) -> Box<dyn VisualWrapper> {
        Box::new(Self)
    }
}
