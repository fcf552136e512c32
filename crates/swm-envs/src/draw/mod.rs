//! Drawing flat shapes the way the Python references do: on a canvas of whole pixels, resampled to the asked size.
//!
//! A [`Canvas`] holds one byte a pixel, an index into a [`Palette`]; its primitives cover the same pixels as those
//! of pygame 2.6. A [`Resampler`] turns it into RGB of any size with the arithmetic of OpenCV's bilinear resize.
//! So pictures equal the reference's byte for byte, and only what moved needs to be drawn and resampled again.

mod canvas;
mod resample;

pub use canvas::{Area, Canvas, Palette, Point, WIDTH};
pub use resample::Resampler;
