//! Drawing of frames as in the Python reference: at the size that the reference draws at, then resized.
//!
//! A [`Canvas`] holds one byte per pixel, an index into a [`Palette`]; its shapes cover the same pixels as those of
//! pygame 2.6, and a [`Resampler`] converts a canvas to RGB of any size with the arithmetic of OpenCV's bilinear
//! resize. [`Pixels`] is an RGB image for shapes with anti-aliased edges as matplotlib draws them, and a [`Background`]
//! caches the static part of such images and resizes with Pillow's triangle filter. A [`Brush`] blends soft discs at
//! any size.

mod background;
mod by_size;
mod canvas;
mod pixels;
mod resample;
mod soft_disc;

pub use background::Background;
pub use by_size::BySize;
pub use canvas::{Area, Canvas, Palette, Point, WIDTH};
pub use pixels::{Pixels, Rgb, rect};
pub use resample::Resampler;
pub use soft_disc::{Brush, SoftDisc};
