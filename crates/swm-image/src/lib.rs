//! Images in memory and in files: encoding, decoding and pixel arithmetic, all without C code.
//!
//! - [`ImageCodec`], [`decode`], [`image_size`]: the codecs that datasets store frames with. The first bytes of a
//!   stored image identify its format.
//! - [`read_png`], [`write_png`], [`check_png`]: PNG files.
//! - [`resize`]: resizing as Pillow and as OpenCV define it.
//!
//! Videos are in `swm-video`. Images are `[height, width, 3]` RGB bytes, row-major, unless stated otherwise.

mod codec;
mod jpeg;
mod png_file;
mod qoi;
pub mod resize;
mod rgb_image;

pub use codec::{ImageCodec, MAX_PIXELS, decode, image_size, is_image};
pub use png_file::{check_png, read_png, write_png};
pub use rgb_image::RgbImage;
