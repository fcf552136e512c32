//! Resizing of RGB images, `[height, width, 3]` bytes, with one type for each definition of resizing.
//!
//! | type | semantics | arithmetic |
//! | --- | --- | --- |
//! | [`PillowResizer`] | Pillow 13's `BILINEAR` (a triangle filter as wide as two pixels of the coarser image) or `NEAREST` | integers, vertical pass first, rounded to bytes between the passes |
//! | [`TriangleResizer`] | the same triangle filter, for parts of images | `f32`, rounded once |
//! | [`AreaResizer`] | OpenCV's `INTER_AREA` | `f32`, rounded once |
//! | [`bilinear_taps`], [`bilinear_blend`] | OpenCV's `INTER_LINEAR` | integers |
//!
//! [`FilterAxis`] holds the weights of one direction, for renderers that resize their own representation of an image.

mod area;
mod axis;
mod bilinear;
mod pillow;
mod triangle;

pub use area::AreaResizer;
pub use axis::{FilterAxis, WEIGHT_BITS, WEIGHT_HALF, weighted_byte};
pub use bilinear::{BilinearTap, bilinear_blend, bilinear_taps};
pub use pillow::{PillowFilter, PillowResizer};
pub use triangle::TriangleResizer;
