//! Drawing the way the Python references do: at the reference's own size, resized to the asked one.
//!
//! A [`Canvas`] holds one byte a pixel, an index into a [`Palette`]; its primitives cover the same pixels as those
//! of pygame 2.6. A [`Resampler`] turns it into RGB of any size with the arithmetic of OpenCV's bilinear resize.
//! So pictures equal the reference's byte for byte, and only what moved needs to be drawn and resampled again.
//!
//! [`Pixels`] are RGB, for shapes with smooth edges as matplotlib draws them. A [`Stage`] keeps what does not move, and
//! resizes with a [`Tent`] as Pillow does. A [`Brush`] draws soft discs at any size.

mod canvas;
mod pixels;
mod resample;
mod soft;
mod stage;
mod tent;

pub use canvas::{Area, Canvas, Palette, Point, WIDTH};
pub use pixels::{Pixels, Rgb, rect};
pub use resample::Resampler;
pub use soft::{Brush, Disc};
pub use stage::Stage;
pub use tent::Tent;
