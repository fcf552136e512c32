//! Images in memory and in files: encoding, decoding and pixel arithmetic, all without C code.
//!
//! - [`ImageCodec`], [`decode`], [`image_size`]: the codecs that datasets store frames with. A stored image names its
//!   own format in its first bytes.
//! - [`read_png`], [`write_png`]: PNG files.
//! - [`resize`]: one resizer per semantics (Pillow's and OpenCV's filters).
//!
//! Videos are in `swm-video`. Images are `[height, width, 3]` RGB bytes, row-major, unless stated otherwise.

mod codec;
mod jpeg;
mod png_file;
mod qoi;
pub mod resize;
mod rgb_image;

pub use codec::{ImageCodec, decode, image_size};
pub use png_file::{read_png, write_png};
pub use rgb_image::RgbImage;
