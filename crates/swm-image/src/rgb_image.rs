//! [`RgbImage`]: the type of images that functions return.

/// An RGB image in memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbImage {
    /// The width in pixels.
    pub width: usize,
    /// The height in pixels.
    pub height: usize,
    /// The pixels, `[height, width, 3]` bytes.
    pub rgb: Vec<u8>,
}
